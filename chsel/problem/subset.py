"""Choosing few of many: farthest points, and facility location on poses."""

from __future__ import annotations

from typing import Any

import numpy as np

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.problem.poses import Poses, rotated
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.surface import surface_distances, surface_points

_PLACES = 64  # of a descriptor


def farthest_points(points: FloatArray, most: int, *, chosen_first: int = 0) -> IntArray:
    """Return indices of at most `most` of points (N, d), each the farthest from those before it.

    The first `chosen_first` points come first, in their order.
    """
    chosen = np.zeros(min(most, len(points)), dtype=np.int64)
    points = np.ascontiguousarray(points, dtype=np.float64)
    choose_farthest(points, chosen_first, chosen, np.full(len(points), np.inf))
    return chosen


def farthest_poses(sdf: SdfGrid, poses: Poses, *, count: int) -> IntArray:
    """Return indices of at most `count` poses, each the farthest from those before it."""
    return farthest_points(surface_descriptors(sdf, poses), count)


def representative_poses(sdf: SdfGrid, poses: Poses, *, count: int) -> IntArray:
    """Return indices of poses such that every pose is near one of them, the first included.

    Fewer than `count` if all others have the same descriptors as chosen ones.
    """
    first = np.zeros(min(1, len(poses)), dtype=np.int64)
    return facilities(
        squared_distances(sdf, poses), first, count=count, prices=np.zeros(len(poses))
    )


def squared_distances(sdf: SdfGrid, poses: Poses) -> FloatArray:
    """Return squared distances (B, B) of poses from each other by their descriptors (B, 64)."""
    apart = np.empty((len(poses), len(poses)))
    fill_apart(np.ascontiguousarray(surface_descriptors(sdf, poses).T), apart)
    return apart


def facilities(costs: FloatArray, first: IntArray, *, count: int, prices: FloatArray) -> IntArray:
    """Return at most `count` of B facilities for C clients, greedily: those in `first` come first.

    costs (C, B), not negative, of serving each client from each facility. Every other one chosen
    makes the sum of what all clients cost, each from the cheapest facility so far, and of its own
    price (B,), the least. One from which its own client costs nothing more is not chosen.
    """
    chosen = np.zeros(min(count, len(prices)), dtype=np.int64)
    chosen[: len(first)] = first
    located = locate_facilities(costs, prices, len(first), chosen, np.empty((2, len(prices))))
    return chosen[:located]


def surface_descriptors(sdf: SdfGrid, poses: Poses) -> FloatArray:
    """Return distances in metres (B, 64) from fixed places in the world to the object's surface.

    The places lie on the surface in some of the poses, so descriptors differ as much as posed
    surfaces do: not at all between poses that a symmetry of the object maps to each other.
    """

    def make() -> FloatArray:
        return surface_points(sdf, _PLACES, stream=StreamKey(0, 0).stream(Purpose.MESH_SAMPLES))

    surface = sdf.derived("descriptors", make)
    some = poses[np.arange(_PLACES) * len(poses) // _PLACES]
    places = rotated(np.swapaxes(some.rotations, 1, 2), surface - some.translations)
    return surface_distances(sdf, poses, points=places)


@compiled
def choose_farthest(points: Any, first: Any, chosen: Any, squared: Any) -> None:
    """Fill `chosen` with indices of points (N, d). squared (N,): infinite, then scratch."""
    for n in range(len(chosen)):
        best = n
        if n >= first:
            best = 0
            for i in range(1, len(points)):
                best = i if squared[i] > squared[best] else best
        chosen[n] = best
        for i in range(len(points)):
            squared[i] = min(squared[i], squared_distance(points[i], points[best]))
        squared[best] = -1.0


@leaf
def squared_distance(one: Any, other: Any) -> Any:
    """Return the squared distance of two points (d,), in eight sums side by side."""
    size, total = len(one), 0.0
    whole = size // 8 * 8
    if whole > 0:
        a = b = c = d = e = f = g = h = 0.0
        for k in range(0, whole, 8):
            a += (one[k] - other[k]) * (one[k] - other[k])
            b += (one[k + 1] - other[k + 1]) * (one[k + 1] - other[k + 1])
            c += (one[k + 2] - other[k + 2]) * (one[k + 2] - other[k + 2])
            d += (one[k + 3] - other[k + 3]) * (one[k + 3] - other[k + 3])
            e += (one[k + 4] - other[k + 4]) * (one[k + 4] - other[k + 4])
            f += (one[k + 5] - other[k + 5]) * (one[k + 5] - other[k + 5])
            g += (one[k + 6] - other[k + 6]) * (one[k + 6] - other[k + 6])
            h += (one[k + 7] - other[k + 7]) * (one[k + 7] - other[k + 7])
        total = ((a + b) + (c + d)) + ((e + f) + (g + h))
    for k in range(whole, size):
        total += (one[k] - other[k]) * (one[k] - other[k])
    return total


@compiled
def locate_facilities(apart: Any, prices: Any, first: Any, chosen: Any, rows: Any) -> Any:
    """Fill `chosen` (B,) after the `first` of them; apart (C, C) is `costs` of `facilities`.

    rows (2, C): scratch. Returns the number of chosen ones, less than B if all others are served
    for nothing.
    """
    count = len(prices)
    nearest, totals = rows[0], rows[1]
    for i in range(count):
        nearest[i] = np.inf
    for n in range(len(chosen)):
        if n >= first:
            _fill_totals(nearest, apart, prices, totals)
            best, least = -1, np.inf
            for i in range(count):
                if nearest[i] != 0.0 and totals[i] < least:
                    best, least = i, totals[i]
            if best < 0:  # every other point equals a chosen one
                return n
            chosen[n] = best
        for j in range(count):
            nearest[j] = min(nearest[j], apart[j, chosen[n]])
    return len(chosen)


@compiled
def fill_apart(points: Any, apart: Any) -> None:
    """Fill `apart` with squared distances of points (d, C) from each other, four axes in a pass."""
    dimension, count = points.shape
    for i in range(count):
        for j in range(i):
            apart[i, j] = apart[j, i]
        row = apart[i, i:]
        for j in range(count - i):
            row[j] = 0.0
        fours = dimension // 4 * 4
        for k in range(0, fours, 4):
            p, q, r, s = points[k, i:], points[k + 1, i:], points[k + 2, i:], points[k + 3, i:]
            a, b, c, d = p[0], q[0], r[0], s[0]
            for j in range(count - i):
                x, y, z, w = a - p[j], b - q[j], c - r[j], d - s[j]
                row[j] = (((row[j] + x * x) + y * y) + z * z) + w * w
        for k in range(fours, dimension):
            p = points[k, i:]
            for j in range(count - i):
                row[j] += (p[0] - p[j]) * (p[0] - p[j])


@inner
def _fill_totals(nearest: Any, apart: Any, prices: Any, totals: Any) -> None:
    """Fill totals (C,) with the sum of costs and price if each is chosen; four rows in a pass."""
    count = len(totals)
    fours = count // 4 * 4
    for i in range(count):
        totals[i] = prices[i]
    for j in range(0, fours, 4):
        p, q, r, s = apart[j], apart[j + 1], apart[j + 2], apart[j + 3]
        a, b, c, d = nearest[j], nearest[j + 1], nearest[j + 2], nearest[j + 3]
        for i in range(count):
            total = (totals[i] + min(a, p[i])) + min(b, q[i])
            totals[i] = (total + min(c, r[i])) + min(d, s[i])
    for j in range(fours, count):
        row, most = apart[j], nearest[j]
        for i in range(count):
            totals[i] += min(most, row[i])
