"""Choosing few of many: farthest points, and facility location on poses."""

from __future__ import annotations

from typing import Any

import numpy as np

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.compiler import compiled
from chsel.numerics.pose_tuples import pose_at
from chsel.numerics.threads import spread
from chsel.problem.poses import Poses, rotated
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.sdf_lookup import distance_at, distance_field
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.surface import surface_points

_PLACES = 64  # of a descriptor


def evenly_spaced(size: int, count: int) -> IntArray:
    """At most `count` of the numbers below size, evenly spaced, beginning with 0."""
    return np.arange(size) if size <= count else np.arange(count) * size // count


def farthest_points(points: FloatArray, most: int, *, given: int = 0) -> IntArray:
    """Indices of at most `most` of points (N, d), each the farthest from those before it.

    The first `given` points come first, in their order.
    """
    chosen = np.zeros(min(most, len(points)), dtype=np.int64)
    squared = np.full(len(points), np.inf)
    for n in range(len(chosen)):
        chosen[n] = n if n < given else int(np.argmax(squared))
        difference = points - points[chosen[n]]
        squared = np.minimum(squared, (difference * difference).sum(axis=1))
        squared[chosen[n]] = -1.0
    return chosen


def farthest_poses(sdf: SdfGrid, poses: Poses, count: int) -> IntArray:
    """Indices of at most `count` poses, each the farthest from those before it by descriptors."""
    return farthest_points(surface_descriptors(sdf, poses), count)


def representative_poses(sdf: SdfGrid, poses: Poses, count: int) -> IntArray:
    """Indices of poses such that every pose is near to one of them; the first is always chosen.

    Fewer than `count` if all others have the same descriptors as chosen ones.
    """
    size = len(poses)
    chosen = np.zeros(min(count, size), dtype=np.int64)
    descriptors = np.ascontiguousarray(surface_descriptors(sdf, poses).T)
    located = locate_facilities(descriptors, chosen, np.empty((2, size)), np.empty((size, size)))
    return chosen[:located]


def surface_descriptors(sdf: SdfGrid, poses: Poses) -> FloatArray:
    """Distances in metres (B, 64) from fixed places in the world to the object's surface.

    The places lie on the surface in some of the poses, so descriptors differ as much as posed
    surfaces do: not at all between poses that a symmetry of the object maps to each other.
    """
    stream = StreamKey(0, 0).stream(Purpose.MESH_SAMPLES)
    surface = sdf.derived("descriptors", lambda: surface_points(sdf, _PLACES, stream))
    some = poses[np.arange(_PLACES) * len(poses) // _PLACES]
    places = rotated(np.swapaxes(some.rotations, 1, 2), surface - some.translations)
    field = distance_field(sdf, "trilinear", "surface_point")
    distances = np.empty((len(poses), _PLACES))

    def run(first: int, last: int, _: Any) -> None:
        distances_from_surface(field, poses.numbers, places, distances, first, last)

    spread(run, len(poses), lambda: None, least=100)
    return distances


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
def locate_facilities(points: Any, chosen: Any, rows: Any, apart: Any) -> Any:
    """Greedily choose points (d, C) so that the sum of squared distances to them is least.

    The first point, then always the one that lowers the sum the most. chosen (B,): indices to
    fill. rows (2, C), apart (C, C): scratch. Returns the number of chosen points, less than B if
    all others equal chosen ones.
    """
    dimension, count = points.shape
    nearest, totals = rows[0], rows[1]
    apart[:] = 0.0
    for i in range(count):
        nearest[i] = np.inf
        row = apart[i]
        for d in range(dimension):
            values, value = points[d], points[d, i]
            for j in range(count):
                row[j] += (value - values[j]) * (value - values[j])
    for n in range(len(chosen)):
        if n > 0:
            totals[:] = 0.0
            for j in range(count):  # the sum of every candidate i in one vectorised loop
                row, most = apart[j], nearest[j]
                for i in range(count):
                    totals[i] += min(most, row[i])
            best, least = -1, np.inf
            for i in range(count):
                if nearest[i] != 0.0 and totals[i] < least:
                    best, least = i, totals[i]
            if best < 0:  # every other point equals a chosen one
                return n
            chosen[n] = best
        row = apart[chosen[n]]
        for j in range(count):
            nearest[j] = min(nearest[j], row[j])
    return len(chosen)
