"""The relaxed cost of poses and its gradient (CHSEL, Eqs. 7 to 10).

Sums run over free points in the order of their tree, then over occupied and known points in theirs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.cost.free_kernels import FreeTerm, Neighbours, free_sums, neighbours_of
from chsel.cost.pose_lanes import LANES, SIZE, SUMS, add_known, add_occupied
from chsel.numerics.arrays import FloatArray, scratch
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.pose_tuples import finite, pose_at
from chsel.problem.sdf_lookup import DistanceField


class Model(NamedTuple):
    """All that the relaxed cost of a pose depends on, but the pose; see CostSettings."""

    field: DistanceField
    free: FreeTerm
    occupied: FloatArray  # (3, K), world
    known: FloatArray  # (3, M), world
    known_sdf: FloatArray  # (M,)
    alpha: float
    free_scale: float
    occupied_scale: float
    known_scale: float
    known_tolerance: float
    exact_gradient: bool


class Work(NamedTuple):
    """Scratch of one thread."""

    lanes: FloatArray  # (SIZE,) see pose_lanes
    near: Neighbours


def work_of(model: Model, poses: int = LANES) -> Work:
    """Scratch of one thread; it remembers what is near to so many poses, at least LANES."""
    return Work(scratch(SIZE), neighbours_of(model.free, max(poses, LANES)))


@compiled
def costs_of_poses(model, poses, out, first, last, work):
    """Fill out (B,) with the costs of poses (B, 12), from `first` to before `last`."""
    for start in range(first, last, LANES):
        count = min(LANES, last - start)
        for lane in range(count):
            put_pose(work.lanes, lane, pose_at(poses, start + lane))
        evaluate(model, work, 0, count, 0.0)
        for lane in range(count):
            out[start + lane] = work.lanes[SUMS + lane]


@leaf
def put_pose(lanes, lane, pose):
    """Set the pose of a lane."""
    for i in range(12):
        lanes[LANES * i + lane] = pose[i]


@leaf
def _row(lanes, row, lane):
    return lanes[LANES * row + lane]


@leaf
def _pose_of(lanes, lane):
    """The pose of a lane."""
    a, b, c = _row(lanes, 0, lane), _row(lanes, 1, lane), _row(lanes, 2, lane)
    d, e, f = _row(lanes, 3, lane), _row(lanes, 4, lane), _row(lanes, 5, lane)
    g, h, i = _row(lanes, 6, lane), _row(lanes, 7, lane), _row(lanes, 8, lane)
    x, y, z = _row(lanes, 9, lane), _row(lanes, 10, lane), _row(lanes, 11, lane)
    return a, b, c, d, e, f, g, h, i, x, y, z


@leaf
def gradient_of(lanes, lane):
    """The gradient of the cost of a lane by its pose."""
    a, b, c = _row(lanes, 13, lane), _row(lanes, 14, lane), _row(lanes, 15, lane)
    d, e, f = _row(lanes, 16, lane), _row(lanes, 17, lane), _row(lanes, 18, lane)
    g, h, i = _row(lanes, 19, lane), _row(lanes, 20, lane), _row(lanes, 21, lane)
    x, y, z = _row(lanes, 22, lane), _row(lanes, 23, lane), _row(lanes, 24, lane)
    return a, b, c, d, e, f, g, h, i, x, y, z


@inner
def evaluate(model, work, first, count, most_slack):
    """The costs of the poses of the first `count` lanes, and their gradients, in their sums.

    Infinite costs for poses that are not finite. first: which of those that are remembered they
    are. most_slack: see free_sums.
    """
    lanes, near = work.lanes, work.near
    for row in range(12):
        for lane in range(count, LANES):
            lanes[LANES * row + lane] = lanes[LANES * row]
    for lane in range(count):
        pose = _pose_of(lanes, lane)
        if finite(pose):
            sums = free_sums(model, pose, near, first + lane, most_slack)
            lanes[SUMS + lane] = sums.cost
            for i in range(12):
                lanes[SUMS + LANES * (i + 1) + lane] = sums.by_pose[i]
    add_occupied(model, lanes)
    add_known(model, lanes)
    for lane in range(count):
        if not finite(_pose_of(lanes, lane)):
            lanes[SUMS + lane] = np.inf
            for i in range(12):
                lanes[SUMS + LANES * (i + 1) + lane] = 0.0


@leaf
def forget(work):
    """Make the next evaluation gather its neighbours anew."""
    work.near.slack[:] = -1.0
