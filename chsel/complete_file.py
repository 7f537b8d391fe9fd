"""Whether a file of points or faces holds all that it announces: readers accept one that is cut."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from chsel.errors import MeshError

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
