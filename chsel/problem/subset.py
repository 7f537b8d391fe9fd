"""Poses that stand for many: farthest points, and facility location."""

from __future__ import annotations

from typing import Any

import numpy as np

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.compiler import compiled
from chsel.numerics.pose_tuples import pose_at
from chsel.numerics.threads import spread
from chsel.problem.poses import Poses, rotated
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.sdf_lookup import distance_at, field_of
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.surface import surface_points


def far_apart(points: FloatArray, most: int, *, given: int = 0) -> IntArray:
    """Which of points (N, d) to take so that every next one is the farthest from those before.

    given: so many of the first points come first, as they are.
    """
    chosen = np.zeros(min(most, len(points)), dtype=np.int64)
    squared = np.full(len(points), np.inf)
    for n in range(len(chosen)):
        chosen[n] = n if n < given else int(np.argmax(squared))
        difference = points - points[chosen[n]]
        squared = np.minimum(squared, (difference * difference).sum(axis=1))
        squared[chosen[n]] = -1.0
    return chosen


@compiled
def distances_from_surface(
    field: Any, poses: Any, places: Any, out: Any, first: Any, last: Any
) -> None:
    """Fill out (B, K) with the distances of world points (K, 3) in poses (B, 12), first to last."""
    for b in range(first, last):
        pose = pose_at(poses, b)
        for k in range(len(places)):
            out[b, k] = distance_at(field, pose, places[k, 0], places[k, 1], places[k, 2])


@compiled
def locate_facilities(points: Any, chosen: Any, nearest: Any, apart: Any) -> Any:
    """Choose points (d, C) so that all are near to a chosen one: by the mean square.

    The first, then what takes off the most. nearest (C,), apart (C, C): scratch. Returns how many
    of chosen (B,) there are before all others are like them.
    """
    dimension, count = points.shape
    apart[:] = 0.0
    for i in range(count):
        nearest[i] = np.inf
        row = apart[i]
        for d in range(dimension):
            of_all, own = points[d], points[d, i]
            for j in range(count):
                row[j] += (own - of_all[j]) * (own - of_all[j])
    for n in range(len(chosen)):
        if n > 0:
            best, least = -1, np.inf
            for i in range(count):
                if nearest[i] == 0.0:
                    continue
                total = 0.0
                for j in range(count):
                    total += min(nearest[j], apart[i, j])
                if total < least:
                    best, least = i, total
            if best < 0:  # all are chosen, or alike
                return n
            chosen[n] = best
        for j in range(count):
            nearest[j] = min(nearest[j], apart[chosen[n], j])
    return len(chosen)


_PLACES = 64


def outlined(sdf: SdfGrid, poses: Poses) -> FloatArray:
    """How far fixed places in the world are from the object's surface, (B, 64), metres.

    The places lie on the surface in some of these poses, so that poses differ in
    them as much as their surfaces do: not at all where the object is symmetric.
    """
    surface = sdf.derived("outline", lambda: _points(sdf))
    some = poses[np.arange(_PLACES) * len(poses) // _PLACES]
    places = rotated(np.swapaxes(some.rotations, 1, 2), surface - some.translations)
    field = field_of(sdf, "trilinear", "surface_point")
    distances = np.empty((len(poses), _PLACES))

    def run(first: int, last: int, _: Any) -> None:
        distances_from_surface(field, poses.numbers, places, distances, first, last)

    spread(run, len(poses), lambda: None, least=100)
    return distances


def _points(sdf: SdfGrid) -> FloatArray:
    return surface_points(sdf, _PLACES, StreamKey(0, 0).stream(Purpose.MESH_SAMPLES))


def spaced(sdf: SdfGrid, poses: Poses, count: int) -> IntArray:
    """Which poses to take so that each next one is the farthest from those before."""
    return far_apart(outlined(sdf, poses), count)


def representative(sdf: SdfGrid, poses: Poses, count: int) -> IntArray:
    """Which poses to take so that all are near to one of them; the first always is.

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
