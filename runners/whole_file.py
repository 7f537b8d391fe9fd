"""Files that have their names only once they are whole, whoever else writes them as well."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from chsel.errors import ChselError, RecordingError


class WritingError(ChselError):
    """A file cannot be written, so that going on is of no use."""


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A path beside `path` to write to, which replaces `path` once all went well.

    Raises WritingError, with the reason, if either cannot be written.
    """
    beside = path.with_name(f".{path.name}.{os.urandom(4).hex()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield beside
        with beside.open("rb") as written:
            os.fsync(written.fileno())  # else a power cut may leave the name without the content
        beside.replace(path)
    except (OSError, RecordingError) as error:
        reason = error if isinstance(error, OSError) else error.__context__
        if not isinstance(reason, OSError):  # what was to be recorded is no good
            raise
        raise WritingError(
            f"{path} cannot be written ({reason.strerror or reason}); accepted: an out=DIR that "
            "can be written"
        ) from error
    finally:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
