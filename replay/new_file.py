"""A file that has its name only once it is whole."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from chsel.errors import RecordingError
from replay.disk import disk_error, sync_file, sync_folder


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """A path beside `path` to write to; it becomes `path` if all went well, else it is removed.

    It is on the disk then, for good. Raises RecordingError if there is such a file already, before
    or after, and if it cannot be written.
    """
    _check_free(path)
    beside = path.with_name(f".{path.name[:100]}.{os.urandom(4).hex()}")
    try:
        yield beside
        sync_file(beside)
        _rename(beside, path)
        sync_folder(path.parent)
    except (OSError, RecordingError) as error:
        reason = disk_error(error, beside)
        if reason is None:
            raise
        raise RecordingError(f"{path} cannot be written: {reason.strerror or reason}") from error
    finally:
        with suppress(OSError):
            beside.unlink(missing_ok=True)


def _check_free(path: Path) -> None:
    if os.path.lexists(path):
        raise RecordingError(f"{path} exists; accepted: the name of a new file")
    if not path.parent.is_dir():
        raise RecordingError(f"folder {path.parent} does not exist; accepted: a file in one")


def _rename(beside: Path, path: Path) -> None:
    """Give a file its name, without ever taking it from another one."""
    try:
        path.hardlink_to(beside)
    except FileExistsError:
        _check_free(path)
    except OSError:  # a file system without links: reserve the name, then replace what is ours
        with path.open("xb"):
            beside.replace(path)
