"""The free term of the relaxed cost at one pose (CHSEL, Eq. 8), over the points that matter."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray, scratch
from chsel.numerics.cell_set import CellSet, node_of
from chsel.numerics.compiler import inner, leaf, spliced
from chsel.numerics.near_points import (
    NearPoints,
    PointTree,
    gather,
    near_points_for,
    select,
    to_cells,
)
from chsel.numerics.pose_tuples import Pose, Triple, inverted, rigid, turned_back
from chsel.problem.sdf_lookup import at_node

MOST_SLACK = 0.03  # metres, in a descent
SEARCH_SLACK = 0.02  # metres, among the branches of a search, which scatter
STEPS_AHEAD = 3.0  # that gathered neighbours should last


# A block holds the numbers of 64 points, a row for each quantity or four numbers for each point.
_MOST = 64
_LEVEL = 0  # row: below which signed distance a point costs something; beyond the box none does
_PLACE = 1 * _MOST  # the first of 3 rows: from the node of the cell, in cells
_CELL = 4 * _MOST  # row
_POINT = 5 * _MOST  # the first of 3 rows
_WEIGHT = 8 * _MOST  # the first of 8 rows: how much each corner of the cell counts
_SUMMAND = 16 * _MOST  # four: a number, and the gradient by the translation
_VALUE = 20 * _MOST  # row
_SUMS = 21 * _MOST  # 3 times a number and 3 of the gradient by the rotation; summands; values
_SIZE = 21 * _MOST + 17


class CostAndGradient(NamedTuple):
    """The relaxed cost of a pose, and its gradient by the pose's 12 numbers."""

    cost: float  # C(X)
    by_pose: Pose  # its gradient


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
    radius: float  # of the sphere, metres
    lower: Triple  # corners of a box of the world: where the object is beyond, nothing costs
    upper: Triple  # the other corner


class Neighbours(NamedTuple):
    """The points that can matter while poses move little (after Verlet, 1967); see remember."""

    points: NearPoints  # gathered
    slack: FloatArray  # (P,) metres that the object may move until they are stale, or -1
    gathered: FloatArray  # (P, 12) where the object was when they were gathered
    last: FloatArray  # (P, 12) where it was at the last evaluation
    block: FloatArray  # (_SIZE,) numbers of the points that are looked up


def neighbours_of(free: FreeTerm, poses: int) -> Neighbours:
    """Return scratch of one thread, for so many poses."""
    slack = scratch(poses)
    slack[:] = -1.0
    gathered, last = scratch(poses, 12), scratch(poses, 12)
    return Neighbours(
        near_points_for(free.tree, poses), slack, gathered=gathered, last=last, block=scratch(_SIZE)
    )


@leaf
def free_sums(model, pose, near, n, most_slack):
    """Return the free term of a finite pose, whose neighbours are the n-th.

    most_slack: MOST_SLACK or SEARCH_SLACK in a sequence of poses close to each other, which is
    faster then; 0.0 otherwise. The result is the same to the bit.
    """
    free, points = model.free, near.points
    total = len(free.tree.order)
    if total == 0:
        return CostAndGradient(0.0, (0.0,) * 12)
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
        if slack >= 0.0 and is_apart(free, pose, slack + rounding):
            points.number[n] = 0
        elif slack >= 0.0:
            gather(free.tree, free.cells, to_cell, slack + rounding, points, n)
        if points.number[n] > 0:
            count = select(free.tree, free.cells, to_cell, rounding, points, n)
    return _sums_over(model, pose, move, points.hits, count, near.block)


@leaf
def _slack_to_gather(free, pose, near, n, most_slack):
    """Return the slack to gather points with; negative if those gathered last suffice."""
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
    """Return whether the object is further than `slack` metres from where anything costs."""
    x, y, z = _centre_in_world(free, pose)
    lower, upper = free.lower, free.upper
    a = x - min(max(x, lower[0]), upper[0])
    b = y - min(max(y, lower[1]), upper[1])
    c = z - min(max(z, lower[2]), upper[2])
    reach = free.radius + slack
    return a * a + b * b + c * c > reach * reach * (1.0 + 1e-9)


@spliced
def travel(free, pose, memory):
    """Return a bound on the motion of the object's points since a pose was remembered, metres.

    The motion of its centre, and for a turn D = R - R' |D| radius; the spectral norm of the
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
    """Return R^T (c - t)."""
    x, y, z = free.centre
    return turned_back(pose, x - pose[9], y - pose[10], z - pose[11])


@leaf
def slope(exact, violation):
    """Return the violation itself, as the paper defines the gradient, or that of its value."""
    if exact:
        return 1.0 if violation > 0.0 else 0.0
    return violation


@leaf
def _sums_over(model, pose, move, numbers, count, block):
    """Return the sums over the first `count` points by number, block by block."""
    free = model.free
    points = free.tree.points
    for i in range(17):
        block[_SUMS + i] = 0.0
    for first in range(0, count, _MOST):
        size = min(_MOST, count - first)
        for n in range(np.uint64(size)):
            at = np.uint64(numbers[np.uint64(first) + n])
            block[np.uint64(_POINT) + n] = points[0, at]
            block[np.uint64(_POINT + _MOST) + n] = points[1, at]
            block[np.uint64(_POINT + 2 * _MOST) + n] = points[2, at]
        whole = (size + 3) // 4 * 4  # vectors read what is left of another block, for nothing
        _locate(move, free.cells.box, model.alpha, block, whole)
        if free.interior:
            _read_weights(free, numbers, first, block, size)
            _subtract_points(pose, block, whole)
            _add_weights(pose, block, size)
        else:
            if model.field.trilinear:
                weigh_corners(block, _MOST, _PLACE, _WEIGHT, whole)
                _violate_between_nodes(model, block, size)
            else:
                _violate_at_nodes(model, block, size)
            _add_violations(block, size)
    _, a, b, c = _four(block, _SUMS, 0)
    _, d, e, f = _four(block, _SUMS, 1)
    _, g, h, i = _four(block, _SUMS, 2)
    value, x, y, z = _four(block, _SUMS, 3)
    if free.interior:
        return CostAndGradient(value, (a, b, c, d, e, f, g, h, i, x, y, z))
    return CostAndGradient(block[_SUMS + 16], (a, d, g, b, e, h, c, f, i, x, y, z))


@leaf
def _put(block, first, n, four):
    """Set the four numbers of the n-th point."""
    at = np.uint64(first) + np.uint64(4) * np.uint64(n)
    block[at], block[at + np.uint64(1)] = four[0], four[1]
    block[at + np.uint64(2)], block[at + np.uint64(3)] = four[2], four[3]


@inner
def _locate(move, box, level, block, count):
    """Fill the rows of a block with the places of moved points."""
    first = box.first
    last = box.last
    most = box.most
    inverse = box.inverse
    for n in range(count):
        x, y, z = block[_POINT + n], block[_POINT + _MOST + n], block[_POINT + 2 * _MOST + n]
        a = move[0] * x + move[1] * y + move[2] * z + move[9]
        b = move[3] * x + move[4] * y + move[5] * z + move[10]
        c = move[6] * x + move[7] * y + move[8] * z + move[11]
        d = min(max(first[0], a), last[0])  # in this order, NaN ends up in the box
        e = min(max(first[1], b), last[1])
        f = min(max(first[2], c), last[2])
        beyond = (a - d) * (a - d) + (b - e) * (b - e) + (c - f) * (c - f)
        block[_LEVEL + n] = level if beyond == 0.0 else -np.inf
        a, b, c = (d - first[0]) * inverse, (e - first[1]) * inverse, (f - first[2]) * inverse
        d = node_of(a, box.between, most[0])
        e = node_of(b, box.between, most[1])
        f = node_of(c, box.between, most[2])
        block[_PLACE + n], block[_PLACE + _MOST + n] = a - d, b - e
        block[_PLACE + 2 * _MOST + n] = c - f
        block[_CELL + n] = d * box.across + e * box.along + f


@leaf
def weigh_corners(rows, length, place, weight, count):
    """Fill the weights of cell corners at fractions u, v, w, as distance_between_nodes has them.

    rows: each of so many numbers; those of fractions begin at `place`, of weights at `weight`.
    """
    for n in range(count):
        u, v, w = rows[place + n], rows[place + length + n], rows[place + 2 * length + n]
        a, b, c = 1.0 - u, 1.0 - v, 1.0 - w
        ab, av, ub, uv = a * b, a * v, u * b, u * v
        rows[weight + n], rows[weight + length + n] = ab * c, ab * w
        rows[weight + 2 * length + n], rows[weight + 3 * length + n] = av * c, av * w
        rows[weight + 4 * length + n], rows[weight + 5 * length + n] = ub * c, ub * w
        rows[weight + 6 * length + n], rows[weight + 7 * length + n] = uv * c, uv * w


@leaf
def between_nodes(field, cell, rows, length, weight):
    """Return distance and gradient in a cell, by eight weights in rows of a length, from `weight`.

    Weights that a loop has filled before are vector code; those of distance_between_nodes are not.
    """
    table, box = field.table, field.box
    across, along = np.uint64(np.int64(box.across)), np.uint64(np.int64(box.along))
    at, row = np.uint64(weight), np.uint64(2 * length)
    read = _with_edge(table, cell, rows, length, at, (0.0, 0.0, 0.0, 0.0))
    read = _with_edge(table, cell + along, rows, length, at + row, read)
    read = _with_edge(table, cell + across, rows, length, at + np.uint64(2) * row, read)
    return _with_edge(table, cell + across + along, rows, length, at + np.uint64(3) * row, read)


@leaf
def _with_edge(table, node, rows, length, at, read):
    """Return sums so far plus a node and the next on the third axis, with their weights."""
    s, nx, ny, nz = read
    weight = rows[at]
    a, b, c, d = at_node(table, node)
    s, nx, ny, nz = s + weight * a, nx + weight * b, ny + weight * c, nz + weight * d
    weight = rows[at + np.uint64(length)]
    a, b, c, d = at_node(table, node + np.uint64(1))
    return s + weight * a, nx + weight * b, ny + weight * c, nz + weight * d


@inner
def _violate_between_nodes(model, block, count):
    """Fill the cost of each point where distances are interpolated, see _put_violation."""
    for n in range(np.uint64(count)):
        cell = np.uint64(np.int64(block[np.uint64(_CELL) + n]))
        read = between_nodes(model.field, cell, block, _MOST, np.uint64(_WEIGHT) + n)
        _put_violation(model, block, n, cell, read)


@inner
def _violate_at_nodes(model, block, count):
    """Fill the cost of each point where the nearest node is read, see _put_violation."""
    for n in range(np.uint64(count)):
        cell = np.uint64(np.int64(block[np.uint64(_CELL) + n]))
        _put_violation(model, block, n, cell, at_node(model.field.table, cell))


@leaf
def _put_violation(model, block, n, cell, read):
    """Fill lambda max(0, alpha - s), with gradient -lambda max(0, alpha - s) n (Eq. 8); else 0."""
    scale, exact = model.free_scale, model.exact_gradient
    s, nx, ny, nz = read
    violation = max(block[np.uint64(_LEVEL) + n] - s, 0.0)
    violation = violation if model.free.cells.steps[cell] == 0 else 0.0
    size = -scale * slope(exact, violation)
    _put(block, _SUMMAND, n, (size * s, size * nx, size * ny, size * nz))
    block[np.uint64(_VALUE) + n] = scale * violation


@inner
def _read_weights(free, numbers, first, block, count):
    """Fill the weight, and it times the inward normal, of each point in a free voxel; else 0."""
    steps = free.cells.steps
    for n in range(count):
        read = (0.0, 0.0, 0.0, 0.0)
        if steps[np.uint64(np.int64(block[_CELL + n]))] == 0 and block[_LEVEL + n] > -np.inf:
            read = _four(free.weights, 0, numbers[first + n])
        _put(block, _SUMMAND, n, read)


@inner
def _subtract_points(pose, block, count):
    """Replace points m by t - m."""
    for n in range(count):
        block[_POINT + n] = pose[9] - block[_POINT + n]
        block[_POINT + _MOST + n] = pose[10] - block[_POINT + _MOST + n]
        block[_POINT + 2 * _MOST + n] = pose[11] - block[_POINT + 2 * _MOST + n]


@inner
def _add_weights(pose, block, count):
    """Add weights w at y = R^T (m - t), with gradient w R^T n by y: inwards, out of free voxels."""
    _, a, b, c = _four(block, _SUMS, 0)
    _, d, e, f = _four(block, _SUMS, 1)
    _, g, h, i = _four(block, _SUMS, 2)
    o, p, q, r = _four(block, _SUMS, 3)
    s = t = u = 0.0  # of a fourth column, so that vectors have four lanes
    for n in range(np.uint64(count)):
        x, y = block[np.uint64(_POINT) + n], block[np.uint64(_POINT + _MOST) + n]
        z = block[np.uint64(_POINT + 2 * _MOST) + n]
        w, j, k, m = _four(block, _SUMMAND, n)
        o, p, q, r = o + w, p + j, q + k, r + m
        v, j, k, m = (
            0.0 * j + 0.0 * k + 0.0 * m,
            pose[0] * j + pose[3] * k + pose[6] * m,
            pose[1] * j + pose[4] * k + pose[7] * m,
            pose[2] * j + pose[5] * k + pose[8] * m,
        )
        s, a, b, c = s + x * v, a + x * j, b + x * k, c + x * m
        t, d, e, f = t + y * v, d + y * j, e + y * k, f + y * m
        u, g, h, i = u + z * v, g + z * j, h + z * k, i + z * m
    _put(block, _SUMS, 0, (s, a, b, c))
    _put(block, _SUMS, 1, (t, d, e, f))
    _put(block, _SUMS, 2, (u, g, h, i))
    _put(block, _SUMS, 3, (o, p, q, r))


@inner
def _add_violations(block, count):
    """Add the violation of each point, one after the other, to the sums."""
    a, b, c, d = _four(block, _SUMS, 0)
    e, f, g, h = _four(block, _SUMS, 1)
    i, j, k, m = _four(block, _SUMS, 2)
    o, p, q, r = _four(block, _SUMS, 3)
    cost = block[np.uint64(_SUMS + 16)]
    for n in range(np.uint64(count)):
        x, y = block[np.uint64(_POINT) + n], block[np.uint64(_POINT + _MOST) + n]
        z = block[np.uint64(_POINT + 2 * _MOST) + n]
        s, t, u, v = _four(block, _SUMMAND, n)
        a, b, c, d = a + s * x, b + t * x, c + u * x, d + v * x
        e, f, g, h = e + s * y, f + t * y, g + u * y, h + v * y
        i, j, k, m = i + s * z, j + t * z, k + u * z, m + v * z
        o, p, q, r = o + s, p + t, q + u, r + v
        cost += block[np.uint64(_VALUE) + n]
    _put(block, _SUMS, 0, (a, b, c, d))
    _put(block, _SUMS, 1, (e, f, g, h))
    _put(block, _SUMS, 2, (i, j, k, m))
    _put(block, _SUMS, 3, (o, p, q, r))
    block[np.uint64(_SUMS + 16)] = cost


@leaf
def _four(block, first, n):
    """Return the four numbers of the n-th point."""
    at = np.uint64(first) + np.uint64(4) * np.uint64(n)
    return (
        block[at],
        block[at + np.uint64(1)],
        block[at + np.uint64(2)],
        block[at + np.uint64(3)],
    )
