"""Choosing poses that stand for many."""

from __future__ import annotations

import numpy as np

from chsel.arrays import FloatArray, IntArray
from chsel.far_apart import far_apart
from chsel.kernels.facility import locate_facilities
from chsel.sdf import SdfGrid
from chsel.surface import object_shape


def embedded(sdf: SdfGrid, poses: FloatArray) -> FloatArray:
    """Points (B, 12) whose distances are about the rms distances of the object's surface points.

    Of poses (B, 12): where the object's centre is in the world, and its axes, as long as the
    surface's deviations along them; exact if these are principal axes.
    """
    centre, deviation = object_shape(sdf)
    turned = poses[:, :9].reshape(-1, 3, 3)  # its rows are the object's axes in the world
    away = centre - poses[:, 9:]
    position = (away[:, 0, None] * turned[:, 0] + away[:, 1, None] * turned[:, 1]) + away[
        :, 2, None
    ] * turned[:, 2]
    axes = turned * deviation[:, None]
    return np.concatenate([position, axes.reshape(-1, 9)], axis=1)


def spaced(sdf: SdfGrid, poses: FloatArray, count: int) -> IntArray:
    """Which of poses (B, 12) to take so that each next one is the farthest from those before."""
    return far_apart(embedded(sdf, poses), count)


def representative(sdf: SdfGrid, poses: FloatArray, count: int) -> IntArray:
    """Which of poses (B, 12) to take so that all are near to one of them; the first always is.

    Fewer than count where all others are the same as chosen ones.
    """
    points = embedded(sdf, poses)
    size = len(points)
    chosen = np.zeros(min(count, size), dtype=np.int64)
    squares = np.empty((size, size))
    done = locate_facilities(points, 1, chosen, np.empty(size), squares)
    return chosen[:done]


def evenly(size: int, count: int) -> IntArray:
    """At most so many of the numbers below size, evenly spaced, the first among them."""
    return np.arange(size) if size <= count else np.arange(count) * size // count
