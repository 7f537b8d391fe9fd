"""Files that are whole once they have their names, and the digest that names one."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from chsel.errors import ChselError, RecordingError
from chsel.numerics.arrays import refuse_special_file

_DIGEST_SIZE = 16  # bytes


def sync_file(path: Path) -> None:
    """Wait until the content of a file is on the disk. Raise OSError if it does not get there."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Wait until the names in a folder are on the disk, where the system can do that."""
    with suppress(OSError):  # of Windows, and of some network file systems
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


def disk_error(error: BaseException, path: Path) -> OSError | None:
    """Return the failure to write `path` behind an error; None if it is about other things.

    A full disk is reported without the name of a file.
    """
    cause = error if isinstance(error, OSError) else error.__cause__
    if isinstance(cause, OSError) and cause.filename in (None, path, str(path)):
        return cause
    return None


class WritingError(ChselError):
    """A file cannot be written, so that going on is of no use."""


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Open a path beside `path`; it becomes `path` if all went well, else it is removed.

    It is on the disk then, for good. Raise RecordingError if there is such a file already, before
    or after, and if it cannot be written.
    """
    require_new(path)
    require_folder(path)
    beside = _beside(path)
    try:
        with _placed(beside, path, rename=_rename):
            yield beside
    except (OSError, RecordingError) as error:
        reason = disk_error(error, beside)
        if reason is None:
            raise
        raise RecordingError(f"{path} cannot be written: {reason.strerror or reason}") from error


@contextmanager
def whole_file(path: Path, accepted: str = "an out=DIR that can be written") -> Iterator[Path]:
    """Open a path beside `path` to write to; it replaces `path` once all is on the disk.

    accepted: what to do about it if either cannot be written: the end of the WritingError.
    """
    beside = _beside(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _placed(beside, path, rename=Path.replace):
            yield beside
    except (OSError, RecordingError) as error:
        reason = error if isinstance(error, OSError) else error.__context__
        if not isinstance(reason, OSError):  # what was to be recorded is not valid
            raise
        raise WritingError(
            f"{path} cannot be written ({reason.strerror or reason}); accepted: {accepted}"
        ) from error


def _beside(path: Path) -> Path:
    return path.with_name(f".{path.name[:100]}.{os.urandom(4).hex()}")


@contextmanager
def _placed(beside: Path, path: Path, *, rename: Callable[[Path, Path], object]) -> Iterator[None]:
    """Give a file that is written within this context its name, once it is on the disk."""
    try:
        yield
        sync_file(beside)  # else a power cut may leave the name without the content
        rename(beside, path)
        sync_folder(path.parent)
    finally:
        with suppress(OSError):
            beside.unlink(missing_ok=True)


def require_new(path: Path) -> None:
    """Raise RecordingError if there is something at `path`."""
    if os.path.lexists(path):
        raise RecordingError(f"{path} exists; accepted: the name of a new file")


def require_folder(path: Path) -> None:
    """Raise RecordingError unless the folder of `path` exists."""
    if not path.parent.is_dir():
        raise RecordingError(f"folder {path.parent} does not exist; accepted: a file in one")


def _rename(beside: Path, path: Path) -> None:
    """Give a file its name, without ever taking it from another one."""
    try:
        path.hardlink_to(beside)
    except FileExistsError:
        require_new(path)
    except OSError:  # a file system without links: reserve the name, then replace what is ours
        with path.open("xb"):
            beside.replace(path)


def file_digest(path: Path) -> str:
    """Return BLAKE2b (128 bit, hexadecimal) of a file's bytes, as `b2sum -l 128` prints it."""
    refuse_special_file(str(path), path, error=RecordingError)
    try:
        with path.open("rb") as file:
            state = hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=_DIGEST_SIZE))
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror or error}") from error
    return state.hexdigest()
