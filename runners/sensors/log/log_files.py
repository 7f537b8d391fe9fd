"""The files of one log, and their messages as one sequence."""

from __future__ import annotations

import heapq
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from chsel.errors import SessionError
from replay.mcap.log_file import ACCEPTED, RawMessage
from replay.mcap.texts import one_line
from runners.sensors.yaml_file import read_yaml

_METADATA = "metadata.yaml"


def log_files(path: Path, warnings: list[str]) -> list[Path]:
    """The MCAP files of a log in their order; what a user should know of it goes into warnings.

    Raises SessionError if there are none, or if they are compressed or stored in another way.
    """
    if not path.exists():
        raise SessionError(f"log {path} does not exist; {ACCEPTED}")
    if path.is_file():
        _require_mcap([path])
        return [path]
    if not path.is_dir():
        raise SessionError(f"log {path} is neither a file nor a folder; {ACCEPTED}")
    named = _named_files(path, warnings)
    inside = sorted((file for file in path.iterdir() if file.is_file()), key=_natural)
    _require_mcap([*named, *inside])
    found = [file for file in named if file.is_file()]
    for file in named:
        if not file.is_file():
            warnings.append(f"file {file.name}, which {_METADATA} names, is missing")
    if not found:
        found = [file for file in inside if file.suffix == ".mcap"]
    if not found:
        raise SessionError(f"log {path} is a folder without .mcap files; {ACCEPTED}")
    return found


def _named_files(folder: Path, warnings: list[str]) -> list[Path]:
    """The files that a bag's metadata name, none if they cannot be read."""
    if not (folder / _METADATA).exists():
        warnings.append(f"{_METADATA} is missing: its .mcap files are read in the order of names")
        return []
    try:
        about = read_yaml(folder / _METADATA)["rosbag2_bagfile_information"]
        storage, names = about.get("storage_identifier", "mcap"), about["relative_file_paths"]
        compression = about.get("compression_mode") or ""
    except (SessionError, LookupError, TypeError, AttributeError) as error:
        return _without_metadata(warnings, error)
    texts = [storage, compression, *names] if isinstance(names, list) else [names]
    if not all(isinstance(text, str) for text in texts):
        return _without_metadata(warnings, ValueError("relative_file_paths are no names"))
    if storage != "mcap":
        raise SessionError(
            f"log {folder} has storage {one_line(storage)!r}; {ACCEPTED}: convert it with "
            "`ros2 bag convert`"
        )
    if compression:
        raise SessionError(
            f"log {folder} is compressed by rosbag2 ({one_line(compression)}); {ACCEPTED}, not "
            "compressed but by MCAP itself: convert it with `ros2 bag convert`"
        )
    # Some versions put the folder's name ahead; and no file of another folder is the bag's.
    files = [folder / Path(name.replace("\0", "")).name for name in names]
    return list(dict.fromkeys(files))


def _without_metadata(warnings: list[str], error: Exception) -> list[Path]:
    reason = one_line(str(error) or type(error).__name__)[:200]
    warnings.append(
        f"{_METADATA} cannot be read ({reason}): the .mcap files are read in the order of names"
    )
    return []


def _require_mcap(files: list[Path]) -> None:
    for file in files:
        if file.name.endswith((".mcap.zstd", ".mcap.lz4", ".mcap.zst")):
            raise SessionError(
                f"log {file} is compressed as a whole; accepted: .mcap: unpack it with `zstd -d`"
            )


def _natural(path: Path) -> list[Any]:
    """A key by which bag_2 comes before bag_10."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


Span = tuple[int, int]
"""First and last log time of a file, nanoseconds."""


def merged(
    spans: Sequence[Span], read: Callable[[int], Iterator[RawMessage]]
) -> Iterator[RawMessage]:
    """Messages by log time, of equal ones those of earlier files first. read: by a file's number.

    No file is opened before its time comes: of the successive splits of a recording one is open at
    a time, of files that hold a topic each, all are.
    """
    later = sorted(range(len(spans)), key=lambda n: (spans[n][0], n), reverse=True)
    heads: list[tuple[int, int, RawMessage, Iterator[RawMessage]]] = []
    while later or heads:
        if later and (not heads or spans[later[-1]][0] <= heads[0][0]):
            number = later.pop()
            messages = read(number)
        else:
            _, number, message, messages = heapq.heappop(heads)
            yield message
        following = next(messages, None)
        if following is not None:
            heapq.heappush(heads, (following.log_time, number, following, messages))
