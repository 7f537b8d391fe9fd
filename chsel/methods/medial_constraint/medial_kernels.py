"""The Medial Constraint cost of a pose."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.cost.objective import cost_of, costs_of
from chsel.methods.medial_constraint.least_distances import ASTRAY, LeastDistances
from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import Places, locate, places_for
from chsel.numerics.compiler import compiled, implements, inner, spliced
from chsel.numerics.pose_tuples import Triple, all_finite, decode, finite, moved, pose_at
from chsel.problem.sdf_lookup import DistanceField, distance_in_box, distance_in_place

_ROUNDING = 4e-7  # of the terms of a sum of three products and a number, all of 32 bits


class MedialModel(NamedTuple):
    """All that determines the cost of a pose."""

    field: DistanceField
    values: FloatArray  # (nodes,) signed distances of the field
    least: FloatArray  # (nodes,), at most the least value that is read in the cell of each node
    bounds: LeastDistances
    centres: FloatArray  # (3, N_b), of the balls, world, metres
    radii: FloatArray  # (N_b,)
    middle: Triple  # of the balls, world, metres
    span: float  # the greatest coordinate of a ball's centre from there, metres
    balls: Any  # (4, N_b) centres from there, and radii rounded up; float32
    known: FloatArray  # (3, N_k), world, metres
    known_sdf: FloatArray  # (N_k,)
    ball_scale: float
    known_scale: float


class MedialScratch(NamedTuple):
    """Scratch of one thread, for S balls or points."""

    places: Places
    near: Any  # (S,) numbers of balls that may touch the object; int32
    balls: FloatArray  # (4, S) their centres and radii
    read: FloatArray  # (4, S) value and gradient of the field in their places


def medial_scratch(model: MedialModel) -> MedialScratch:
    """Scratch for one thread."""
    size = max(len(model.radii), len(model.known_sdf))
    near = np.empty(size, dtype=np.int32)
    return MedialScratch(places_for(size), near, np.empty((4, size)), np.empty((4, size)))


@inner
def medial_cost(model, pose, scratch):
    """mean_b max(0, r_b - s(R c_b + t))^2 + mean_k (s(R x_k + t) - v_k)^2, m^2, each scaled.

    Infinite for a pose that is not finite; a mean over nothing is 0.
    """
    if not finite(pose):
        return np.inf
    cost = model.ball_scale * _ball_mean(model, pose, scratch)
    cost += model.known_scale * _known_mean(model, pose, scratch.places)
    return cost if cost < np.inf else np.inf  # NaN is infinite, too


@spliced
def _ball_mean(model, pose, scratch):
    """The mean square of how deep balls reach into the object.

    All but the balls that are left out count as 0. One loop for each step, so that numbers are
    taken several at a time.
    """
    balls, places = scratch.balls, scratch.places
    count = _collect_near(model, pose, scratch)
    locate(pose, model.field.box, balls[0], balls[1], balls[2], places, count)
    _read_field(model, scratch, count)
    _square_depths(model.field, pose, scratch, count)
    squares, total = scratch.read[0], 0.0
    for n in range(count):
        total += squares[n]
    return total / max(len(model.radii), 1)


@inner
def _collect_near(model, pose, scratch):
    """Collect the balls that may touch the object, in their order; returns how many."""
    bounds, radii, centres = model.bounds, model.radii, model.centres
    balls, near = scratch.balls, scratch.near
    x, y, z = moved(pose, model.middle[0], model.middle[1], model.middle[2])
    first, k = bounds.first, bounds.inverse
    x, y, z = (x - first[0]) * k, (y - first[1]) * k, (z - first[2]) * k
    reach = model.span * k
    terms = (abs(pose[0]) + abs(pose[1]) + abs(pose[2])) * reach + abs(x)
    terms = max(terms, (abs(pose[3]) + abs(pose[4]) + abs(pose[5])) * reach + abs(y))
    terms = max(terms, (abs(pose[6]) + abs(pose[7]) + abs(pose[8])) * reach + abs(z))
    if terms * _ROUNDING < ASTRAY:
        total = _sort_out(model, pose, x, y, z, scratch)
    else:  # numbers of 32 bits are too coarse
        total = len(radii)
        for n in range(total):
            near[n] = n
    for n in range(total):
        ball = near[n]
        balls[0, n], balls[1, n], balls[2, n] = centres[0, ball], centres[1, ball], centres[2, ball]
        balls[3, n] = radii[ball]
    return total


@inner
def _sort_out(model, pose, x, y, z, scratch):
    """Fill scratch.near by the bounds, with the balls' middle moved to x, y, z cells."""
    bounds, k, zero = model.bounds, model.bounds.inverse, np.float32(0.0)
    table, most, near, cell = bounds.table, bounds.most, scratch.near, scratch.places.cell
    across, along = np.int32(bounds.across), np.int32(bounds.along)
    p, q, r = np.float32(most[0]), np.float32(most[1]), np.float32(most[2])
    a, b, c = np.float32(pose[0] * k), np.float32(pose[1] * k), np.float32(pose[2] * k)
    d, e, f = np.float32(pose[3] * k), np.float32(pose[4] * k), np.float32(pose[5] * k)
    g, h, i = np.float32(pose[6] * k), np.float32(pose[7] * k), np.float32(pose[8] * k)
    x, y, z = np.float32(x), np.float32(y), np.float32(z)
    xs, ys, zs, radii = model.balls[0], model.balls[1], model.balls[2], model.balls[3]
    for n in range(len(radii)):
        u = min(max(zero, a * xs[n] + b * ys[n] + c * zs[n] + x), p)
        v = min(max(zero, d * xs[n] + e * ys[n] + f * zs[n] + y), q)
        w = min(max(zero, g * xs[n] + h * ys[n] + i * zs[n] + z), r)
        cell[n] = np.int32(u) * across + np.int32(v) * along + np.int32(w)
    total = 0
    for n in range(len(radii)):
        near[total] = n
        total += 1 if table[np.uint64(cell[n])] < radii[n] else 0
    return total


@inner
def _read_field(model, scratch, count):
    """Fill scratch.read: what the field says in each place; of the box alone the distance.

    The radius of a ball that does not count becomes -inf. From beyond the grid, the object is no
    nearer than the hypotenuse of the distance to the grid and the distance from there.
    """
    field, places, radii, read = model.field, scratch.places, scratch.balls[3], scratch.read
    values, least, beyond, cell = model.values, model.least, places.beyond, places.cell
    across, along = int(field.box.across), int(field.box.along)
    for n in range(count):
        at, away = cell[n], beyond[n] > 0.0
        further = max(least[at], 0.0)
        further = 0.0 if field.box_distance and away else further * further
        radii[n] = radii[n] if beyond[n] + further < radii[n] * radii[n] else -np.inf
        if away and not field.box_distance:
            s, x, y, z = distance_in_box(field, places, n)
            read[0, n], read[1, n], read[2, n], read[3, n] = s, x, y, z
        elif field.trilinear:
            u, v, w, s = places.u[n], places.v[n], places.w[n], 0.0
            for corner in range(8):
                i, j, k = corner >> 2, (corner >> 1) & 1, corner & 1
                weight = (u if i else 1.0 - u) * (v if j else 1.0 - v) * (w if k else 1.0 - w)
                s += weight * values[at + i * across + j * along + k]
            read[0, n] = s
        else:
            read[0, n] = values[at]


@inner
def _square_depths(field, pose, scratch, count):
    """Replace read[0] by max(0, r - s)^2; beyond the box as in `distance_beyond_box`."""
    first, last, box_distance = field.box.first, field.box.last, field.box_distance
    xs, ys, zs, radii = scratch.balls[0], scratch.balls[1], scratch.balls[2], scratch.balls[3]
    ss, nxs, nys, nzs = scratch.read[0], scratch.read[1], scratch.read[2], scratch.read[3]
    beyond = scratch.places.beyond
    for n in range(count):
        x, y, z = moved(pose, xs[n], ys[n], zs[n])
        x -= min(max(x, first[0]), last[0])
        y -= min(max(y, first[1]), last[1])
        z -= min(max(z, first[2]), last[2])
        s = ss[n]
        if not box_distance:
            nx, ny, nz = nxs[n], nys[n], nzs[n]
            length = max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
            x += s * (nx / length)
            y += s * (ny / length)
            z += s * (nz / length)
        away = max(np.sqrt(x * x + y * y + z * z), 1e-12)
        depth = max(radii[n] - (away if beyond[n] > 0.0 else s), 0.0)
        ss[n] = depth * depth


@spliced
def _known_mean(model, pose, places):
    """The mean square of s - v over points of known signed distance v, 0 for contacts."""
    field, known_sdf = model.field, model.known_sdf
    box, xs, ys, zs = field.box, model.known[0], model.known[1], model.known[2]
    locate(pose, box, xs, ys, zs, places, len(known_sdf))
    total = 0.0
    for n in range(len(known_sdf)):
        s = distance_in_place(field, pose, xs[n], ys[n], zs[n], places, n)[0]
        difference = s - known_sdf[n]
        total += difference * difference
    return total / max(len(known_sdf), 1)


@implements(cost_of, MedialModel)
def _medial_cost_of(model, space, vector, scratch):
    return medial_cost(model, decode(space, vector), scratch)


@implements(costs_of, MedialModel)
def _medial_costs_of(model, space, vectors, costs, scratch):
    for n in range(len(vectors)):
        costs[n] = np.inf
        if all_finite(vectors[n]):
            costs[n] = medial_cost(model, decode(space, vectors[n]), scratch)


@compiled
def medial_costs_of_poses(model, poses, out, first, last, scratch):
    """Fill out (B,) with the costs of poses (B, 12), from `first` to before `last`."""
    for n in range(first, last):
        out[n] = medial_cost(model, pose_at(poses, n), scratch)
