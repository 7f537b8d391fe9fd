"""The free term of the relaxed cost at one pose (CHSEL, Eq. 8), over the points that matter."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.cost.point_sums import NOTHING, SIZE, sums_over
from chsel.numerics.arrays import FloatArray, scratch
from chsel.numerics.cell_set import CellSet
from chsel.numerics.compiler import leaf, spliced
from chsel.numerics.near_points import (
    NearPoints,
    PointTree,
    gather,
    is_kept,
    near_points_for,
    select,
    to_cells,
)
from chsel.numerics.pose_tuples import Triple, inverted, rigid, turned_back

MOST_SLACK = 0.03  # metres, in a descent
SEARCH_SLACK = 0.02  # metres, among the branches of a search, which scatter
STEPS_AHEAD = 3.0  # that gathered neighbours should last


class FreeTerm(NamedTuple):
    """The points that the free term looks up, and the cells where they cost something.

    "The object" is, for free points, the cells; for interior points, all of them.
    """

    interior: bool  # interior points of the object in free voxels, else free points in the object
    exhaustive: bool  # look up all points
    tree: PointTree  # of free points of the world, or of interior points in the object frame
    cells: CellSet  # those of the object that read values below alpha, or free voxels of the world
    weights: FloatArray  # (4 N,) weight of interior points, and it times the inward normal
    centre: Triple  # of a sphere around the object, in its frame
    radius: float
    lower: Triple  # corners of a box of the world: where the object is beyond, nothing costs
    upper: Triple


class Neighbours(NamedTuple):
    """The points that can matter while poses move little (after Verlet, 1967); see remember."""

    points: NearPoints
    slack: FloatArray  # (P,) metres that the object may move until they are gathered anew, or -1
    gathered: FloatArray  # (P, 12) where the object was when they were gathered
    last: FloatArray  # (P, 12) where it was at the last evaluation
    block: FloatArray  # (SIZE,) numbers of the points that are looked up, see point_sums


def neighbours_of(free: FreeTerm, poses: int) -> Neighbours:
    """Scratch of one thread, for so many poses."""
    slack = scratch(poses)
    slack[:] = -1.0
    gathered, last = scratch(poses, 12), scratch(poses, 12)
    return Neighbours(near_points_for(free.tree, poses), slack, gathered, last, scratch(SIZE))


@leaf
def free_sums(model, pose, near, n, most_slack):
    """The free term of a finite pose, whose neighbours are the n-th.

    most_slack: MOST_SLACK or SEARCH_SLACK in a sequence of poses close to each other, which is
    faster then; 0.0 otherwise. The result is the same to the bit.
    """
    free, points = model.free, near.points
    total = len(free.tree.order)
    if total == 0:
        return NOTHING
    move = inverted(pose) if free.interior else pose
    to_cell, rounding = to_cells(free.tree, free.cells.box, move)
    count = 0
    if free.exhaustive or rounding < 0.0 or not rigid(pose):
        near.slack[n] = -1.0
        for at in range(total):
            points.hits[at] = at
        count = total
    else:
        slack = _slack_to_gather(free, pose, near, n, most_slack)
        if slack >= 0.0:
            _gather_within(free, pose, near, n, to_cell, slack, rounding)
        if points.number[n] > 0:
            count = select(free.tree, free.cells, to_cell, rounding, points, n)
    return sums_over(model, pose, move, points.hits, count, near.block)


@leaf
def _gather_within(free, pose, near, n, to_cell, slack, rounding):
    """Gather the points that can matter until the object has moved by `slack` metres."""
    points, reach = near.points, slack + rounding
    if is_apart(free, pose, reach):
        points.number[n] = 0
    else:
        gather(free.tree, free.cells, to_cell, reach, points, n)
        near.slack[n] = near.slack[n] if is_kept(points, n) else -1.0


@leaf
def _slack_to_gather(free, pose, near, n, most_slack):
    """The slack to gather points with; negative if those gathered last are all that matter."""
    if most_slack == 0.0:
        near.slack[n] = -1.0
        return 0.0
    slack = -1.0
    if near.slack[n] < 0.0 or travel(free, pose, near.gathered[n]) > near.slack[n]:
        stride = travel(free, pose, near.last[n]) if near.slack[n] >= 0.0 else np.inf
        slack = min(STEPS_AHEAD * stride, most_slack) if stride < most_slack else 0.0
        near.slack[n] = slack
        remember(free, pose, near.gathered[n])
    remember(free, pose, near.last[n])
    return slack


@leaf
def is_apart(free, pose, slack):
    """Whether the object is further than `slack` metres from where anything costs."""
    x, y, z = _centre_in_world(free, pose)
    lower, upper = free.lower, free.upper
    a = x - min(max(x, lower[0]), upper[0])
    b = y - min(max(y, lower[1]), upper[1])
    c = z - min(max(z, lower[2]), upper[2])
    reach = free.radius + slack
    return a * a + b * b + c * c > reach * reach * (1.0 + 1e-9)


@spliced
def travel(free, pose, memory):
    """How far in the world any point of the object moved since a pose was remembered, at most.

    As far as its centre, and for a turn D = R - R' by |D| radius; the spectral norm of the
    difference of two rotations is its Frobenius norm over sqrt(2).
    """
    x, y, z = _centre_in_world(free, pose)
    dx, dy, dz = x - memory[0], y - memory[1], z - memory[2]
    turn = 0.0
    for i in range(9):
        turn += (pose[i] - memory[3 + i]) * (pose[i] - memory[3 + i])
    return np.sqrt(dx * dx + dy * dy + dz * dz) + np.sqrt(0.5 * turn) * free.radius


@spliced
def remember(free, pose, memory):
    """Fill memory (12,) with the object's centre in the world and its rotation."""
    memory[0], memory[1], memory[2] = _centre_in_world(free, pose)
    for i in range(9):
        memory[3 + i] = pose[i]


@leaf
def _centre_in_world(free, pose):
    """R^T (c - t)."""
    x, y, z = free.centre
    return turned_back(pose, x - pose[9], y - pose[10], z - pose[11])
