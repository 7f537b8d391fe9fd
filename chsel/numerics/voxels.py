"""Bounds of points, and the voxels that hold them, in one pass each."""

from __future__ import annotations

import numpy as np

from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.numerics.compiler import compiled


def bounds_of(points: FloatArray) -> FloatArray:
    """The least and the greatest coordinates (2, 3) of points (N, 3), N > 0."""
    bounds = np.empty((2, 3))
    _fill_bounds(np.array(points, dtype=np.float64, order="C"), bounds)
    return bounds


@compiled
def _fill_bounds(points: FloatArray, bounds: FloatArray) -> None:
    for axis in range(3):
        bounds[0, axis] = bounds[1, axis] = points[0, axis]
    for n in range(len(points)):
        for axis in range(3):
            bounds[0, axis] = min(bounds[0, axis], points[n, axis])
            bounds[1, axis] = max(bounds[1, axis], points[n, axis])


@compiled
def set_voxels(points: FloatArray, first: FloatArray, side: float, flags: BoolArray) -> None:
    """Set the flags (nx, ny, nz) of the voxels nearest to points (N, 3), ties to even, plus one.

    first (3,): centre of a voxel, which is (1, 1, 1); no point may be further than one beyond.
    """
    for n in range(len(points)):
        i = int(np.rint((points[n, 0] - first[0]) / side)) + 1
        j = int(np.rint((points[n, 1] - first[1]) / side)) + 1
        k = int(np.rint((points[n, 2] - first[2]) / side)) + 1
        flags[i, j, k] = True
