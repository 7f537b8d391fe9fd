"""Checks of files from outside: no device or pipe, archives of arrays whole and not too large."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Collection
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from chsel.errors import ChselError, quoted

MOST_BYTES = 512 * 2**20  # of the arrays of an .npz file, unpacked: 16 million points with steps


def refuse_special_file(name: str, path: Path, error: type[ChselError]) -> None:
    """Raise `error` if `path` is a FIFO, a socket or a device, or a link to one.

    name: of the file in the message, such as "recording a.mcap". Other paths pass, also those that
    do not exist or cannot be opened.
    """
    if os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path)):
        raise error(f"{name} is a FIFO, a socket or a device; accepted: a file")


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
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
            if size > most_bytes:
                raise error(
                    f"its arrays have {size / 2**20:.0f} MiB unpacked; "
                    f"accepted: at most {most_bytes // 2**20} MiB"
                )
            for member in archive.namelist():
                name = member.removesuffix(".npy")
                if accepted is not None and name not in accepted:
                    raise error(f"array {quoted(name)} is unknown; accepted: {', '.join(accepted)}")
                data = BytesIO(archive.read(member))  # to its end, where the checksum is compared
                arrays[name] = np.lib.format.read_array(data, allow_pickle=False)
    except ChselError:
        raise
    except Exception as problem:  # zipfile, its decompressors and numpy raise many kinds
        reason = " ".join(str(problem).split()) or type(problem).__name__
        raise error(f"not a readable .npz file ({reason[:200]})") from None
    return arrays
