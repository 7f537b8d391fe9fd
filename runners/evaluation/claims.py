"""Claims on pieces of work, so that several runs in one folder share it.

A claim is a lock that the operating system lifts when its holder dies, so none is ever stale. On a
file system without locks every claim is given: work may be done twice then, and files, which are
written whole and to the same content, are none the worse.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from replay.files import WritingError

FOLDER = ".claims"


class ClaimedError(Exception):
    """Somebody else does this."""


@contextmanager
def claimed(folder: Path, name: str, *, wait: bool = False) -> Iterator[bool]:
    """Hold the claim `name` of an evaluation's folder; gives whether others are kept out by it.

    Raises ClaimedError if somebody else holds it, unless told to wait.
    """
    path = folder / FOLDER / f"{name}.lock"
    lock = FileLock(path, timeout=-1 if wait else 0)
    held = True
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout:
        raise ClaimedError(name) from None
    except NotImplementedError:
        held = False
    except OSError as error:
        raise WritingError(
            f"{path} cannot be written ({error.strerror or error}); accepted: an out=DIR that can "
            "be written"
        ) from error
    try:
        yield held
    finally:
        if held:
            lock.release()
