"""Files that others wrote: complete, of bounded size, and no device or pipe."""

from __future__ import annotations

import stat
import zipfile
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from chsel.errors import ChselError, MeshError

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


_PLY_END = b"end_header"


def check_complete(path: Path, kind: str) -> None:
    """Raise MeshError if a file holds less than it announces, or lines that no reader expects.

    kind: "ply", "off", "stl" or "xyz"; others pass. Only files of text can be cut unnoticed: for
    binary ones the readers compare the size themselves. The message names no file.
    """
    check = _CHECKS.get(kind)
    if check is not None:
        check(path)


def _check_ply(path: Path) -> None:
    """Text: each vertex, face and other element is a line after the header."""
    with path.open("rb") as file:
        counts: dict[str, int] = {}
        for line in file:
            words = line.split()
            if words[:1] == [b"format"] and words[1:2] != [b"ascii"]:
                return
            if words[:1] == [b"element"] and len(words) == 3 and words[2].isdigit():
                counts[words[1].decode("ascii", "replace")] = int(words[2])
            if line.strip() == _PLY_END:
                break
        _compare(counts, sum(1 for line in file if line.strip()))


def _check_off(path: Path) -> None:
    """Text: a line of counts, then each vertex and each face on a line of its own."""
    lines = _text_lines(path)
    head = next(lines, "").removeprefix("COFF").removeprefix("OFF").strip()
    words = (head or next(lines, "")).split()
    if len(words) < 2 or not (words[0].isdigit() and words[1].isdigit()):
        raise MeshError("its line of counts is missing")
    vertices, faces = int(words[0]), int(words[1])
    read = 0
    for read, line in enumerate(lines, 1):
        words = line.split()
        corners = words[0] if read > vertices else "2"
        if not corners.isdigit() or len(words) <= int(corners):
            raise MeshError(f"line {line[:60]!r} is cut")
    _compare({"vertex": vertices, "face": faces}, read)


def _check_stl(path: Path) -> None:
    """Text: as many facets end as begin, and as many solids."""
    with path.open("rb") as file:
        if not file.read(80).lstrip().lower().startswith(b"solid"):
            return
        file.seek(0)
        begun, ended = _stl_words(file.read())
    if begun == 0:  # a binary file whose comment begins like a text
        return
    if begun != ended:
        raise MeshError(f"it has {ended} whole facets and solids of {begun} that begin")


def _stl_words(content: bytes) -> tuple[int, int]:
    lines = [line.split()[:1] for line in content.lower().splitlines()]
    begun = sum(words in ([b"facet"], [b"solid"]) for words in lines)
    facets = sum(words == [b"facet"] for words in lines)
    ended = sum(words in ([b"endfacet"], [b"endsolid"]) for words in lines)
    return (begun if facets else 0), ended


def _check_xyz(path: Path) -> None:
    """Every line has as many numbers as the first one."""
    columns = 0
    for number, line in enumerate(_text_lines(path), 1):
        count = len(line.replace(",", " ").split())
        columns = columns or count
        if count != columns:
            raise MeshError(f"point {number} has {count} numbers, the first one has {columns}")


def _compare(counts: dict[str, int], lines: int) -> None:
    announced = sum(counts.values())
    if lines != announced:
        what = ", ".join(f"{count} of {name}" for name, count in counts.items())
        raise MeshError(f"it announces {announced} lines ({what}) and has {lines}")


def _text_lines(path: Path) -> Iterator[str]:
    """Lines that hold more than a comment."""
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            content = line.partition("#")[0].strip()
            if content:
                yield content


_CHECKS: dict[str, Callable[[Path], None]] = {
    "ply": _check_ply,
    "off": _check_off,
    "stl": _check_stl,
    "xyz": _check_xyz,
}


MOST_BYTES = 512 * 2**20
"""Of all arrays together, unpacked: 16 million points with their steps."""

_SUFFIX = ".npy"
_ENTRY = b"PK\x01\x02"  # begins each entry of a zip directory
_ENCRYPTED = 0x1  # bit of a zip member's flags
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # zipfile bounds no others' unpacking
_PIECE = 2**20  # bytes that are unpacked at once
_LONGEST_NAME = 60


def read_npz(
    path: Path,
    *,
    accepted: Collection[str] | None = None,
    most_bytes: int = MOST_BYTES,
    error: type[ChselError],
) -> dict[str, np.ndarray[Any, Any]]:
    """The arrays by their names; every checksum is compared, no pickled object is loaded.

    accepted: names that the arrays may have (None: any). most_bytes: of all arrays, unpacked;
    nothing is unpacked beyond it. Raises `error` with one line for whatever is wrong.
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
    except Exception as problem:  # zipfile, its decompressors and numpy raise anything
        reason = " ".join(str(problem).split()) or type(problem).__name__
        raise error(f"not a readable .npz file ({reason[:200]})") from None


def _check_directory(path: Path, start: int, count: int) -> None:
    """Raise ValueError unless the directory from byte `start` on lists `count` arrays.

    zipfile passes over entries where a damaged length makes them part of the one before.
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
    """Raise `error` for what should not even be unpacked."""
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
    size = sum(member.file_size for member in members)  # zipfile reads no more than this
    if size > most_bytes:
        raise error(
            f"its arrays have {size / 2**20:.0f} MiB unpacked; "
            f"accepted: at most {most_bytes // 2**20} MiB"
        )


def _array_name(member: zipfile.ZipInfo) -> str:
    return member.filename.removesuffix(_SUFFIX)


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
