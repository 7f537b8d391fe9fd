"""Writes what other programs read: npz, csv or json, every number exact.

Tables and JSON have the shortest decimals that read back to the same bits. JSON is standard: what
is not finite is null. An npz file holds no pickled object.
"""

from __future__ import annotations

import csv
import io
import json
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from chsel.errors import RecordingError, require_choice
from replay.content.standard_json import standard
from replay.files import new_file
from replay.mcap.reader import Recording

FORMATS = ("npz", "csv", "json")


@dataclass(frozen=True, eq=False)
class Exported:
    """The same content in three forms.

    arrays: of an npz file, with their names, one after the other. document: plain values,
    mappings, lists and arrays, for JSON. header, rows: of a table.
    """

    arrays: Iterable[tuple[str, NDArray[Any]]]
    document: Any
    header: tuple[str, ...]
    rows: Iterable[tuple[Any, ...]]


def require_any(recording: Recording, name: str, found: object) -> None:
    """Raise RecordingError if a recording has nothing of what is asked for."""
    if not found:
        raise RecordingError(f"recording {recording.path} has no {name}; accepted: one with some")


def write_export(exported: Exported, path: Path, file_format: str) -> None:
    """Write a new file. RecordingError if it exists or cannot be written."""
    require_choice("format", file_format, FORMATS)
    write = {"npz": _write_npz, "csv": _write_csv, "json": _write_json}[file_format]
    with new_file(path) as beside, beside.open("xb") as file:
        write(exported, file)


def _write_npz(exported: Exported, file: IO[bytes]) -> None:
    """As numpy.savez does, but that arrays need not be in memory together."""
    with zipfile.ZipFile(file, "w") as archive:
        for name, array in exported.arrays:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as inside:
                np.lib.format.write_array(inside, np.asanyarray(array), allow_pickle=False)


def _write_csv(exported: Exported, file: IO[bytes]) -> None:
    text = io.TextIOWrapper(file, encoding="utf-8", newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(exported.header)
    writer.writerows([_cell(value) for value in row] for row in exported.rows)
    text.flush()
    text.detach()


def _write_json(exported: Exported, file: IO[bytes]) -> None:
    file.write(json.dumps(standard(exported.document), allow_nan=False).encode() + b"\n")


def _cell(value: Any) -> str:
    """A number by its shortest exact decimal, a truth value as 0 or 1, None as nothing."""
    if value is None:
        return ""
    if isinstance(value, float):
        return repr(value)
    return str(int(value) if isinstance(value, bool) else value)
