"""Where the machine code of kernels is kept: a file for each kernel and types of its arguments.

A file is named by all that its code depends on, so that it is never stale and never overwritten
with another.
"""

from __future__ import annotations

import atexit
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
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding
import numba
from filelock import FileLock, Timeout
from numba.core import sigutils, types
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

from chsel.numerics.kernel_sources import code_digest, loaded, signature_text

CACHE_VARIABLE = "CHSEL_CACHE_DIR"
KEPT_DAYS = 60  # how long a folder of code stays that nobody uses
KEPT_FOLDERS = 16  # the most, of versions and CPUs
KEPT_VERSIONS = 8  # of the code of a kernel for the same types of arguments

_OTHERS_WRITE = 0o022
_UNMAPPED = 65534  # owner of what belongs to root outside of a container
_DAY = 86400.0
_CHECK_SIZE = 16  # bytes of the digest before the code in a file
_LOCK = ".lock"
_PATIENCE = 120.0  # seconds, after which another process is taken to hang
_config: Any = numba.core.config
_log = logging.getLogger(__name__)


class KernelCache(NullCache):
    """The kept code of one kernel, as numba asks for it."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._claims: dict[str, FileLock] = {}
        loaded(function)

    @property
    def cache_path(self) -> str:
        """The folder that the code is in."""
        return str(cache_directory())

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:
        """The code for types of arguments, or None if it must be compiled.

        While another process compiles it, waits for that.
        """
        target_context.refresh()
        name = self._file_name(sig)
        if name is None:
            return None
        payload = _kept(name)
        if payload is None:
            self._claim(name)
            payload = _kept(name)  # by the process that had claimed it
            if payload is None:
                return None
            self.release()
        return CompileResult._rebuild(target_context, *pickle.loads(payload))

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the code for types of arguments. If that fails, it is compiled again next time."""
        name = self._file_name(sig)
        if name is None or data.lifted or data.library.has_dynamic_globals:
            return
        payload = dumps(data._reduce())
        path = cache_directory() / name
        try:
            _make(path.parent)
            _write(path, _digest(payload, name) + payload)
            _prune(path)
        except OSError as error:
            _log.warning("machine code cannot be kept in %s: %s", path.parent, error)
        finally:
            self.release()

    def release(self) -> None:
        """Let other processes compile what this one does not: it has, or it has failed to."""
        while self._claims:
            name, lock = self._claims.popitem()
            lock.release()
            (cache_directory() / name).with_suffix(_LOCK).unlink(missing_ok=True)

    def _claim(self, name: str) -> None:
        """Wait until no other process compiles the code of that name, and let none begin to."""
        lock = FileLock((cache_directory() / name).with_suffix(_LOCK))
        try:
            lock.acquire(timeout=_PATIENCE, poll_interval=0.05)
        except (Timeout, OSError, NotImplementedError):  # a folder that cannot be locked
            return
        self._claims[name] = lock

    def _file_name(self, sig: Any) -> str | None:
        arguments: tuple[types.Type, ...] = sigutils.normalize_signature(sig)[0]
        digest = code_digest(self._function, arguments)
        if digest is None:
            return None
        module = self._function.__module__.rpartition(".")[2]
        kernel = f"{module}.{self._function.__qualname__}".replace("<", "").replace(">", "")
        kinds = hashlib.blake2b(signature_text(arguments).encode(), digest_size=4).hexdigest()
        return f"{kernel}-{kinds}-{digest}.nbc"


@cache
def cache_directory() -> Path:
    """The folder of machine code, one per version of numba and of Python, and per CPU.

    It is in the folder that CHSEL_CACHE_DIR names, else in the user's cache folder, else in a
    private temporary one: the first that is writable for this user alone.
    """
    named, folder = os.environ.get(CACHE_VARIABLE), _environment()
    if named:
        place = Path(named).expanduser()
        wrong = _unusable(place, folder)
        if wrong is None:
            return place / folder
        _log.warning("%s is %s, %s. The default folder is used", CACHE_VARIABLE, named, wrong)
    temporary = Path(tempfile.gettempdir()) / f"chsel-{_user()}"
    for place in (_user_cache() / "chsel" / "kernels", temporary):
        _make_private(place)
        if _unusable(place, folder) is None:
            return place / folder
    directory = Path(tempfile.mkdtemp(prefix="chsel-"))
    atexit.register(shutil.rmtree, directory, ignore_errors=True)
    return directory


def has_kernels() -> bool:
    """Whether any kernel was compiled and kept earlier."""
    return kept_count() > 0


def kept_count() -> int:
    """How many kernels were compiled and kept, those included that other processes compile now."""
    return sum(1 for _ in cache_directory().glob("*.nbc"))


def _environment() -> str:
    """Digest of what machine code depends on besides its source: versions and the CPU."""
    cpu = _config.CPU_NAME or llvmlite.binding.get_host_cpu_name()
    features = _config.CPU_FEATURES
    if features is None:
        features = llvmlite.binding.get_host_cpu_features().flatten()
    versions = (numba.__version__, llvmlite.__version__, sys.version, cpu, features)
    return hashlib.blake2b("|".join(versions).encode(), digest_size=8).hexdigest()


def _digest(payload: bytes, name: str) -> bytes:
    """Of the code in the file of that name, so that no kernel loads another's."""
    return hashlib.blake2b(name.encode() + payload, digest_size=_CHECK_SIZE).digest()


def _kept(name: str) -> bytes | None:
    """What the cache holds by that name, or None."""
    path = cache_directory() / name
    try:
        payload = _checked(path.read_bytes(), name)
    except OSError:
        return None
    _touch(path)
    return payload


def _checked(whole: bytes, name: str) -> bytes | None:
    """What the file of that name holds behind its digest, None if it is damaged."""
    payload = whole[_CHECK_SIZE:]
    return payload if _digest(payload, name) == whole[:_CHECK_SIZE] else None


def _write(path: Path, whole: bytes) -> None:
    """Write a file that other processes see whole or not at all."""
    handle, name = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(whole)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def _touch(path: Path) -> None:
    """Note once a day that a file is in use."""
    try:
        if time.time() - path.stat().st_mtime > _DAY:
            os.utime(path)
    except OSError:  # a folder that this user can only read
        return


def _prune(path: Path) -> None:
    """Remove what the file just written makes superfluous: the oldest versions of its kernel."""
    _prune_folders(path.parent.parent, path.parent.name)
    siblings = path.parent.glob(f"{path.name.rpartition('-')[0]}-*.nbc")
    for old in sorted(siblings, key=_last_use, reverse=True)[KEPT_VERSIONS:]:
        old.unlink(missing_ok=True)


@cache
def _prune_folders(place: Path, used: str) -> None:
    """Remove folders of code that nobody has used for long, once in a process."""
    folders = [
        folder
        for folder in place.iterdir()
        if re.fullmatch("[0-9a-f]{16}", folder.name) and folder.name != used and folder.is_dir()
    ]
    ages = {folder: time.time() - max(map(_last_use, folder.rglob("*"))) for folder in folders}
    by_age = sorted(folders, key=ages.__getitem__)
    for i, folder in enumerate(by_age):
        if i >= KEPT_FOLDERS - 1 or ages[folder] > KEPT_DAYS * _DAY:
            shutil.rmtree(folder, ignore_errors=True)


def _last_use(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:  # another process has removed it
        return 0.0


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
    for parent in (*place.absolute().parents, *place.resolve().parents):
        if not _is_safe(parent):
            return (
                f"whose parent {parent} others can write to, and compiled kernels are executed; "
                "accepted: a folder whose parents only you and root can write to"
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


def _is_safe(parent: Path) -> bool:
    """Whether nobody else but root can replace what this user has in a folder."""
    if sys.platform == "win32":
        return True
    state = parent.stat()
    sticky = bool(state.st_mode & stat.S_ISVTX)
    owners = 0, os.getuid(), _UNMAPPED
    return state.st_uid in owners and (sticky or not state.st_mode & _OTHERS_WRITE)
