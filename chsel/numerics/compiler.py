"""Kernels: how they are compiled, and where their machine code is kept.

Numba's own cache keeps it. A kernel contains what it calls and the constants of other files, which
numba does not check. So the folder is named by a digest of all files that the kernel may contain
something of: its own, those of the classes of its arguments, and all that these import, directly or
not. Code of changed source never runs.
"""

from __future__ import annotations

import gc
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
import llvmlite.binding
import numba
from numba.core import event, types
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    _CacheLocator,
)
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.extending import overload
from numba.misc.appdirs import AppDirs

from chsel.errors import SettingError

Function = TypeVar("Function", bound=Callable[..., Any])

CACHE_VARIABLE = "CHSEL_CACHE_DIR"
KEPT_FOLDERS = 300  # the most recently used, each of a state of some files
_OTHERS_WRITE = 0o022
_UNMAPPED = 65534  # owner of what belongs to root outside of a container
_PACKAGE = Path(__file__).parents[1]
_IMPORTED = re.compile(r"^ *(?:from|import) (chsel[\w.]*)", re.MULTILINE)
_POINTER = "_ZN08NumbaEnv"  # first part of the name of a pointer to an environment
_Tuple: Any = types.BaseTuple  # its types leave out its parts
_config: Any = numba.core.config
_njit: Any = numba.njit  # its types leave out some options
_log = logging.getLogger(__name__)


def compiled(function: Function) -> Function:
    """Return `function` as machine code, compiled on the first call, kept on disk, without the GIL.

    That of other packages is not kept: it is compiled in each process.
    Without fast-math and contraction, so that a * b + c is rounded twice on every CPU.
    """
    kernel: Any = _njit(nogil=True, error_model="numpy", no_cfunc_wrapper=True)(function)
    if _is_ours(function) and function.__closure__ is None:  # that may hold code of any file
        kernel._cache = _KernelCache(function)
    return kernel


class _Part(JITCodeLibrary):
    """Code of a function that is only ever a part of others: their machine code has it."""

    def _finalize_final_module(self) -> None:
        """Make the pointers to environments alone, which numba sets in memory."""
        code = self._final_module
        pointers = [str(each) for each in code.global_variables if each.name.startswith(_POINTER)]
        self._final_module = llvmlite.binding.parse_assembly("\n".join(pointers))
        super()._finalize_final_module()
        self._final_module = code


class _PartCompiler(Compiler):
    def define_pipelines(self) -> Any:
        self.state.library = _Part(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        return super().define_pipelines()


_INNER = {
    "pipeline_class": _PartCompiler,
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
    TypeError if the function is in another file than both, as its changes would not be noticed.
    """

    def register(function: Function) -> Function:
        if not _is_ours(function) or function.__module__ not in (name.__module__, model.__module__):
            raise TypeError(
                f"{function.__module__}.{function.__name__} is in another file than {name.__name__}"
                f" and {model.__name__}; accepted: functions of chsel in one of these files"
            )

        def chosen(first: Any, *others: Any) -> Function | None:
            return function if getattr(first, "instance_class", None) is model else None

        options: Any = {**_INNER, "forceinline": True}
        overload(name, jit_options=options, strict=False)(chosen)
        return function

    return register


def _module(file: Path) -> str:
    """Return the dotted name of a file of the package."""
    return ".".join(file.relative_to(_PACKAGE.parent).with_suffix("").parts)


def _state(module: str) -> tuple[int, int]:
    """Return time of the last change and size of a module's file; (0, 0) if it is gone."""
    try:
        state = os.stat(_FILES[module])
    except OSError:
        return 0, 0
    return state.st_mtime_ns, state.st_size


_FILES = {_module(file): str(file) for file in sorted(_PACKAGE.rglob("*.py"))}
_STATES = {module: _state(module) for module in _FILES}  # before they are imported


def _is_ours(function: Callable[..., Any]) -> bool:
    """Return whether a function is in a file that digests are made of."""
    return _FILES.get(function.__module__) == function.__code__.co_filename


@cache
def _imports(module: str) -> frozenset[str]:
    """Return the modules of the package that a module imports; a folder stands for its files."""
    names = _IMPORTED.findall(Path(_FILES[module]).read_text(encoding="utf-8"))
    return frozenset(
        other for other in _FILES for name in names if f"{other}.".startswith(f"{name}.")
    )


@cache
def _reached(modules: frozenset[str]) -> tuple[str, ...]:
    """Return the given modules of the package and all that these import, sorted."""
    pending, reached = set(modules), set[str]()
    while pending:
        module = pending.pop()
        reached.add(module)
        pending |= _imports(module) - reached
    return tuple(sorted(reached))


@cache
def _digest(modules: tuple[str, ...]) -> str:
    """Return the digest of what machine code depends on, but for the CPU, which numba checks."""
    versions = numba.__version__, llvmlite.__version__, sys.version
    options = sorted((k, v) for k, v in os.environ.items() if k.startswith("NUMBA_"))
    digest = hashlib.blake2b(repr((versions, options)).encode(), digest_size=10)
    for module in modules:
        digest.update(f"\0{module}\0".encode() + Path(_FILES[module]).read_bytes())
    return digest.hexdigest()


def _modules_of(kind: Any) -> Iterator[str]:
    """Yield the modules that an argument's type brings with it; "" if these are unknown."""
    if isinstance(kind, _Tuple):
        if hasattr(kind, "instance_class"):
            yield kind.instance_class.__module__
        for part in kind.types:
            yield from _modules_of(part)
    elif not isinstance(getattr(kind, "dtype", kind), types.Number | types.Boolean | types.Literal):
        yield ""


class _Locator(_CacheLocator):
    """The name of a function's machine code; the folder that numba asks for is not used."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file = file
        self._name = f"{function.__module__}-{function.__code__.co_firstlineno}"

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> _Locator:
        return cls(py_func, py_file)

    def get_cache_path(self) -> str:
        return str(cache_directory())

    def ensure_cache_path(self) -> None:
        cache_directory()

    def get_source_stamp(self) -> str:
        return ""

    def get_disambiguator(self) -> str:
        return self._name


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
        """The folder of code that depends on no file: that of a signature is beside it."""
        return str(cache_directory())

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the code for types of arguments, None if it must be compiled."""
        return super().load_overload(sig, target_context) if self._is_kept(sig) else None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the code for types of arguments."""
        if self._is_kept(sig):
            super().save_overload(sig, data)

    def _reached(self, sig: Any) -> tuple[str, ...]:
        """Return the modules that the code for types of arguments depends on."""
        modules = {self._py_func.__module__}
        return _reached(frozenset(modules.union(*(_modules_of(kind) for kind in sig))))

    def _is_kept(self, sig: Any) -> bool:
        """Return whether it is known what the code depends on, and none of it has changed.

        Of a file that changed since, this process may have imported other code than is digested.
        """
        try:
            return all(_state(module) == _STATES[module] for module in self._reached(sig))
        except KeyError:  # a class of another package
            return False

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        key = super()._index_key(sig, codegen)
        stamp = _digest(self._reached(sig))
        digest = hashlib.blake2b(repr(key).encode(), digest_size=10).hexdigest()
        name = f"{self._impl.filename_base}-{digest}"
        self._cache_file = IndexDataCacheFile(str(cache_directory(stamp)), name, stamp)
        return key


@cache
def cache_directory(stamp: str = "") -> Path:
    """Return the folder of the machine code that was compiled from files of a digest, or of none.

    It is in the folder that CHSEL_CACHE_DIR names, else in the user's cache folder, or where that
    cannot be written in a temporary one. Raises SettingError if others can write to it.
    """
    named = os.environ.get(CACHE_VARIABLE)
    user = getpass.getuser() if sys.platform == "win32" else os.getuid()  # users may be nameless
    usual = Path(AppDirs("chsel", appauthor=False).user_cache_dir, "kernels")
    defaults = usual, Path(tempfile.gettempdir(), f"chsel-{user}")
    for parent in (Path(named).expanduser(),) if named else defaults:
        folder = parent / (stamp or _digest(()))
        try:
            is_new = not folder.exists()
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
            if is_new:
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
        self._collected = True

    def on_start(self, event: Any) -> None:
        """Take note that the compilation of a function, or of one that it calls, begins."""
        if not _is_kernel(event):
            return
        if self._depth == 0:
            self._usual = _config.SLP_VECTORIZE
            _config.SLP_VECTORIZE = 1
            # The compiler makes objects by the million, over which the collector would go again.
            self._collected = gc.isenabled()
            gc.disable()
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
            if self._collected:
                gc.enable()
            self.count += 1
            if self.show is not None:
                self.show(self.count)


def _is_kernel(event: Any) -> bool:
    module: str = event.data["dispatcher"].py_func.__module__
    return module.startswith("chsel.")


_watch = _CompilerWatch()
event.register("numba:compile", _watch)
