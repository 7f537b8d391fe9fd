"""Arrays of callers: checked once, then read-only float64."""

from __future__ import annotations

import hashlib
import math
import os
import sys
import threading
import zipfile
from collections.abc import Collection
from dataclasses import fields
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chsel.errors import ChselError, PointsError, quoted

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
_LINE = 128  # bytes that processors hold together, at most


class ShapesShown:
    """Base of dataclasses whose repr has the shapes of arrays, and not their numbers."""

    def __repr__(self) -> str:
        shown = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        parts = [
            f"{name}: {value.shape}" if isinstance(value, np.ndarray) else f"{name}={value!r}"
            for name, value in shown.items()
        ]
        return f"{type(self).__name__}({', '.join(parts)})"


def frozen(
    name: str,
    value: Any,
    *,
    shape: tuple[int | None, ...],
    dtype: Any = np.float64,
    error: type[ChselError] = PointsError,
    finite: bool = True,
    most: float = math.inf,
) -> NDArray[Any]:
    """Return a read-only, C-ordered copy of `value` with the given shape (None: any length).

    Takes numpy arrays, torch tensors and nested lists. most: the largest coordinate, metres.
    Raises `error` with `name` in the message if the value is not an array of real numbers, has
    masked values or another shape, or, where it must be finite, holds a value that is not.
    """
    torch = sys.modules.get("torch")  # importing it takes seconds; a tensor's owner has done so
    try:
        if torch is not None and isinstance(value, torch.Tensor):
            value = value.detach().cpu().numpy()
        parts = value if isinstance(value, list | tuple) else [value]
        if any(np.ma.is_masked(part) for part in parts):
            raise error(f"{name} has masked values; accepted: an array without, such as x[~x.mask]")
        given = np.asarray(value)
        objects = given.flat if given.dtype.kind == "O" else ()
        if given.dtype.kind not in "biufO" or any(isinstance(each, str) for each in objects):
            raise TypeError
        array = np.array(given, dtype=dtype, order="C")
    except (TypeError, ValueError, OverflowError):
        raise error(f"{name} is not an array of numbers; accepted: shape {_show(shape)}") from None
    fits = array.ndim == len(shape)
    fits = fits and all(want in (None, have) for want, have in zip(shape, array.shape, strict=True))
    if not fits and array.size == 0 and 0 in array.shape and shape[0] is None:
        array = np.zeros([0 if length is None else length for length in shape], dtype=dtype)
    elif not fits:
        raise error(f"{name} has shape {array.shape}; accepted: {_show(shape)}")
    if finite and not np.isfinite(array).all():
        row = int(np.argwhere(~np.isfinite(array))[0][0]) if array.ndim else 0
        raise error(f"{name}[{row}] is not finite; accepted: finite numbers")
    if most < math.inf and np.abs(array).max(initial=0.0) > most:
        row = int(np.argwhere(np.abs(array) > most)[0][0])
        raise error(f"{name}[{row}] has {np.abs(array[row]).max():g}; accepted: up to {most:g} (m)")
    array.setflags(write=False)
    return array


def read_only(points: FloatArray) -> FloatArray:
    """Return the numbers as C-ordered float64 that cannot be written, copied only if needed."""
    array = np.ascontiguousarray(points, dtype=np.float64).view()
    array.setflags(write=False)
    return array


class GrowingRows:
    """Memory of arrays that continue each other: each is its first rows, read-only.

    It grows by doubling, so appending takes the time of what is appended. Rows in use never change.
    """

    def __init__(self, array: FloatArray) -> None:
        """Begin with the rows of an array that nobody changes."""
        self._memory = array
        self._count = len(array)  # rows in use
        self._lock = threading.Lock()

    def appended(self, array: FloatArray, new: FloatArray) -> tuple[FloatArray, GrowingRows]:
        """Return an array followed by new rows, and its memory; `array` has to be in this one.

        It is another memory where other rows follow `array` here already.
        """
        first, last = len(array), len(array) + len(new)
        with self._lock:
            if first == self._count < last:
                if last > len(self._memory):
                    memory = np.empty((max(last, 2 * first), *array.shape[1:]))
                    memory[:first] = array
                    self._memory = memory
                self._memory[first:last] = new
                self._count = last
            if last <= self._count and self._memory[first:last].tobytes() == new.tobytes():
                return read_only(self._memory[:last]), self
        return GrowingRows(array).appended(array, new)


def scratch(*shape: int, dtype: Any = np.float64) -> NDArray[Any]:
    """Return zeros of a shape that one thread writes again and again.

    They share no cache line with other data, which would slow down other threads, and begin with
    one, as vector instructions are faster then.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    memory = np.zeros(size + 2 * _LINE, dtype=np.uint8)
    first = -memory.__array_interface__["data"][0] % _LINE
    return memory[first : first + size].view(dtype).reshape(shape)


def evenly_spaced(size: int, count: int) -> IntArray:
    """Return at most `count` of the numbers below size, evenly spaced, beginning with 0."""
    return np.arange(size) if size <= count else np.arange(count) * size // count


def digest(*arrays: NDArray[Any]) -> str:
    """Return BLAKE2b (128 bit, hexadecimal) of the types, shapes and bytes of arrays, in order."""
    state = hashlib.blake2b(digest_size=16)
    for array in arrays:
        array = np.ascontiguousarray(array)
        array = array.astype(array.dtype.newbyteorder("<"), copy=False)
        state.update(f"{array.dtype.str}{array.shape};".encode())
        state.update(array.data)
    return state.hexdigest()


def _show(shape: tuple[int | None, ...]) -> str:
    return "(" + ", ".join("any" if length is None else str(length) for length in shape) + ")"


_LFS = b"version https://git-lfs.github.com/spec/"
MOST_BYTES = 512 * 2**20  # of the arrays of an .npz file, unpacked: 16 million points with steps


def refuse_special_file(name: str, path: Path, *, error: type[ChselError]) -> None:
    """Raise `error` if `path` is a FIFO, a socket or a device, a link to one, or of Git LFS.

    name: of the file in the message, such as "recording a.mcap". Other paths pass, also those that
    do not exist, cannot be opened, or are no paths, such as texts with NUL.
    """
    if os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path)):
        raise error(f"{name} is a FIFO, a socket or a device; accepted: a file")
    try:
        with open(path, "rb") as file:
            pointer = file.read(len(_LFS)) == _LFS
    except (OSError, ValueError):
        return
    if pointer:
        raise error(f"{name} is a pointer of Git LFS, not its data; run `git lfs pull` first")


def read_npz(
    path: Path,
    *,
    accepted: Collection[str] | None = None,
    most_bytes: int = MOST_BYTES,
    error: type[ChselError],
) -> dict[str, np.ndarray[Any, Any]]:
    """Return the arrays by name; every checksum is compared, and no pickled object is loaded.

    accepted: names that the arrays may have (None: any). most_bytes: limit of all arrays, unpacked.
    Raises `error` with a message of one line for any defect of the file.
    """
    refuse_special_file("it", path, error=error)
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
