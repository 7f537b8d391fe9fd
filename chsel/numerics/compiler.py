"""Kernels: how they are compiled, and where their machine code is kept.

Numba's own cache keeps it, in a folder for each state of the code: a kernel contains what it calls
and the constants of other files, which numba does not check. So the folder is named by a digest of
all files with kernels and of all that these import: code of changed source never runs.
"""

from __future__ import annotations

import getpass
import hashlib
import logging
import os
import re
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import llvmlite
import numba
from numba.core import event
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    _CacheLocator,
)
from numba.extending import overload
from numba.misc.appdirs import AppDirs

from chsel.errors import SettingError

Function = TypeVar("Function", bound=Callable[..., Any])

CACHE_VARIABLE = "CHSEL_CACHE_DIR"
KEPT_FOLDERS = 8  # the most recently used, each of a state of the code
_OTHERS_WRITE = 0o022
_UNMAPPED = 65534  # owner of what belongs to root outside of a container
_PACKAGE = Path(__file__).parents[1]
_IMPORTED = re.compile(r"^ *(?:from|import) (chsel[\w.]*)", re.MULTILINE)
_config: Any = numba.core.config
_njit: Any = numba.njit  # its types leave out some options
_log = logging.getLogger(__name__)


def compiled(function: Function) -> Function:
    """Return `function` as machine code, compiled on the first call, kept on disk, without the GIL.

    That of other packages is not kept: it is compiled in each process.
    Without fast-math and contraction, so that a * b + c is rounded twice on every CPU.
    """
    kernel: Any = _njit(nogil=True, error_model="numpy", no_cfunc_wrapper=True)(function)
    if _is_ours(function):
        kernel._cache = _KernelCache(function)
    return kernel


_INNER = {
    "nogil": True,
    "error_model": "numpy",
    "_nrt": False,
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}


def inner(function: Function) -> Function:
    """Return `function` for other kernels to call, not for Python, kept as a part of these.

    It cannot make arrays, so that no references are counted when arrays are passed.
    """
    kernel: Function = _njit(**_INNER)(function)
    return kernel


def leaf(function: Function) -> Function:
    """Return like `inner`, and always inlined into its caller."""
    kernel: Function = _njit(**_INNER, forceinline=True)(function)
    return kernel


def spliced(function: Function) -> Function:
    """Return like `leaf`, but inlined before types are inferred.

    For a few lines around a large function, which the compiler then goes over only once.
    """
    kernel: Function = _njit(**_INNER, inline="always")(function)
    return kernel


def implements(name: Callable[..., Any], model: type) -> Callable[[Function], Function]:
    """Decorator of what kernels that call `name` run if its first argument is of type `model`.

    model: a class of NamedTuples. So one kernel, compiled for each, serves several models. Raises
    TypeError if the function is not in this package, as its changes would not be noticed.
    """

    def register(function: Function) -> Function:
        if not _is_ours(function):
            name_of = f"{function.__module__}.{function.__name__}"
            raise TypeError(f"{name_of} is not in chsel; accepted: functions of this package")

        def chosen(first: Any, *others: Any) -> Function | None:
            return function if getattr(first, "instance_class", None) is model else None

        options: Any = {**_INNER, "forceinline": True}
        overload(name, jit_options=options, strict=False)(chosen)
        return function

    return register


def _states() -> list[tuple[int, int]]:
    """Return time of the last change and size of each file of the digest; empty if one is gone."""
    try:
        return [(state.st_mtime_ns, state.st_size) for state in map(os.stat, _FILES)]
    except OSError:
        return []


def _digest() -> str:
    """Return the digest of what machine code depends on, but for the CPU, which numba checks."""
    versions = numba.__version__, llvmlite.__version__, sys.version
    options = sorted((k, v) for k, v in os.environ.items() if k.startswith("NUMBA_"))
    digest = hashlib.blake2b(repr((versions, options)).encode(), digest_size=10)
    for file in _FILES:
        digest.update(f"\0{os.path.relpath(file, _PACKAGE)}\0".encode() + Path(file).read_bytes())
    return digest.hexdigest()


def _kernel_files() -> list[str]:
    """Return the files that import this one, and all files of the package that these import."""
    files = {_module(file): file for file in _PACKAGE.rglob("*.py")}
    imported = {
        module: set(_IMPORTED.findall(file.read_text(encoding="utf-8")))
        for module, file in files.items()
    }
    pending = {module for module, names in imported.items() if __name__ in names}
    reached: set[str] = set()
    while pending:
        module = pending.pop()
        reached.add(module)
        for name in imported[module]:
            # A folder stands for all of its files.
            pending |= {other for other in files if f"{other}.".startswith(f"{name}.")} - reached
    return sorted(str(files[module]) for module in reached)


def _module(file: Path) -> str:
    """Return the dotted name of a file of the package."""
    return ".".join(file.relative_to(_PACKAGE.parent).with_suffix("").parts)


_FILES = _kernel_files()
_STATES = _states()  # before they are read
_STAMP = _digest()


def _is_ours(function: Callable[..., Any]) -> bool:
    """Return whether a function is in a file that the digest is of."""
    return function.__code__.co_filename in _FILES


class _Locator(_CacheLocator):
    """The place of a function's machine code, and a stamp of what it was compiled from."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file = file
        self._place = f"{function.__module__}-{function.__code__.co_firstlineno}"

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> _Locator:
        return cls(py_func, py_file)

    def get_cache_path(self) -> str:
        return str(cache_directory())

    def ensure_cache_path(self) -> None:
        cache_directory()

    def get_source_stamp(self) -> str:
        return _STAMP

    def get_disambiguator(self) -> str:
        return self._place


class _Results(CompileResultCacheImpl):
    _locator_classes: list[type[object]] = [_Locator]  # noqa: RUF012


class _KernelCache(FunctionCache):
    """The kept code of one kernel.

    In a file for each signature, as numba's index of several may name the wrong one after two
    processes have written it at once.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        # Not numba's, which asks for the folder: it is not needed before the first call.
        self._py_func = function
        self._impl = _Results(function)
        self.enable()

    @property
    def cache_path(self) -> str:
        """The folder that the code is in."""
        return str(cache_directory())

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the code for types of arguments, None if it must be compiled."""
        # A file that changed since: this process may have imported other code than was digested.
        return super().load_overload(sig, target_context) if _states() == _STATES else None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the code for types of arguments."""
        if _states() == _STATES:
            super().save_overload(sig, data)

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        key = super()._index_key(sig, codegen)
        digest = hashlib.blake2b(repr(key).encode(), digest_size=10).hexdigest()
        name = f"{self._impl.filename_base}-{digest}"
        self._cache_file = IndexDataCacheFile(self.cache_path, name, _STAMP)
        return key


@cache
def cache_directory() -> Path:
    """Return the folder of the machine code of this state of the package.

    It is in the folder that CHSEL_CACHE_DIR names, else in the user's cache folder, or where that
    cannot be written in a temporary one. Raises SettingError if others can write to it.
    """
    named = os.environ.get(CACHE_VARIABLE)
    user = getpass.getuser() if sys.platform == "win32" else os.getuid()  # users may be nameless
    usual = Path(AppDirs("chsel", appauthor=False).user_cache_dir, "kernels")
    defaults = usual, Path(tempfile.gettempdir(), f"chsel-{user}")
    for parent in (Path(named).expanduser(),) if named else defaults:
        folder = parent / _STAMP
        try:
            for part in (*reversed(folder.parents), folder):
                if not part.exists():
                    part.mkdir(mode=0o700, exist_ok=True)  # whatever the umask is
            tempfile.TemporaryFile(dir=folder).close()
        except OSError:
            wrong = "which cannot be written; accepted: a folder for compiled kernels"
            continue
        shared = None if sys.platform == "win32" else _others_can_write(folder)
        if shared is None:
            os.utime(folder)
            with suppress(OSError):  # another process prunes, too
                _prune(folder)
            return folder
        wrong = (
            f"but others can write to {shared}, and compiled kernels are executed; accepted: a "
            "folder that only you, and root, can write to (chmod go-w)"
        )
        break
    raise SettingError(f"{CACHE_VARIABLE if named else 'the kernel folder'} is {parent}, {wrong}")


def _others_can_write(folder: Path) -> Path | None:
    """Return the first of a folder and its parents in which others can replace our files."""
    for part in (folder, *folder.absolute().parents, *folder.resolve().parents):
        state = part.stat()
        sticky = part != folder and state.st_mode & stat.S_ISVTX  # others cannot replace ours
        if state.st_uid not in (os.getuid(), *(() if part == folder else (0, _UNMAPPED))):
            return part
        if state.st_mode & _OTHERS_WRITE and not sticky:
            return part
    return None


def _prune(used: Path) -> None:
    """Remove the folders that were not used for longest; who still uses one compiles again."""
    others = [
        folder
        for folder in used.parent.iterdir()
        if re.fullmatch("[0-9a-f]{20}", folder.name) and folder != used
    ]
    others.sort(key=lambda folder: folder.stat().st_mtime)
    for folder in others[: 1 - KEPT_FOLDERS]:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def watched(show: Callable[[int], None]) -> Iterator[None]:
    """Call `show` with the number of kernels compiled, in place of the notice, in this context.

    It is called before each compilation, and after it.
    """
    _watch.count, _watch.show = 0, show
    try:
        yield
    finally:
        _watch.show = None


class _CompilerWatch(event.Listener):
    """Reports that kernels are being compiled, and vectorises their straight-line code.

    Numba has the latter as a switch of the process, which is off otherwise. It makes interpolation
    of the SDF twice as fast and changes no bit, as it reorders nothing.
    """

    def __init__(self) -> None:
        self.count = 0
        self.show: Callable[[int], None] | None = None
        self._noticed = False
        self._depth = 0
        self._usual = _config.SLP_VECTORIZE

    def on_start(self, event: Any) -> None:
        """Take note that the compilation of a function, or of one that it calls, begins."""
        if not _is_kernel(event):
            return
        if self._depth == 0:
            self._usual = _config.SLP_VECTORIZE
            _config.SLP_VECTORIZE = 1
            if self.show is not None:
                self.show(self.count)
            elif not self._noticed:
                text = "compiling the kernels of this version, once: up to a minute (kept in %s)"
                _log.warning(text, cache_directory().parent)
            self._noticed = True
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """Take note that the compilation of a function has ended."""
        if not _is_kernel(event):
            return
        self._depth -= 1
        if self._depth == 0:
            _config.SLP_VECTORIZE = self._usual
            self.count += 1
            if self.show is not None:
                self.show(self.count)


def _is_kernel(event: Any) -> bool:
    module: str = event.data["dispatcher"].py_func.__module__
    return module.startswith("chsel.")


_watch = _CompilerWatch()
event.register("numba:compile", _watch)
