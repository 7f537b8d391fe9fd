"""Bounds of points, and the voxels that hold them, in one pass each."""

from __future__ import annotations

import numpy as np

from chsel.numerics.arrays import BoolArray, FloatArray, read_only
from chsel.numerics.compiler import compiled

_LANES = 24  # numbers that are compared at once: those of eight points


def bounds_of(points: FloatArray) -> FloatArray:
    """The least and the greatest coordinates (2, 3) of points (N, 3), N > 0."""
    bounds = np.empty((2, 3))
    _fill_bounds(read_only(points).reshape(-1), bounds)
    return bounds


@compiled
def _fill_bounds(numbers: FloatArray, bounds: FloatArray) -> None:
    """numbers: the coordinates (3 N,) of points, one after the other."""
    low, high = np.empty(_LANES), np.empty(_LANES)
    for i in range(_LANES):
        low[i] = high[i] = numbers[i % 3]
    whole = len(numbers) // _LANES * _LANES
    for first in range(0, whole, _LANES):
        for i in range(_LANES):
            low[i] = min(low[i], numbers[first + i])
            high[i] = max(high[i], numbers[first + i])
    for i in range(len(numbers) - whole):
        low[i] = min(low[i], numbers[whole + i])
        high[i] = max(high[i], numbers[whole + i])
    for axis in range(3):
        bounds[0, axis], bounds[1, axis] = low[axis], high[axis]
        for i in range(axis, _LANES, 3):
            bounds[0, axis] = min(bounds[0, axis], low[i])
            bounds[1, axis] = max(bounds[1, axis], high[i])


@compiled
def set_voxels(points: FloatArray, first: FloatArray, side: float, flags: BoolArray) -> None:
    """Set the flags (nx, ny, nz) of the voxels nearest to points (N, 3), ties to even, plus one.

    first (3,): centre of a voxel, which is (1, 1, 1); no point may be further than one beyond.
    """
    x, y, z = first[0], first[1], first[2]
    for n in range(len(points)):
        i = int(np.rint((points[n, 0] - x) / side)) + 1
        j = int(np.rint((points[n, 1] - y) / side)) + 1
        k = int(np.rint((points[n, 2] - z) / side)) + 1
        flags[i, j, k] = True
