"""Where the machine code of kernels is kept: numba's cache, in a folder for each state of the code.

A kernel contains what it calls and the constants of other files, which numba does not check. So
the folder is named by a digest of all files of the package: code of changed source is never loaded.
"""

from __future__ import annotations

import getpass
import hashlib
import logging
import os
import pickle
import re
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    _CacheLocator,
)
from numba.misc.appdirs import AppDirs

from chsel.errors import SettingError

CACHE_VARIABLE = "CHSEL_CACHE_DIR"
KEPT_FOLDERS = 8  # the most recently used, each of a state of the code

_OPTIONS = (  # of numba, which change machine code; it distinguishes CPUs itself
    *("OPT", "BOUNDSCHECK", "LOOP_VECTORIZE", "DISABLE_INTEL_SVML", "ENABLE_PROFILING"),
    *("DEBUGINFO_DEFAULT", "EXTEND_VARIABLE_LIFETIMES"),
    *("LLVM_REFPRUNE_PASS", "LLVM_REFPRUNE_FLAGS"),
)
_OTHERS_WRITE = 0o022
_UNMAPPED = 65534  # owner of what belongs to root outside of a container
_PACKAGE = Path(__file__).parents[1]
_config: Any = numba.core.config
_log = logging.getLogger(__name__)


def _states() -> list[tuple[int, int]]:
    """Time of the last change and size of each file of the package; empty if one is gone."""
    try:
        return [(state.st_mtime_ns, state.st_size) for state in map(os.stat, _FILES)]
    except OSError:
        return []


def _digest(*parts: bytes) -> str:
    return hashlib.blake2b(b"\0".join(parts), digest_size=10).hexdigest()


_FILES = sorted(map(str, _PACKAGE.rglob("*.py")))
_STATES = _states()  # before they are read
_STAMP = _digest(
    f"{numba.__version__} {llvmlite.__version__} {sys.version}".encode(),
    *(os.path.relpath(file, _PACKAGE).encode() + Path(file).read_bytes() for file in _FILES),
)


def is_cacheable(function: Callable[..., Any]) -> bool:
    """Whether a function is in a file of this package: the digest is of no others."""
    return function.__code__.co_filename in _FILES


class _Locator(_CacheLocator):
    """Where numba keeps the code of a function, and the stamp of what it was compiled from."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file = file
        self._place = f"{function.__module__}-{function.__code__.co_firstlineno}"

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> _Locator:
        return cls(py_func, py_file)

    def get_cache_path(self) -> str:
        return str(cache_directory())

    def ensure_cache_path(self) -> None:
        _make(cache_directory())

    def get_source_stamp(self) -> str:
        return _STAMP

    def get_disambiguator(self) -> str:
        return self._place


class _Results(CompileResultCacheImpl):
    _locator_classes: list[type[object]] = [_Locator]  # noqa: RUF012


class KernelCache(FunctionCache):
    """The kept code of one kernel.

    In a file for each signature, as numba's index of several may name the wrong one after two
    processes have written it at once.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        # Not numba's, which asks for the folder: it is not needed before the first call.
        self._py_func, self._impl = function, _Results(function)
        self.enable()

    @property
    def cache_path(self) -> str:
        """The folder that the code is in."""
        return str(cache_directory())

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The code for types of arguments, None if it must be compiled."""
        if _states() != _STATES:  # this process may have imported other code than was digested
            return None
        try:
            return super().load_overload(sig, target_context)
        except (EOFError, pickle.UnpicklingError):  # of a disk that was full, or lost power
            self._cache_file.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the code for types of arguments. If that fails, it is compiled again next time."""
        if _states() != _STATES:
            return
        try:
            super().save_overload(sig, data)
            _prune(cache_directory())
        except OSError as error:
            _log.warning("machine code cannot be kept in %s: %s", cache_directory(), error)

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        options = (str(getattr(_config, name)) for name in _OPTIONS)
        key = *super()._index_key(sig, codegen), *options
        name = f"{self._impl.filename_base}-{_digest(repr(key).encode())}"
        self._cache_file = IndexDataCacheFile(self.cache_path, name, _STAMP)
        return key


@cache
def cache_directory() -> Path:
    """The folder of the machine code of this state of the package.

    It is in the folder that CHSEL_CACHE_DIR names, else in the user's cache folder, or where that
    cannot be used in a temporary one. Raises SettingError if it is not for this user alone.
    """
    named = os.environ.get(CACHE_VARIABLE)
    places = (Path(named).expanduser(),) if named else _default_places()
    for place in places:
        wrong = _unusable(place, place / _STAMP)
        if wrong is None:
            os.utime(place / _STAMP)
            return place / _STAMP
    name = CACHE_VARIABLE if named else "the folder of compiled kernels"
    raise SettingError(f"{name} is {place}, {wrong}")


@cache
def _prune(used: Path) -> None:
    """Remove the folders that were not used for longest, once in a process.

    A process that still uses one compiles again.
    """
    others = [
        folder
        for folder in used.parent.iterdir()
        if re.fullmatch("[0-9a-f]{16,20}", folder.name) and folder != used  # 16: of old versions
    ]
    others.sort(key=lambda folder: folder.stat().st_mtime)
    for folder in others[: 1 - KEPT_FOLDERS]:
        shutil.rmtree(folder, ignore_errors=True)


def _default_places() -> tuple[Path, Path]:
    """The user's cache folder, and one by number in the temporary one: users may be nameless."""
    user = getpass.getuser() if sys.platform == "win32" else os.getuid()
    cached = AppDirs("chsel", appauthor=False).user_cache_dir
    return Path(cached, "kernels"), Path(tempfile.gettempdir(), f"chsel-{user}")


def _unusable(place: Path, folder: Path) -> str | None:
    """Make `folder` in `place`; returns why it cannot be used, None if it can."""
    try:
        _make(folder)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return "which cannot be written; accepted: a folder for compiled kernels"
    if sys.platform == "win32":
        return None
    for state in (place.stat(), folder.stat()):
        if state.st_uid != os.getuid() or state.st_mode & _OTHERS_WRITE:
            return (
                "which others can write to, and compiled kernels are executed; accepted: a folder "
                "that only you can write to (chmod go-w)"
            )
    for parent in (*place.absolute().parents, *place.resolve().parents):
        state = parent.stat()
        others_write = state.st_mode & _OTHERS_WRITE and not state.st_mode & stat.S_ISVTX
        if others_write or state.st_uid not in (0, os.getuid(), _UNMAPPED):
            return (
                f"whose parent {parent} others can write to, and compiled kernels are executed; "
                "accepted: a folder whose parents only you and root can write to"
            )
    return None


def _make(directory: Path) -> None:
    """Make a folder and its missing parents, each private whatever the umask is."""
    for folder in (*reversed(directory.parents), directory):
        if not folder.exists():
            folder.mkdir(mode=0o700, exist_ok=True)
