"""The energy of a pose: its relaxed cost, given up once it is above a limit.

Known points come first, as they are the fewest and tell the most.
"""

from __future__ import annotations

import numpy as np

from chsel.cost.cost_kernels import Model
from chsel.numerics.cell_set import locate
from chsel.numerics.compiler import compiled, inner
from chsel.numerics.octree import Candidates, candidates_for, walk
from chsel.numerics.pose_tuples import pose_at
from chsel.problem.sdf_lookup import distance_at, value_between_nodes


def found_around(model: Model) -> Candidates:
    """Scratch of one thread for the points of a model."""
    return candidates_for(max(model.free.tree.spheres.shape[1], 1))


@inner
def known_below(model, pose, limit):
    """What known and occupied points cost; infinite if it is above the limit."""
    total = 0.0
    known, field = model.known, model.field
    for n in range(known.shape[1]):
        s = distance_at(field, pose, known[0, n], known[1, n], known[2, n])
        total += model.known_scale * max(abs(s - model.known_sdf[n]) - model.known_tolerance, 0.0)
        if not total <= limit:
            return np.inf
    occupied = model.occupied
    for n in range(occupied.shape[1]):
        s = distance_at(field, pose, occupied[0, n], occupied[1, n], occupied[2, n])
        total += model.occupied_scale * max(model.alpha + s, 0.0)
        if not total <= limit:
            return np.inf
    return total


@inner
def with_free(model, pose, total, limit, found, count):
    """A sum with what the first `count` of the points found cost; infinite if above the limit."""
    free, box, table = model.free, model.field.box, model.field.table
    across, along = int(box.across), int(box.along)
    clearance, places = free.region.clearance, found.places
    locate(pose, free.region.box, found.x, found.y, found.z, places, count)
    for n in range(count):
        at = places.cell[n]
        if clearance[at] < 0.0 and places.beyond[n] == 0.0:
            s = value_between_nodes(table, at, across, along, places.u[n], places.v[n], places.w[n])
            total += model.free_scale * max(model.alpha - s, 0.0)
            if not total <= limit:
                return np.inf
    return total


@inner
def energy_below(model, pose, limit, found):
    """The energy of a pose, a rigid one; infinite if it is above the limit."""
    total = known_below(model, pose, limit)
    if not total <= limit:
        return np.inf
    count = walk(model.free.tree, model.free.region, pose, 0.0, found)
    return with_free(model, pose, total, limit, found, count)


@compiled
def energies_below(model, poses, limit, out, first, last, found):
    """Fill out (B,) with the energies of poses (B, 12) up to a limit, from `first` to `last`."""
    for n in range(first, last):
        out[n] = energy_below(model, pose_at(poses, n), limit, found)
