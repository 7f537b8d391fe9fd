"""The digest that names a file as the source of another."""

from __future__ import annotations

import hashlib
from pathlib import Path

from chsel.errors import RecordingError
from chsel.problem.file_checks import refuse_special_file

_DIGEST_SIZE = 16  # bytes


def file_digest(path: Path) -> str:
    """BLAKE2b (128 bit, hexadecimal) of a file's bytes, as `b2sum -l 128` prints it."""
    refuse_special_file(str(path), path, RecordingError)
    try:
        with path.open("rb") as file:
            state = hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=_DIGEST_SIZE))
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror or error}") from error
    return state.hexdigest()
