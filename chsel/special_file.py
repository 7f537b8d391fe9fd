"""FIFOs, sockets and devices: no input is one, and reading one can wait for ever."""

from __future__ import annotations

import stat
from pathlib import Path

from chsel.errors import ChselError

_KINDS = (
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def refuse_special_file(name: str, path: Path, error: type[ChselError]) -> None:
    """Raise `error` if `path` is a FIFO, a socket or a device, or a link to one.

    name: of the file in the message, such as "recording a.mcap". Whether the file exists, is a
    folder or may be read is for the system to say when it is opened.
    """
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return
    for is_kind, kind in _KINDS:
        if is_kind(mode):
            raise error(f"{name} is {kind}; accepted: a file")
