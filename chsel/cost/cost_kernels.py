"""The relaxed cost of poses and its gradient (CHSEL, Eqs. 7 to 10).

Sums run over free points in the order of their tree, then over occupied and known points in theirs.
Several poses are evaluated together, each in a lane of vector instructions. A lane does what it
would do alone, in the same order, so that no result depends on the others. The numbers of all lanes
are in one array, a row of LANES for each quantity. Loops over the lanes become vector code because
they read and write nothing else.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.cost.free_kernels import (
    FreeTerm,
    Neighbours,
    between_nodes,
    free_sums,
    neighbours_of,
    slope,
    weigh_corners,
)
from chsel.numerics.arrays import FloatArray, scratch
from chsel.numerics.cell_set import node_of
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.pose_tuples import finite, pose_at
from chsel.problem.sdf_lookup import DistanceField, at_node

LANES = 8
# The first 12 rows are the poses.
SUMS = 12 * LANES  # the first of 13 rows: costs, and their gradients by the poses
_LENGTH = 25 * LANES  # of what follows
_AWAY = 26 * LANES  # the first of 3 rows: from the nearest point of the grid's box
_BEYOND = 29 * LANES  # its square
_PLACE = 30 * LANES  # the first of 3 rows: from the node of the cell, in cells
_CELL = 33 * LANES
_READ = 34 * LANES  # the first of 4 rows: signed distance and gradient
_WEIGHT = 38 * LANES  # the first of 8 rows: how much each corner of the cell counts
_SIZE = 46 * LANES
_SHORTEST = 1e-12


class Model(NamedTuple):
    """Data of the relaxed cost, but the pose; see CostSettings."""

    field: DistanceField  # of the object
    free: FreeTerm  # Eq. 8
    occupied: FloatArray  # (3, K), world
    known: FloatArray  # (3, M), world
    known_sdf: FloatArray  # (M,)
    alpha: float  # penetration tolerance, metres
    free_scale: float  # lambda of free points
    occupied_scale: float  # lambda of occupied points
    known_scale: float  # of known points
    known_tolerance: float  # metres that known points may be off
    exact_gradient: bool  # else as the paper defines it


class Work(NamedTuple):
    """Scratch of one thread."""

    lanes: FloatArray  # (_SIZE,) rows of LANES
    near: Neighbours  # of as many poses as are remembered


def work_of(model: Model, poses: int = LANES) -> Work:
    """Return scratch of one thread; it remembers what is near to so many poses, at least LANES."""
    return Work(scratch(_SIZE), neighbours_of(model.free, max(poses, LANES)))


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
def gradient_of(lanes, lane):
    """Return the gradient of the cost of a lane by its pose."""
    return _twelve(lanes, SUMS + LANES + lane)


@leaf
def _twelve(lanes, at):
    """Return the numbers of a lane in twelve rows, from `at` on."""
    a, b, c = lanes[at], lanes[at + LANES], lanes[at + 2 * LANES]
    d, e, f = lanes[at + 3 * LANES], lanes[at + 4 * LANES], lanes[at + 5 * LANES]
    g, h, i = lanes[at + 6 * LANES], lanes[at + 7 * LANES], lanes[at + 8 * LANES]
    x, y, z = lanes[at + 9 * LANES], lanes[at + 10 * LANES], lanes[at + 11 * LANES]
    return a, b, c, d, e, f, g, h, i, x, y, z


@inner
def evaluate(model, work, first, count, most_slack):
    """Fill sums with the costs of the poses of the first `count` lanes, and their gradients.

    Costs of poses that are not finite are infinite. first: index of the first of these poses among
    those remembered. most_slack: see free_sums.
    """
    lanes, near = work.lanes, work.near
    for row in range(12):
        for lane in range(count, LANES):
            lanes[LANES * row + lane] = lanes[LANES * row]
    for lane in range(count):
        pose = _twelve(lanes, lane)
        if finite(pose):
            sums = free_sums(model, pose, near, first + lane, most_slack)
            lanes[SUMS + lane] = sums.cost
            for i in range(12):
                lanes[SUMS + LANES * (i + 1) + lane] = sums.by_pose[i]
    _add_occupied(model, lanes)
    _add_known(model, lanes)
    for lane in range(count):
        if not finite(_twelve(lanes, lane)):
            lanes[SUMS + lane] = np.inf
            for i in range(12):
                lanes[SUMS + LANES * (i + 1) + lane] = 0.0


@leaf
def forget(work):
    """Make the next evaluation gather its neighbours."""
    work.near.slack[:] = -1.0


@inner
def _add_occupied(model, lanes):
    """Add lambda sum max(0, alpha + s), with gradient lambda max(0, alpha + s) n (Eq. 9)."""
    xs, ys, zs = model.occupied[0], model.occupied[1], model.occupied[2]
    for n in range(len(xs)):
        x, y, z = xs[n], ys[n], zs[n]
        _read(model.field, lanes, x, y, z)
        _add_violations(model, lanes, x, y, z)


@inner
def _add_known(model, lanes):
    """Add sum |s - v|, with gradient (s - v) n, over points of known signed distance (Eq. 10)."""
    xs, ys, zs = model.known[0], model.known[1], model.known[2]
    for n in range(len(xs)):
        x, y, z = xs[n], ys[n], zs[n]
        _read(model.field, lanes, x, y, z)
        _add_differences(model, lanes, model.known_sdf[n], x, y, z)


@inner
def _add_violations(model, lanes, x, y, z):
    scale = model.occupied_scale
    alpha = model.alpha
    exact = model.exact_gradient
    for at in range(LANES):
        violation = max(alpha + lanes[_READ + at], 0.0)
        size = scale * slope(exact, violation)
        value = scale * violation
        _add(lanes, at, value, size, x, y, z)


@inner
def _add_differences(model, lanes, known_sdf, x, y, z):
    scale = model.known_scale
    tolerance = model.known_tolerance
    exact = model.exact_gradient
    for at in range(LANES):
        difference = lanes[_READ + at] - known_sdf
        excess = max(abs(difference) - tolerance, 0.0)
        size = scale * slope(exact, excess)
        size = size if difference > 0.0 else -size
        value = scale * excess
        _add(lanes, at, value, size, x, y, z)


@leaf
def _add(lanes, at, value, size, x, y, z):
    """Add a value, and the gradient of size times normal at a world point."""
    gx, gy, gz = (
        size * lanes[_READ + LANES + at],
        size * lanes[_READ + 2 * LANES + at],
        size * lanes[_READ + 3 * LANES + at],
    )
    lanes[SUMS + at] += value
    lanes[SUMS + LANES + at] += gx * x
    lanes[SUMS + 2 * LANES + at] += gx * y
    lanes[SUMS + 3 * LANES + at] += gx * z
    lanes[SUMS + 4 * LANES + at] += gy * x
    lanes[SUMS + 5 * LANES + at] += gy * y
    lanes[SUMS + 6 * LANES + at] += gy * z
    lanes[SUMS + 7 * LANES + at] += gz * x
    lanes[SUMS + 8 * LANES + at] += gz * y
    lanes[SUMS + 9 * LANES + at] += gz * z
    lanes[SUMS + 10 * LANES + at] += gx
    lanes[SUMS + 11 * LANES + at] += gy
    lanes[SUMS + 12 * LANES + at] += gz


@leaf
def _read(field, lanes, x, y, z):
    """Read signed distance and gradient at a world point, which is elsewhere for each pose."""
    _locate(field.box, lanes, x, y, z)
    beyond = 0.0
    if field.trilinear:
        weigh_corners(lanes, LANES, _PLACE, _WEIGHT, LANES)
    for at in range(LANES):
        cell = np.uint64(np.int64(lanes[_CELL + at]))
        if field.trilinear:
            s, nx, ny, nz = between_nodes(field, cell, lanes, LANES, _WEIGHT + at)
        else:
            s, nx, ny, nz = at_node(field.table, cell)
        lanes[_READ + at], lanes[_READ + LANES + at] = s, nx
        lanes[_READ + 2 * LANES + at], lanes[_READ + 3 * LANES + at] = ny, nz
        beyond = max(beyond, lanes[_BEYOND + at])
    if beyond > 0.0:
        _go_beyond(field.box_distance, lanes)


@leaf
def _locate(box, lanes, x, y, z):
    first = box.first
    last = box.last
    most = box.most
    inverse = box.inverse
    for at in range(LANES):
        a = lanes[at] * x + lanes[LANES + at] * y + lanes[2 * LANES + at] * z
        b = lanes[3 * LANES + at] * x + lanes[4 * LANES + at] * y + lanes[5 * LANES + at] * z
        c = lanes[6 * LANES + at] * x + lanes[7 * LANES + at] * y + lanes[8 * LANES + at] * z
        a, b = a + lanes[9 * LANES + at], b + lanes[10 * LANES + at]
        c = c + lanes[11 * LANES + at]
        d = min(max(first[0], a), last[0])  # in this order, NaN ends up in the box
        e = min(max(first[1], b), last[1])
        f = min(max(first[2], c), last[2])
        a, b, c = a - d, b - e, c - f
        lanes[_BEYOND + at] = a * a + b * b + c * c
        lanes[_AWAY + at], lanes[_AWAY + LANES + at], lanes[_AWAY + 2 * LANES + at] = a, b, c
        a, b, c = (d - first[0]) * inverse, (e - first[1]) * inverse, (f - first[2]) * inverse
        d = node_of(a, box.between, most[0])
        e = node_of(b, box.between, most[1])
        f = node_of(c, box.between, most[2])
        lanes[_PLACE + at], lanes[_PLACE + LANES + at] = a - d, b - e
        lanes[_PLACE + 2 * LANES + at] = c - f
        lanes[_CELL + at] = d * box.across + e * box.along + f


@leaf
def _go_beyond(box_distance, lanes):
    """Fill distances outside of the box from those at its nearest points; see SdfGrid.

    Quotients have a loop of their own: where a choice follows, LLVM divides in a branch, lane by
    lane.
    """
    if not box_distance:
        for at in range(LANES):
            s, nx = lanes[_READ + at], lanes[_READ + LANES + at]
            ny, nz = lanes[_READ + 2 * LANES + at], lanes[_READ + 3 * LANES + at]
            length = max(np.sqrt(nx * nx + ny * ny + nz * nz), _SHORTEST)
            lanes[_AWAY + at] += s * (nx / length)
            lanes[_AWAY + LANES + at] += s * (ny / length)
            lanes[_AWAY + 2 * LANES + at] += s * (nz / length)
    for at in range(LANES):
        ax, ay = lanes[_AWAY + at], lanes[_AWAY + LANES + at]
        az = lanes[_AWAY + 2 * LANES + at]
        length = max(np.sqrt(ax * ax + ay * ay + az * az), _SHORTEST)
        lanes[_LENGTH + at], lanes[_AWAY + at] = length, ax / length
        lanes[_AWAY + LANES + at], lanes[_AWAY + 2 * LANES + at] = ay / length, az / length
    for row in range(4):
        for at in range(LANES):
            inside = lanes[_READ + row * LANES + at]
            outside = lanes[_LENGTH + row * LANES + at]
            lanes[_READ + row * LANES + at] = outside if lanes[_BEYOND + at] > 0.0 else inside
