"""How kernels are compiled, and where their machine code is kept."""

from __future__ import annotations

import atexit
import getpass
import hashlib
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import llvmlite
import llvmlite.binding
import numba
from filelock import FileLock
from numba.core import event
from numba.extending import overload

CACHE_VARIABLE = "CHSEL_CACHE_DIR"
Function = TypeVar("Function", bound=Callable[..., Any])

_OTHERS_WRITE = 0o022
_config: Any = numba.core.config
_njit: Any = numba.njit  # its types leave out some options
_log = logging.getLogger(__name__)


@cache
def cache_directory() -> Path:
    """The folder of machine code, one per version of the kernels and of numba, and per CPU.

    It is in the folder that CHSEL_CACHE_DIR names, else in the user's cache folder, else in a
    private temporary one: the first that is writable for this user alone.
    """
    fingerprint = _fingerprint()
    named = os.environ.get(CACHE_VARIABLE)
    if named:
        place = Path(named).expanduser()
        wrong = _unusable(place, fingerprint)
        if wrong is None:
            return place / fingerprint
        _log.warning("%s is %s, %s. The default folder is used", CACHE_VARIABLE, named, wrong)
    temporary = Path(tempfile.gettempdir()) / f"chsel-{_user()}"
    for place in (_user_cache() / "chsel" / "kernels", temporary):
        _make_private(place)
        if _unusable(place, fingerprint) is None:
            return place / fingerprint
    directory = Path(tempfile.mkdtemp(prefix="chsel-"))
    atexit.register(shutil.rmtree, directory, ignore_errors=True)
    return directory


def has_kernels() -> bool:
    """Whether any kernel was compiled and kept earlier."""
    return any(cache_directory().rglob("*.nbi"))


def _user() -> str:
    """The user's name; elsewhere than on Windows the number, as containers have nameless users."""
    return getpass.getuser() if sys.platform == "win32" else str(os.getuid())


def _user_cache() -> Path:
    home = Path(os.path.expanduser("~"))
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", home))
    if sys.platform == "darwin":
        return home / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")


def kernel_sources() -> list[Path]:
    """The files of this package that hold kernels: this file, and those that import it."""
    this_file = Path(__file__)
    return sorted(
        source
        for source in this_file.parents[1].rglob("*.py")
        if source == this_file or b"from chsel.numerics.compiler import" in source.read_bytes()
    )


def _fingerprint() -> str:
    """Digest of all that machine code depends on, callees in other files and the CPU included."""
    state = hashlib.blake2b(digest_size=8)
    for source in kernel_sources():
        state.update(source.read_bytes())
    cpu = _config.CPU_NAME or llvmlite.binding.get_host_cpu_name()
    features = _config.CPU_FEATURES
    if features is None:
        features = llvmlite.binding.get_host_cpu_features().flatten()
    versions = (numba.__version__, llvmlite.__version__, sys.version, cpu, features)
    state.update("|".join(versions).encode())
    return state.hexdigest()


def _unusable(place: Path, fingerprint: str) -> str | None:
    """Make the folder of that name in `place`; returns why it cannot be used, None if it can."""
    directory = place / fingerprint
    try:
        _make(directory)
        tempfile.TemporaryFile(dir=directory).close()
    except OSError:
        return "which cannot be written; accepted: a folder for compiled kernels"
    if not all(_is_private(folder) for folder in (place, directory)):
        return (
            "which others can write to, and compiled kernels are executed; accepted: a folder "
            "that only you can write to (chmod go-w)"
        )
    return None


def _make(directory: Path) -> None:
    """Make a folder and its missing parents, each private whatever the umask is."""
    missing = [folder for folder in (directory, *directory.parents) if not folder.exists()]
    for folder in reversed(missing):
        folder.mkdir(mode=0o700, exist_ok=True)


def _make_private(place: Path) -> None:
    """Take write permission from others, to whom an earlier version may have left it."""
    try:
        if place.is_dir() and not _is_private(place):
            place.chmod(place.stat().st_mode & ~_OTHERS_WRITE)
    except OSError:  # somebody else's folder
        return


def _is_private(place: Path) -> bool:
    """Whether nobody else can write to a folder."""
    if sys.platform == "win32":
        return True
    state = place.stat()
    return state.st_uid == os.getuid() and not state.st_mode & _OTHERS_WRITE


def compiled(function: Function) -> Function:
    """`function` as machine code: compiled on the first call, kept on disk, run without the GIL.

    Without fast-math and contraction, so that a * b + c is rounded twice on every CPU.
    """
    previous = _config.CACHE_DIR
    _config.CACHE_DIR = str(cache_directory())
    try:
        kernel: Any = _njit(cache=True, nogil=True, error_model="numpy")(function)
        kernel._cache.save_overload = _one_at_a_time(kernel._cache.save_overload)
        return kernel
    finally:
        _config.CACHE_DIR = previous


def _one_at_a_time(save: Callable[..., None]) -> Callable[..., None]:
    """`save`, but by one process at a time.

    Numba reads the index of a kernel, names a file of machine code and writes both. Two processes
    at once, with different types of arguments, would give their code the same name.
    """

    def locked(*arguments: Any) -> None:
        with FileLock(cache_directory() / "saving.lock"):
            save(*arguments)

    return locked


def inner(function: Function) -> Function:
    """`function` for other kernels to call, not for Python.

    It cannot make arrays, so that no references are counted when arrays are passed.
    """
    kernel: Function = _njit(**_INNER)(function)
    return kernel


def leaf(function: Function) -> Function:
    """Like `inner`, and always inlined into its caller."""
    kernel: Function = _njit(**_INNER, forceinline=True)(function)
    return kernel


def spliced(function: Function) -> Function:
    """Like `leaf`, but inlined before types are inferred.

    For a few lines around a large function, which the compiler then goes over only once.
    """
    kernel: Function = _njit(**_INNER, inline="always")(function)
    return kernel


def implements(name: Callable[..., Any], model: type) -> Callable[[Function], Function]:
    """Decorator of what kernels that call `name` run if its first argument is of type `model`.

    model: a class of NamedTuples. So one kernel, compiled for each, serves several models.
    """

    def register(function: Function) -> Function:
        def chosen(first: Any, *others: Any) -> Function | None:
            return function if getattr(first, "instance_class", None) is model else None

        options: Any = {**_INNER, "forceinline": True}
        overload(name, jit_options=options, strict=False)(chosen)
        return function

    return register


_INNER = {
    "nogil": True,
    "error_model": "numpy",
    "_nrt": False,
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}


@contextmanager
def watched(show: Callable[[int], None]) -> Iterator[None]:
    """Within this context, call `show` with the number of kernels compiled, instead of the notice.

    It is called with 0 when the first compilation begins, and after each.
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
        """The compilation of a function, or of one that it calls, begins."""
        if not _is_kernel(event):
            return
        if self._depth == 0:
            self._usual, _config.SLP_VECTORIZE = _config.SLP_VECTORIZE, 1
            self._report()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """The compilation of a function has ended."""
        if not _is_kernel(event):
            return
        self._depth -= 1
        if self._depth == 0:
            _config.SLP_VECTORIZE = self._usual
            self.count += 1
            if self.show is not None:
                self.show(self.count)

    def _report(self) -> None:
        """Tell who watches; without a watcher, log a single line per process."""
        if self.show is not None:
            if self.count == 0:
                self.show(0)
        elif not self._noticed:
            place = cache_directory().parent
            if has_kernels():
                _log.warning("compiling the kernels that are still missing (kept in %s)", place)
            else:
                text = "compiling the kernels for this CPU, once: up to a minute (kept in %s)"
                _log.warning(text, place)
        self._noticed = True


def _is_kernel(event: Any) -> bool:
    module: str = event.data["dispatcher"].py_func.__module__
    return module.startswith("chsel.")


_watch = _CompilerWatch()
event.register("numba:compile", _watch)
