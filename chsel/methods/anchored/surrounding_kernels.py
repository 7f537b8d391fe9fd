"""The free points that can cost something at a pose, gathered once for poses close to each other.

They are left out in 32-bit arithmetic, which leaves out none that matters: those that remain are
looked up in 64 bits, in the order of the tree, so that a sum over them is that over all points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.cost.cost_kernels import Model
from chsel.cost.free_kernels import is_apart, remember, travel
from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import Places, locate, places_for
from chsel.numerics.compiler import inner, spliced
from chsel.numerics.near_points import NearPoints, near_points_for, select, to_cells
from chsel.numerics.near_points import gather as gather_near
from chsel.numerics.pose_tuples import rigid

_ALL = -1  # instead of the number of points that were gathered


class Surrounding(NamedTuple):
    """The free points that can matter while a pose moves little: scratch of one thread."""

    points: NearPoints  # one list
    memory: FloatArray  # (12,), where the object was when they were gathered, see remember
    x: FloatArray  # (S,), those that are looked up, in the world
    y: FloatArray
    z: FloatArray
    places: Places  # theirs, or those of known points


def surrounding_for(model: Model) -> Surrounding:
    """Scratch for one thread."""
    size = max(len(model.free.tree.order), model.known.shape[1], 1)
    x, y, z = (np.empty(size) for _ in range(3))
    near = near_points_for(model.free.rough, 1)
    return Surrounding(near, np.empty(12), x, y, z, places_for(size))


@inner
def gather(model, pose, slack, near):
    """Gather the free points that can matter until the object moves by a slack, metres."""
    free, points = model.free, near.points
    remember(free, pose, near.memory)
    to_cell, rounding = to_cells(free.rough, free.cells.box, pose)
    if len(free.tree.order) == 0:
        points.number[0] = 0
    elif rounding < 0.0 or not rigid(pose):
        points.number[0] = _ALL
    elif is_apart(free, pose, slack + free.margin):
        points.number[0] = 0
    else:
        reach = slack + free.margin + rounding
        gather_near(free.rough, free.cells, to_cell, reach, points, 0)


@inner
def look_around(model, pose, near):
    """Fill the places of those gathered that may cost something at a pose; returns how many."""
    free, points = model.free, near.points
    if points.number[0] == 0:
        return 0
    to_cell, rounding = to_cells(free.rough, free.cells.box, pose)
    if points.number[0] == _ALL or rounding < 0.0:
        count = len(free.tree.order)
        for at in range(count):
            points.hits[at] = at
    else:
        count = select(free.cells, to_cell, rounding + free.margin, points, 0)
    spheres, nodes = free.tree.spheres, len(free.tree.starts) - 1
    for n in range(count):
        at = nodes + points.hits[n]
        near.x[n], near.y[n], near.z[n] = spheres[0, at], spheres[1, at], spheres[2, at]
    locate(pose, free.region.box, near.x, near.y, near.z, near.places, count)
    return count


@spliced
def travel_since_gathering(model, pose, near):
    """How far in the world any point of the object moved at most, metres."""
    return travel(model.free, pose, near.memory)
