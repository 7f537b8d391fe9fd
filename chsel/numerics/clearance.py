"""How far the voxels of a set are from those outside of it: exact squared distances."""

from __future__ import annotations

import numpy as np

from chsel.numerics.arrays import BoolArray, IntArray
from chsel.numerics.compiler import compiled, inner

_FAR = 2**60


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
