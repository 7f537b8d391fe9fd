"""How the inner loops are compiled, and where the machine code is kept."""

from __future__ import annotations

import getpass
import hashlib
import logging
import os
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import llvmlite
import llvmlite.binding
import numba
from numba.core import event

Function = TypeVar("Function", bound=Callable[..., Any])

CACHE_VARIABLE = "CHSEL_CACHE_DIR"
config: Any = numba.core.config
_njit: Any = numba.njit  # its types leave out some options
_log = logging.getLogger(__name__)


def compiled(function: Function) -> Function:
    """`function` as machine code: made on the first call, kept on disk, free of the GIL.

    No fast-math and no contraction, so that a * b + c is rounded twice on every CPU.
    """
    previous = config.CACHE_DIR
    config.CACHE_DIR = str(cache_directory())
    try:
        made: Function = _njit(cache=True, nogil=True, error_model="numpy")(function)
        return made
    finally:
        config.CACHE_DIR = previous


def inner(function: Function) -> Function:
    """`function` for other kernels to call, not for Python.

    It cannot make arrays, so that nothing is counted when arrays change hands.
    """
    made: Function = _njit(**_INNER)(function)
    return made


def leaf(function: Function) -> Function:
    """Like `inner`, and always made part of its caller."""
    made: Function = _njit(**_INNER, forceinline=True)(function)
    return made


def spliced(function: Function) -> Function:
    """Like `leaf`, for a few lines around a large function: put into its caller before it is typed.

    It is no function of its own to the compiler, which saves it going over the large one again.
    """
    made: Function = _njit(**_INNER, inline="always")(function)
    return made


_INNER = {
    "nogil": True,
    "error_model": "numpy",
    "_nrt": False,
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}


@cache
def cache_directory() -> Path:
    """Where machine code is kept: apart for every version of the kernels, of numba, every CPU.

    In the folder that CHSEL_CACHE_DIR names, else in the user's cache folder, else in a temporary
    one of the user's own: the first that can be written.
    """
    named = os.environ.get(CACHE_VARIABLE)
    if named:
        directory = Path(named).expanduser() / _fingerprint()
        if _writable(directory):
            return directory
        _log.warning(
            "%s is %s, which cannot be written; accepted: a folder for compiled kernels. They go "
            "where they go without it",
            CACHE_VARIABLE,
            named,
        )
    temporary = Path(tempfile.gettempdir()) / f"chsel-{_user()}"
    for place in (_user_cache() / "chsel" / "kernels", temporary):
        directory = place / _fingerprint()
        if _writable(directory) and _private(place):
            return directory
    return Path(tempfile.mkdtemp(prefix="chsel-"))


def _user() -> str:
    """A name for who runs this; a number where the user may have no name, as in a container."""
    return getpass.getuser() if sys.platform == "win32" else str(os.getuid())


def _user_cache() -> Path:
    home = Path(os.path.expanduser("~"))
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", home))
    if sys.platform == "darwin":
        return home / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")


def _fingerprint() -> str:
    """Digest of all that machine code hangs on, callees in other files and the CPU included."""
    state = hashlib.blake2b(digest_size=8)
    for source in sorted(Path(__file__).parent.glob("*.py")):
        state.update(source.read_bytes())
    cpu = config.CPU_NAME or llvmlite.binding.get_host_cpu_name()
    features = config.CPU_FEATURES
    if features is None:
        features = llvmlite.binding.get_host_cpu_features().flatten()
    versions = (numba.__version__, llvmlite.__version__, sys.version, cpu, features)
    state.update("|".join(versions).encode())
    return state.hexdigest()


def _writable(directory: Path) -> bool:
    try:
        directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        tempfile.TemporaryFile(dir=directory).close()
    except OSError:
        return False
    return True


def _private(place: Path) -> bool:
    """Whether nobody else can put code here, as what is cached gets executed."""
    if sys.platform == "win32":
        return True
    state = place.stat()
    return state.st_uid == os.getuid() and not state.st_mode & 0o022


class _CompilerWatch(event.Listener):
    """Says once that kernels are being compiled, and has short vectors made of straight code.

    Numba leaves the latter out unless told for all of a process; it makes the interpolation of
    the SDF twice as fast, and changes no bit, as it reorders nothing.
    """

    def __init__(self) -> None:
        self._said = False
        self._depth = 0
        self._usual = config.SLP_VECTORIZE

    def on_start(self, event: Any) -> None:
        """The compilation of a function, or of one that it calls, begins."""
        if not _is_kernel(event):
            return
        if self._depth == 0:
            self._usual, config.SLP_VECTORIZE = config.SLP_VECTORIZE, 1
        self._depth += 1
        if not self._said:
            self._said = True
            place = cache_directory().parent
            _log.warning("compiling the kernels for this CPU: 10 to 20 s, once (kept in %s)", place)

    def on_end(self, event: Any) -> None:
        """The compilation of a function has ended."""
        if _is_kernel(event):
            self._depth -= 1
            if self._depth == 0:
                config.SLP_VECTORIZE = self._usual


def _is_kernel(event: Any) -> bool:
    module: str = event.data["dispatcher"].py_func.__module__
    return module.startswith("chsel.kernels.")


event.register("numba:compile", _CompilerWatch())
