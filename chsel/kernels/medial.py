"""The Medial Constraint cost of one pose (CHSEL, Sec. V-D; after Haugo and Stahl, 2020)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.arrays import FloatArray
from chsel.kernels.compiler import compiled, inner, spliced
from chsel.kernels.field import Field, continued, sample
from chsel.kernels.pose import decode, finite, pose_at
from chsel.kernels.region import Places, locate, places_for


class MedialModel(NamedTuple):
    """All that the cost of a pose hangs on; points and balls of the world, metres.

    least (nodes,): the least value that is read in a cell of the field's grid, or less. centres
    (3, N_b) and radii (N_b,) of the balls. known (3, N_k) and known_sdf (N_k,).
    """

    field: Field
    least: FloatArray
    centres: FloatArray
    radii: FloatArray
    known: FloatArray
    known_sdf: FloatArray
    ball_scale: float
    known_scale: float


def medial_places(model: MedialModel) -> Places:
    """Scratch for one thread."""
    return places_for(max(len(model.radii), len(model.known_sdf)))


@inner
def medial_cost(model, pose, places):  # type: ignore[no-untyped-def]
    """mean_b max(0, r_b - s(R c_b + t))^2 + mean_k (s(R x_k + t) - v_k)^2, m^2, each scaled.

    Infinite for a pose that is not finite; a mean over nothing is 0.
    """
    if not finite(pose):
        return np.inf
    cost = model.ball_scale * _ball_mean(model, pose, places)
    cost += model.known_scale * _known_mean(model, pose, places)
    return cost if cost < np.inf else np.inf  # nan is infinite, too


@spliced
def _ball_mean(model, pose, places):  # type: ignore[no-untyped-def]
    """The mean square of how deep balls reach into the object.

    A ball is looked up only where it can reach so far: beyond the grid, an object that lies within
    is no nearer than the hypotenuse of the ways to the grid and from there.
    """
    field, radii, least = model.field, model.radii, model.least
    box, xs, ys, zs = field.box, model.centres[0], model.centres[1], model.centres[2]
    locate(pose, box, xs, ys, zs, places, len(radii))
    total = 0.0
    for n in range(len(radii)):
        beyond, radius = places.beyond[n], radii[n]
        further = max(least[places.cell[n]], 0.0)
        further = 0.0 if field.box_distance and beyond > 0.0 else further * further
        if beyond + further < radius * radius:
            depth = max(radius - _distance(field, pose, xs[n], ys[n], zs[n], places, n), 0.0)
            total += depth * depth
    return total / max(len(radii), 1)


@spliced
def _known_mean(model, pose, places):  # type: ignore[no-untyped-def]
    """The mean square of s - v over points of known signed distance v, 0 for contacts."""
    field, known_sdf = model.field, model.known_sdf
    box, xs, ys, zs = field.box, model.known[0], model.known[1], model.known[2]
    locate(pose, box, xs, ys, zs, places, len(known_sdf))
    total = 0.0
    for n in range(len(known_sdf)):
        difference = _distance(field, pose, xs[n], ys[n], zs[n], places, n) - known_sdf[n]
        total += difference * difference
    return total / max(len(known_sdf), 1)


@inner
def _distance(field, pose, x, y, z, places, n):  # type: ignore[no-untyped-def]
    """Signed distance at the n-th of the places, that of a world point x, y, z."""
    if places.beyond[n] > 0.0:
        inside = sample(field.trilinear, field.box, field.table, places, n)
        a = pose[0] * x + pose[1] * y + pose[2] * z + pose[9]
        b = pose[3] * x + pose[4] * y + pose[5] * z + pose[10]
        c = pose[6] * x + pose[7] * y + pose[8] * z + pose[11]
        return continued(field.box_distance, field.box, inside, a, b, c)[0]
    return sample(field.trilinear, field.box, field.table, places, n)[0]


@spliced
def cost_of(model, space, vector, places):  # type: ignore[no-untyped-def]
    """The cost of a search vector (d,)."""
    return medial_cost(model, decode(space, vector), places)


@compiled
def medial_costs_of_poses(model, poses, out, first, last, places):  # type: ignore[no-untyped-def]
    """Fill out (B,) with the costs of poses (B, 12), from `first` to before `last`."""
    for n in range(first, last):
        out[n] = medial_cost(model, pose_at(poses, n), places)
