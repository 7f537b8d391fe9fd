"""Choosing poses that stand for many."""

from __future__ import annotations

from typing import Any

import numpy as np

from chsel.arrays import FloatArray, IntArray
from chsel.far_apart import far_apart
from chsel.kernels.facility import distances_from_surface, locate_facilities
from chsel.kernels.field import field_of
from chsel.pose import rotated
from chsel.sdf import SdfGrid
from chsel.streams import Purpose, StreamKey
from chsel.surface import surface_points
from chsel.threads import spread

_PLACES = 64


def outlined(sdf: SdfGrid, poses: FloatArray) -> FloatArray:
    """How far fixed places in the world are from the object's surface, (B, 64), metres.

    Of poses (B, 12). The places lie on the surface in some of these poses, so that poses differ in
    them as much as their surfaces do: not at all where the object is symmetric.
    """
    surface = sdf.derived("outline", lambda: _points(sdf))
    some = poses[np.arange(_PLACES) * len(poses) // _PLACES]
    axes = some[:, :9].reshape(-1, 3, 3)  # of the object in the world, row by row
    places = rotated(np.swapaxes(axes, 1, 2), surface - some[:, 9:])
    field = field_of(sdf, "trilinear", "surface_point")
    distances = np.empty((len(poses), _PLACES))

    def run(first: int, last: int, _: Any) -> None:
        distances_from_surface(field, poses, places, distances, first, last)

    spread(run, len(poses), lambda: None, least=100)
    return distances


def _points(sdf: SdfGrid) -> FloatArray:
    return surface_points(sdf, _PLACES, StreamKey(0, 0).stream(Purpose.MESH_SAMPLES))


def spaced(sdf: SdfGrid, poses: FloatArray, count: int) -> IntArray:
    """Which of poses (B, 12) to take so that each next one is the farthest from those before."""
    return far_apart(outlined(sdf, poses), count)


def representative(sdf: SdfGrid, poses: FloatArray, count: int) -> IntArray:
    """Which of poses (B, 12) to take so that all are near to one of them; the first always is.

    Fewer than count where all others are the same as chosen ones.
    """
    size = len(poses)
    chosen = np.zeros(min(count, size), dtype=np.int64)
    squares = np.empty((size, size))
    outlines = np.ascontiguousarray(outlined(sdf, poses).T)
    done = locate_facilities(outlines, chosen, np.empty(size), squares)
    return chosen[:done]


def evenly(size: int, count: int) -> IntArray:
    """At most so many of the numbers below size, evenly spaced, the first among them."""
    return np.arange(size) if size <= count else np.arange(count) * size // count
