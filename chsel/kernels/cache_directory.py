"""Where machine code is kept, so that nobody but its owner can have written what is executed."""

from __future__ import annotations

import atexit
import getpass
import hashlib
import logging
import os
import shutil
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding
import numba

CACHE_VARIABLE = "CHSEL_CACHE_DIR"
_OTHERS_WRITE = 0o022
_config: Any = numba.core.config
_log = logging.getLogger(__name__)


@cache
def cache_directory() -> Path:
    """The folder of machine code: one for every version of the kernels and of numba, every CPU.

    In the folder that CHSEL_CACHE_DIR names, else in the user's cache folder, else in a temporary
    one of the user's own: the first that can be written, and that nobody else can write to.
    """
    fingerprint = _fingerprint()
    named = os.environ.get(CACHE_VARIABLE)
    if named:
        place = Path(named).expanduser()
        wrong = _unusable(place, fingerprint)
        if wrong is None:
            return place / fingerprint
        _log.warning("%s is %s, %s. They go where they go without it", CACHE_VARIABLE, named, wrong)
    temporary = Path(tempfile.gettempdir()) / f"chsel-{_user()}"
    for place in (_user_cache() / "chsel" / "kernels", temporary):
        _make_private(place)
        if _unusable(place, fingerprint) is None:
            return place / fingerprint
    directory = Path(tempfile.mkdtemp(prefix="chsel-"))
    atexit.register(shutil.rmtree, directory, ignore_errors=True)
    return directory


def has_kernels() -> bool:
    """Whether any kernel was compiled and kept before."""
    return any(cache_directory().rglob("*.nbi"))


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
    """Digest of all that machine code depends on: callees in other files and the CPU included."""
    state = hashlib.blake2b(digest_size=8)
    for source in sorted(Path(__file__).parent.glob("*.py")):
        state.update(source.read_bytes())
    cpu = _config.CPU_NAME or llvmlite.binding.get_host_cpu_name()
    features = _config.CPU_FEATURES
    if features is None:
        features = llvmlite.binding.get_host_cpu_features().flatten()
    versions = (numba.__version__, llvmlite.__version__, sys.version, cpu, features)
    state.update("|".join(versions).encode())
    return state.hexdigest()


def _unusable(place: Path, fingerprint: str) -> str | None:
    """Why the folder of that name in `place`, which is made, cannot be used; None if it can."""
    directory = place / fingerprint
    try:
        _make(directory)
        tempfile.TemporaryFile(dir=directory).close()
    except OSError:
        return "which cannot be written; accepted: a folder for compiled kernels"
    if not all(_is_private(folder) for folder in (place, directory)):
        return (
            "which others can write to, and compiled kernels are executed; accepted: a folder of "
            "your own that only you can write to (chmod go-w)"
        )
    return None


def _make(directory: Path) -> None:
    """Make a folder and those above that do not exist, each for its owner alone.

    Whatever the umask is: a default of several distributions leaves folders to a group.
    """
    missing = [folder for folder in (directory, *directory.parents) if not folder.exists()]
    for folder in reversed(missing):
        folder.mkdir(mode=0o700, exist_ok=True)


def _make_private(place: Path) -> None:
    """Take write permission from others, where an earlier version left it to them."""
    try:
        if place.is_dir() and not _is_private(place):
            place.chmod(place.stat().st_mode & ~_OTHERS_WRITE)
    except OSError:  # somebody else's folder
        return


def _is_private(place: Path) -> bool:
    """Whether nobody else can put code here."""
    if sys.platform == "win32":
        return True
    state = place.stat()
    return state.st_uid == os.getuid() and not state.st_mode & _OTHERS_WRITE
