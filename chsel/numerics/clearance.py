"""How far the voxels of a set are from those outside of it: exact squared distances."""

from __future__ import annotations

from typing import Any

import numpy as np

from chsel.numerics.arrays import BoolArray, IntArray
from chsel.numerics.compiler import compiled, inner, leaf

_FAR = 2**60
_MOST = np.uint8(225)  # squared sides of a voxel: 15, the greatest that a byte holds squared
_REACH = 16  # voxels from centre to centre of which cubes are so far apart
_CHUNK = 32  # voxels that are computed at once


@compiled
def squared_clearances(inside: BoolArray, out: IntArray, gap: int) -> None:
    """Fill out (nx, ny, nz) with squared distances of voxels to the nearest that is not inside.

    In half sides of a voxel: the least over all voxels w that are not inside of the sum over the
    axes of max(2 |v - w| - gap, 0)^2, computed axis by axis (Felzenszwalb and Huttenlocher, 2012).
    gap: 1 for the distance from the centre of v to the cube w, 2 for that between cubes. If all are
    inside, no distance is less than 2^60.
    """
    flat, flags = out.reshape(-1), inside.reshape(-1)
    for n in range(len(flat)):
        flat[n] = _FAR if flags[n] else 0
    nx, ny, nz = out.shape
    line = np.empty(max(nx, ny, nz), dtype=np.int64)
    _along(flat, nz, 1, line, gap)
    _along(flat, ny, nz, line, gap)
    _along(flat, nx, ny * nz, line, gap)


@inner
def _along(flat: IntArray, count: int, stride: int, line: IntArray, gap: int) -> None:
    """One axis, whose neighbours are `stride` apart in lines of `count` voxels."""
    for block in range(0, len(flat), count * stride):
        for start in range(block, block + stride):
            for k in range(count):
                line[k] = flat[start + k * stride]
            for k in range(count):
                flat[start + k * stride] = _nearest(line, count, k, gap)


@inner
def _nearest(line: IntArray, count: int, k: int, gap: int) -> int:
    """The least of line[j] + max(2 |k - j| - gap, 0)^2, going outwards while that can be less."""
    least, reach = line[k], max(k, count - 1 - k)
    for step in range(1, reach + 1):
        along = (2 * step - gap) * (2 * step - gap)
        if along >= least:
            break
        if step <= k:
            least = min(least, line[k - step] + along)
        if k + step < count:
            least = min(least, line[k + step] + along)
    return least


@compiled
def squared_gaps(inside: BoolArray, out: Any) -> None:
    """Fill out (nx, ny, nz), of uint8, with squared distances between voxels, 225 at most.

    From each voxel to the nearest that is not inside, both as cubes, in sides of a voxel. As in
    squared_clearances, axis by axis, but in bytes and for rows of voxels at once.
    """
    flat, flags = out.reshape(-1), inside.reshape(-1)
    nx, ny, nz = out.shape
    size = (nz + _CHUNK - 1) // _CHUNK * _CHUNK  # of a row, with voxels that are not looked at
    wide = np.zeros(nx * ny * size, dtype=np.uint8)
    row = np.full(_REACH + size + _REACH, _MOST)
    for line in range(nx * ny):
        for k in range(nz):
            value = _MOST if flags[np.uint64(line * nz + k)] else np.uint8(0)
            wide[np.uint64(line * size + k)] = row[np.uint64(_REACH + k)] = value
        for step in range(1, _REACH + 1):
            if not _can_be_lower(wide, line * size, size, step):
                break
            _lower(wide, line * size, row, _REACH - step, size, step)
            _lower(wide, line * size, row, _REACH + step, size, step)
    rows = np.empty(max(nx, ny) * size, dtype=np.uint8)
    for i in range(nx):
        _lower_rows(wide, i * ny * size, size, ny, size, rows)
    for j in range(ny):
        _lower_rows(wide, j * size, ny * size, nx, size, rows)
    for line in range(nx * ny):
        for k in range(nz):
            flat[np.uint64(line * nz + k)] = wide[np.uint64(line * size + k)]


@inner
def _lower_rows(wide: Any, begin: int, stride: int, count: int, size: int, rows: Any) -> None:
    """Rows of `size` that are `stride` apart, from what they were, which `rows` holds."""
    for n in range(count):
        for k in range(size):
            rows[np.uint64(n * size + k)] = wide[np.uint64(begin + n * stride + k)]
    for n in range(count):
        at = begin + n * stride
        for step in range(1, _REACH + 1):
            if not _can_be_lower(wide, at, size, step):
                break
            if n >= step:
                _lower(wide, at, rows, (n - step) * size, size, step)
            if n + step < count:
                _lower(wide, at, rows, (n + step) * size, size, step)


@leaf
def _can_be_lower(wide: Any, begin: int, size: int, step: int) -> bool:
    """Whether any of a row is more than what rows `step` away, or further, give."""
    most = np.uint8(0)
    for first in range(begin, begin + size, _CHUNK):
        for k in range(_CHUNK):
            most = max(most, wide[np.uint64(first + k)])
    return bool(most > (step - 1) * (step - 1))


@leaf
def _lower(wide: Any, begin: int, others: Any, first: int, size: int, step: int) -> None:
    """Lower a row of `wide` to what a row of `others`, `step` away, gives."""
    square = np.uint8((step - 1) * (step - 1))
    room = np.uint8(_MOST - square)
    for chunk in range(0, size, _CHUNK):
        for k in range(_CHUNK):
            there = np.uint8(min(others[np.uint64(first + chunk + k)], room) + square)
            at = np.uint64(begin + chunk + k)
            wide[at] = min(wide[at], there)
