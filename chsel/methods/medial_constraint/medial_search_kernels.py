"""The Medial Constraint cost as CMA-ES searches by it: in numbers of 32 bits, several at a time.

It is that of `medial_kernels` but for rounding: by some 1e-7 m of each distance.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.cost.objective import cost_of, costs_of
from chsel.methods.medial_constraint.least_distances import ASTRAY, LeastDistances
from chsel.methods.medial_constraint.narrow_field_kernels import (
    MOST,
    TERM,
    NarrowField,
    PointBlock,
    point_block,
    read_distances,
    sum_of_terms,
    whole_vectors,
)
from chsel.numerics.compiler import implements, inner, leaf
from chsel.numerics.pose_tuples import Triple, all_finite, decode, finite, moved

_ROUNDING = 4e-7  # of the terms of a sum of three products and a number, all of 32 bits


class MedialSearch(NamedTuple):
    """All that determines the cost of a pose."""

    field: NarrowField
    bounds: LeastDistances
    middle: Triple  # of the balls, world, metres
    span: float  # the greatest coordinate of a ball or point from there, metres
    centres: Any  # (3, N_b) of the balls, from the middle, metres; float32
    radii: Any  # (N_b,) cells; float32
    steps: Any  # (N_b,) of the bounds that the radii reach; uint8
    known: Any  # (3, N_k) from the middle, metres; float32
    known_sdf: Any  # (N_k,) cells; float32
    ball_scale: float  # m^2 for a square cell of a single ball,
    known_scale: float  # and of a point


class SearchScratch(NamedTuple):
    """Scratch of one thread, for S balls or points."""

    distances: PointBlock  # points in cells of the bounds, and radii or known signed distances
    cell: Any  # (S,) of the bounds; int32
    near: Any  # (S,) numbers of balls that may touch the object; int32


def search_scratch(model: MedialSearch) -> SearchScratch:
    """Scratch for one thread."""
    size = max(len(model.radii), len(model.known_sdf))
    cell, near = np.empty((2, size + 1), dtype=np.int32)
    return SearchScratch(point_block(size), cell, near)


@inner
def search_cost(model, pose, scratch):
    """The cost of a pose, m^2; infinite for one that is not finite."""
    if not finite(pose):
        return np.inf
    first, k = model.bounds.first, model.bounds.inverse
    x, y, z = moved(pose, model.middle[0], model.middle[1], model.middle[2])
    move = _narrow(pose, k, (x - first[0]) * k, (y - first[1]) * k, (z - first[2]) * k)
    cost = model.known_scale * _known_sum(model, move, scratch)
    cost += model.ball_scale * _ball_sum(model, move, scratch)
    return cost if cost < np.inf else np.inf  # NaN is infinite, too


@leaf
def _narrow(pose, k, x, y, z):
    """A pose in numbers of 32 bits: points from the middle, in metres, to cells of the bounds."""
    a, b, c = np.float32(pose[0] * k), np.float32(pose[1] * k), np.float32(pose[2] * k)
    d, e, f = np.float32(pose[3] * k), np.float32(pose[4] * k), np.float32(pose[5] * k)
    g, h, i = np.float32(pose[6] * k), np.float32(pose[7] * k), np.float32(pose[8] * k)
    return a, b, c, d, e, f, g, h, i, np.float32(x), np.float32(y), np.float32(z)


@inner
def _known_sum(model, move, scratch):
    """The sum of squares (s - v)^2 over points of known signed distance v, in cells."""
    points, block = scratch.distances.points, scratch.distances.block
    known_sdf, total = model.known_sdf, 0.0
    xs, ys, zs = model.known[0], model.known[1], model.known[2]
    us, vs, ws, known = points[0], points[1], points[2], points[3]
    for n in range(len(known_sdf)):
        us[n], vs[n], ws[n] = moved(move, xs[n], ys[n], zs[n])
        known[n] = known_sdf[n]
    for start in range(0, len(known_sdf), MOST):
        size = min(MOST, len(known_sdf) - start)
        read_distances(model.field, scratch.distances, start, size)
        for n in range(whole_vectors(size)):
            difference = block[TERM + n] - known[np.uint64(start) + np.uint64(n)]
            block[TERM + n] = difference * difference
        total += sum_of_terms(block, size)
    return total


@inner
def _ball_sum(model, move, scratch):
    """The sum of squares max(0, r - s)^2 over balls, in cells."""
    radii, block = scratch.distances.points[3], scratch.distances.block
    total, zero = 0.0, np.float32(0.0)
    count = _collect_near(model, move, scratch)
    for start in range(0, count, MOST):
        size = min(MOST, count - start)
        read_distances(model.field, scratch.distances, start, size)
        for n in range(whole_vectors(size)):
            depth = max(radii[np.uint64(start) + np.uint64(n)] - block[TERM + n], zero)
            block[TERM + n] = depth * depth
        total += sum_of_terms(block, size)
    return total


@inner
def _collect_near(model, move, scratch):
    """Collect the balls that may touch the object as points, in their order; returns how many.

    Those whose radius is above the bound of the distance in the cell of their centre.
    """
    bounds, steps, radii = model.bounds, model.steps, model.radii
    points, near, cell = scratch.distances.points, scratch.near, scratch.cell
    _move_balls(model, move, scratch)
    table, total = bounds.steps, np.uint64(0)
    reach = model.span * bounds.inverse
    terms = 2.0 * reach + np.float64(max(abs(move[9]), abs(move[10]), abs(move[11])))
    is_coarse = not terms * _ROUNDING < ASTRAY  # numbers of 32 bits are, too far away
    for n in range(len(steps)):
        near[total] = n
        total += np.uint64((table[np.uint64(cell[n])] < steps[n]) | is_coarse)
    us, vs, ws, chosen = points[0], points[1], points[2], points[3]
    for n in range(total):
        ball = np.uint64(near[n])
        us[n], vs[n], ws[n], chosen[n] = us[ball], vs[ball], ws[ball], radii[ball]
    return np.int64(total)


@inner
def _move_balls(model, move, scratch):
    """Fill the points and cells of all balls."""
    bounds, zero = model.bounds, np.float32(0.0)
    most, across, along = bounds.most, np.float32(bounds.across), np.float32(bounds.along)
    p, q, r = np.float32(most[0]), np.float32(most[1]), np.float32(most[2])
    xs, ys, zs = model.centres[0], model.centres[1], model.centres[2]
    points, cell = scratch.distances.points, scratch.cell
    us, vs, ws = points[0], points[1], points[2]
    for n in range(model.centres.shape[1]):
        u, v, w = moved(move, xs[n], ys[n], zs[n])
        us[n], vs[n], ws[n] = u, v, w
        u, v, w = min(max(zero, u), p), min(max(zero, v), q), min(max(zero, w), r)
        cell[n] = np.int32(np.floor(u) * across + np.floor(v) * along + np.floor(w))


@implements(cost_of, MedialSearch)
def _search_cost_of(model, space, vector, scratch):
    return search_cost(model, decode(space, vector), scratch)


@implements(costs_of, MedialSearch)
def _search_costs_of(model, space, vectors, costs, scratch):
    for n in range(len(vectors)):
        costs[n] = np.inf
        if all_finite(vectors[n]):
            costs[n] = search_cost(model, decode(space, vectors[n]), scratch)
