"""Which voxels of a box hold free points."""

from __future__ import annotations

import numpy as np

from chsel.numerics.compiler import compiled, leaf


@compiled
def bounds_of_points(points, lower, upper, bounds):
    """Fill bounds (2, 3) of those of points (N, 3) that are in a box; returns how many are."""
    count = 0
    bounds[0], bounds[1] = np.inf, -np.inf
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if _within((x, y, z), lower, upper):
            count += 1
            bounds[0, 0], bounds[1, 0] = min(bounds[0, 0], x), max(bounds[1, 0], x)
            bounds[0, 1], bounds[1, 1] = min(bounds[0, 1], y), max(bounds[1, 1], y)
            bounds[0, 2], bounds[1, 2] = min(bounds[0, 2], z), max(bounds[1, 2], z)
    return count


@compiled
def mark_voxels(points, lower, upper, first, side, flags):
    """Set the flags (nx, ny, nz) of the voxels that hold one of the points that are in a box."""
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if _within((x, y, z), lower, upper):
            i = int(np.rint((x - first[0]) / side))
            j = int(np.rint((y - first[1]) / side))
            flags[i, j, int(np.rint((z - first[2]) / side))] = 1


@leaf
def _within(point, lower, upper):
    x, y, z = point
    inside = lower[0] <= x <= upper[0] and lower[1] <= y <= upper[1]
    return inside and lower[2] <= z <= upper[2]
