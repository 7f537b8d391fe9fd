"""Files that have their names only once they are whole, whoever else writes them as well."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from chsel.errors import ChselError, RecordingError
from replay.files import sync_file, sync_folder


class WritingError(ChselError):
    """A file cannot be written, so that going on is of no use."""


@contextmanager
def whole_file(path: Path, accepted: str = "an out=DIR that can be written") -> Iterator[Path]:
    """A path beside `path` to write to, which replaces `path` once all is on the disk.

    accepted: what to do about it if either cannot be written: the end of the WritingError.
    """
    beside = path.with_name(f".{path.name}.{os.urandom(4).hex()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield beside
        sync_file(beside)  # else a power cut may leave the name without the content
        beside.replace(path)
        sync_folder(path.parent)
    except (OSError, RecordingError) as error:
        reason = error if isinstance(error, OSError) else error.__context__
        if not isinstance(reason, OSError):  # what was to be recorded is no good
            raise
        raise WritingError(
            f"{path} cannot be written ({reason.strerror or reason}); accepted: {accepted}"
        ) from error
    finally:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
