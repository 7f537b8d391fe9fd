"""Exact distances of voxels to the nearest voxel outside of their set, in whole numbers."""

from __future__ import annotations

import numpy as np

from chsel.arrays import BoolArray, IntArray
from chsel.kernels.compiler import compiled, inner

_FAR = 2**60


@compiled
def squared_clearances(inside: BoolArray, out: IntArray) -> None:
    """Fill out (nx, ny, nz) with squared distances from the centres of voxels to the set's border.

    In half sides of a voxel: the least over all voxels w that are not inside, taken as cubes, of
    the sum over the axes of max(2 |v - w| - 1, 0)^2. As it is a sum over the axes, one axis after
    the other finds it (Felzenszwalb and Huttenlocher, 2012). At least one voxel must be outside.
    """
    flat, flags = out.reshape(-1), inside.reshape(-1)
    for n in range(len(flat)):
        flat[n] = _FAR if flags[n] else 0
    nx, ny, nz = out.shape
    line = np.empty(max(nx, ny, nz), dtype=np.int64)
    _along(flat, nz, 1, line)
    _along(flat, ny, nz, line)
    _along(flat, nx, ny * nz, line)


@inner
def _along(flat: IntArray, count: int, stride: int, line: IntArray) -> None:
    """One axis, whose neighbours are `stride` apart in lines of `count` voxels."""
    for block in range(0, len(flat), count * stride):
        for start in range(block, block + stride):
            for k in range(count):
                line[k] = flat[start + k * stride]
            for k in range(count):
                flat[start + k * stride] = _nearest(line, count, k)


@inner
def _nearest(line: IntArray, count: int, k: int) -> int:
    """The least of line[j] + max(2 |k - j| - 1, 0)^2, going outwards while that can be less."""
    least, reach = line[k], max(k, count - 1 - k)
    for step in range(1, reach + 1):
        more = (2 * step - 1) * (2 * step - 1)
        if more >= least:
            break
        if step <= k:
            least = min(least, line[k - step] + more)
        if k + step < count:
            least = min(least, line[k + step] + more)
    return least
