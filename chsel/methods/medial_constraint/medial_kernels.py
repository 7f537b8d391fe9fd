"""The Medial Constraint cost of a pose, term by term."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import Places, locate, places_for
from chsel.numerics.compiler import compiled, inner, spliced
from chsel.numerics.pose_tuples import finite, pose_at
from chsel.problem.sdf_lookup import DistanceField, distance_in_place


class MedialModel(NamedTuple):
    """All that determines the cost of a pose."""

    field: DistanceField
    centres: FloatArray  # (3, N_b), of the balls, world, metres
    radii: FloatArray  # (N_b,)
    known: FloatArray  # (3, N_k), world, metres
    known_sdf: FloatArray  # (N_k,)
    ball_scale: float
    known_scale: float


def places_of(model: MedialModel) -> Places:
    """Scratch for one thread."""
    return places_for(max(len(model.radii), len(model.known_sdf)))


@inner
def medial_cost(model, pose, places):
    """mean_b max(0, r_b - s(R c_b + t))^2 + mean_k (s(R x_k + t) - v_k)^2, m^2, each scaled.

    Infinite for a pose that is not finite; a mean over nothing is 0.
    """
    if not finite(pose):
        return np.inf
    cost = model.ball_scale * _ball_mean(model, pose, places)
    cost += model.known_scale * _known_mean(model, pose, places)
    return cost if cost < np.inf else np.inf  # NaN is infinite, too


@spliced
def _ball_mean(model, pose, places):
    """The mean square of how deep balls reach into the object."""
    field, radii = model.field, model.radii
    box, xs, ys, zs = field.box, model.centres[0], model.centres[1], model.centres[2]
    locate(pose, box, xs, ys, zs, places, len(radii))
    total = 0.0
    for n in range(len(radii)):
        if places.beyond[n] < radii[n] * radii[n]:
            s = distance_in_place(field, pose, xs[n], ys[n], zs[n], places, n)[0]
            depth = max(radii[n] - s, 0.0)
            total += depth * depth
    return total / max(len(radii), 1)


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


@compiled
def medial_costs_of_poses(model, poses, out, first, last, places):
    """Fill out (B,) with the costs of poses (B, 12), from `first` to before `last`."""
    for n in range(first, last):
        out[n] = medial_cost(model, pose_at(poses, n), places)
