"""Checks of files from outside: no device or pipe, archives of arrays whole and not too large."""

from __future__ import annotations

import stat
import zipfile
from collections import Counter
from collections.abc import Collection
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from chsel.errors import ChselError

MOST_BYTES = 512 * 2**20  # of the arrays of an .npz file, unpacked: 16 million points with steps

_SPECIAL_FILES = (
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
_ENTRY = b"PK\x01\x02"  # begins each entry of a zip directory
_ENCRYPTED = 0x1  # bit of a zip member's flags
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # zipfile limits only their unpacking
_PIECE = 2**20  # bytes that are unpacked at once
_LONGEST_NAME = 60


def refuse_special_file(name: str, path: Path, error: type[ChselError]) -> None:
    """Raise `error` if `path` is a FIFO, a socket or a device, or a link to one.

    name: of the file in the message, such as "recording a.mcap". Other paths pass, also those that
    do not exist or cannot be opened.
    """
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return
    for is_kind, kind in _SPECIAL_FILES:
        if is_kind(mode):
            raise error(f"{name} is {kind}; accepted: a file")


def read_npz(
    path: Path,
    *,
    accepted: Collection[str] | None = None,
    most_bytes: int = MOST_BYTES,
    error: type[ChselError],
) -> dict[str, np.ndarray[Any, Any]]:
    """The arrays by name; every checksum is compared, and no pickled object is loaded.

    accepted: names that the arrays may have (None: any). most_bytes: limit of all arrays, unpacked.
    Raises `error` with a message of one line for any defect of the file.
    """
    refuse_special_file("it", path, error)
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            _check_directory(path, archive.start_dir, len(members))
            _check_members(members, accepted, most_bytes, error)
            return {_array_name(member): _array(archive, member) for member in members}
    except ChselError:
        raise
    except Exception as problem:  # zipfile, its decompressors and numpy raise many kinds
        reason = " ".join(str(problem).split()) or type(problem).__name__
        raise error(f"not a readable .npz file ({reason[:200]})") from None


def _check_directory(path: Path, start: int, count: int) -> None:
    """Raise ValueError unless the directory from byte `start` on lists `count` arrays.

    zipfile skips entries that a damaged length makes part of the previous one.
    """
    with path.open("rb") as file:
        file.seek(start)
        listed = file.read().count(_ENTRY)
    if listed != count:
        raise ValueError(f"its directory lists {listed} arrays, and {count} can be read")


def _check_members(
    members: list[zipfile.ZipInfo],
    accepted: Collection[str] | None,
    most_bytes: int,
    error: type[ChselError],
) -> None:
    """Raise `error` for members that must not be unpacked."""
    counts = Counter(map(_array_name, members))
    for member in members:
        name = _array_name(member)
        shown = (name if name.isidentifier() else repr(name))[:_LONGEST_NAME]
        if accepted is not None and name not in accepted:
            raise error(f"array {shown} is unknown; accepted: {', '.join(accepted)}")
        if counts[name] > 1:
            raise error(f"array {shown} is there {counts[name]} times; accepted: once")
        if member.flag_bits & _ENCRYPTED:
            raise error(f"array {shown} is encrypted; accepted: arrays without a password")
        if member.compress_type not in _COMPRESSIONS:
            raise error(f"array {shown} is not compressed as numpy does; accepted: np.savez")
    size = sum(member.file_size for member in members)  # zipfile unpacks no more than this
    if size > most_bytes:
        raise error(
            f"its arrays have {size / 2**20:.0f} MiB unpacked; "
            f"accepted: at most {most_bytes // 2**20} MiB"
        )


def _array_name(member: zipfile.ZipInfo) -> str:
    return member.filename.removesuffix(".npy")


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray[Any, Any]:
    data = BytesIO()
    with archive.open(member) as packed:
        while piece := packed.read(_PIECE):
            data.write(piece)
    data.seek(0)
    array = np.lib.format.read_array(data, allow_pickle=False)
    if data.read(1):
        raise ValueError(f"array {_array_name(member)!r} is followed by other data")
    return array
