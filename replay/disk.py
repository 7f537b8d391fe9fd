"""What a file needs to survive a power cut, and what kept it from being written."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path


def sync_file(path: Path) -> None:
    """Wait until the content of a file is on the disk. Raises OSError if it does not get there."""
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
    """The failure to write `path` that is, or caused, an error; None if it is about other things.

    A full disk is reported without the name of a file.
    """
    cause = error if isinstance(error, OSError) else error.__cause__
    if isinstance(cause, OSError) and cause.filename in (None, path, str(path)):
        return cause
    return None
