"""The free term of the relaxed cost at one pose (CHSEL, Eq. 8), over the points that matter."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.cost.pose_lanes import slope
from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import CellSet, Region, node_of
from chsel.numerics.compiler import inner, leaf, spliced
from chsel.numerics.near_points import (
    NearPoints,
    RoughTree,
    gather,
    is_kept,
    is_within,
    near_points_for,
    select,
    to_cells,
)
from chsel.numerics.octree import Tree
from chsel.numerics.pose_tuples import Pose, Triple, inverted, rigid, turned_back
from chsel.problem.sdf_lookup import distance_between_nodes

MOST_SLACK = 0.03  # metres, in a descent
SEARCH_SLACK = 0.02  # metres, among the branches of a search, which scatter
STEPS_AHEAD = 3.0  # that gathered neighbours should last
_ALL = -1  # instead of the number of points that were gathered


class FreeTerm(NamedTuple):
    """The points that the free term looks up, and the cells where they cost something.

    "The object" is, for free points, the region; for interior points, all of them.
    """

    interior: bool  # interior points of the object in free voxels, else free points in the object
    exhaustive: bool  # look up all points
    tree: Tree  # over free points of the world, or over interior points in the object frame
    rough: RoughTree  # the same
    region: Region  # cells of the object that read values below alpha; empty for interior points
    cells: CellSet  # the same cells, or the free voxels of the world
    depths: Any  # (nodes,) squared gaps from free voxels to others; empty for free points; uint8
    weights: FloatArray  # (N, 4) weight of interior points, and it times the normal
    centre: Triple  # of a sphere around the object, in its frame
    radius: float
    lower: Triple  # corners of a box of the world: where the object is beyond, nothing costs
    upper: Triple
    margin: float  # more metres than rounding moves a point


class CostAndGradient(NamedTuple):
    """The relaxed cost of a pose, and its gradient by the pose's 12 numbers."""

    cost: float
    by_pose: Pose


NOTHING = CostAndGradient(0.0, (0.0,) * 12)


class Neighbours(NamedTuple):
    """The points that can matter while poses move little (after Verlet, 1967); see remember."""

    points: NearPoints
    slack: FloatArray  # (P,) metres that the object may move until they are gathered anew, or -1
    gathered: FloatArray  # (P, 12) where the object was when they were gathered
    last: FloatArray  # (P, 12) where it was at the last evaluation
    block: FloatArray  # (SIZE,) numbers of the points that are looked up


# A block holds the numbers of 64 points, a row for each quantity.
_MOST = 64
_BEYOND = 0  # squared distance to the box
_PLACE = 1 * _MOST  # the first of 3 rows: from the node of the cell, in cells
_CELL = 4 * _MOST
_POINT = 5 * _MOST  # the first of 3 rows
_READ = 8 * _MOST  # the first of 4 rows: signed distance and gradient, or weight and direction
_PRODUCTS = 12 * _MOST  # the first of 13 rows: what is added to the sums
_SIZE = 25 * _MOST


def neighbours_of(free: FreeTerm, poses: int) -> Neighbours:
    """Scratch of one thread, for so many poses."""
    return Neighbours(
        near_points_for(free.rough, poses),
        np.full(poses, -1.0),
        np.zeros((poses, 12)),
        np.zeros((poses, 12)),
        np.zeros(_SIZE),
    )


@inner
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
    to_cell, rounding = to_cells(free.rough, free.cells.box, move)
    if free.exhaustive or rounding < 0.0 or not rigid(pose):
        near.slack[n] = -1.0
        for at in range(total):
            points.hits[at] = at
        return _sums(model, pose, move, points.hits, total, near.block)
    rounding += free.margin
    slack = _slack_to_gather(free, pose, near, n, most_slack)
    if slack >= 0.0:
        reach = slack + rounding
        if is_apart(free, pose, slack + free.margin):
            points.number[n] = 0
        elif free.interior and is_within(free.rough, free.cells, free.depths, to_cell, reach):
            points.number[n] = _ALL
        else:
            gather(free.rough, free.cells, to_cell, reach, points, n)
            near.slack[n] = near.slack[n] if is_kept(points, n) else -1.0
    count = 0
    if points.number[n] == _ALL:
        return _sums_of_all(free, pose, near.block)
    if points.number[n] > 0:
        count = select(free.cells, to_cell, rounding, points, n)
    return _sums(model, pose, move, points.hits, count, near.block)


@leaf
def _slack_to_gather(free, pose, near, n, most_slack):
    """The slack to gather points with; negative if those gathered last are all that matter."""
    if most_slack == 0.0:
        near.slack[n] = -1.0
        return 0.0
    stride, slack = travel(free, pose, near.last[n]), -1.0
    if near.slack[n] < 0.0 or travel(free, pose, near.gathered[n]) > near.slack[n]:
        stride = stride if near.slack[n] >= 0.0 else np.inf
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


@inner
def _sums(model, pose, move, numbers, count, block):
    """The sums over the first `count` points by number, block by block."""
    free, sums = model.free, NOTHING
    spheres, nodes = free.tree.spheres, len(free.tree.starts) - 1
    for first in range(0, count, _MOST):
        size = min(_MOST, count - first)
        for n in range(size):
            at = np.uint64(nodes + numbers[first + n])
            block[_POINT + n], block[_POINT + _MOST + n] = spheres[0, at], spheres[1, at]
            block[_POINT + 2 * _MOST + n] = spheres[2, at]
        whole = (size + 3) // 4 * 4  # vectors read what is left of another block, for nothing
        _locate(move, free.cells.box, block, whole)
        if free.interior:
            _read_weights(free, numbers, first, block, size)
            _multiply_weights(pose, block, whole)
        else:
            _read_distances(model, block, size)
            _multiply_violations(model, block, whole)
        sums = _added(sums, block, size)
    return sums


@inner
def _sums_of_all(free, pose, block):
    """The sums over all interior points, which are all in free voxels."""
    weights, spheres, sums = free.weights, free.tree.spheres, NOTHING
    for first in range(0, len(weights), _MOST):
        size = min(_MOST, len(weights) - first)
        at = len(free.tree.starts) - 1 + first
        for n in range(size):
            block[_POINT + n], block[_POINT + _MOST + n] = spheres[0, at + n], spheres[1, at + n]
            block[_POINT + 2 * _MOST + n] = spheres[2, at + n]
        for n in range(size):
            block[_READ + n], block[_READ + _MOST + n] = (
                weights[first + n, 0],
                weights[first + n, 1],
            )
            block[_READ + 2 * _MOST + n] = weights[first + n, 2]
            block[_READ + 3 * _MOST + n] = weights[first + n, 3]
        _multiply_weights(pose, block, (size + 3) // 4 * 4)
        sums = _added(sums, block, size)
    return sums


@inner
def _locate(move, box, block, count):
    """Where the points lie, once moved."""
    first, last, most, inverse = box.first, box.last, box.most, box.inverse
    for n in range(count):
        x, y, z = block[_POINT + n], block[_POINT + _MOST + n], block[_POINT + 2 * _MOST + n]
        a = move[0] * x + move[1] * y + move[2] * z + move[9]
        b = move[3] * x + move[4] * y + move[5] * z + move[10]
        c = move[6] * x + move[7] * y + move[8] * z + move[11]
        d = min(max(first[0], a), last[0])  # in this order, NaN ends up in the box
        e = min(max(first[1], b), last[1])
        f = min(max(first[2], c), last[2])
        block[_BEYOND + n] = (a - d) * (a - d) + (b - e) * (b - e) + (c - f) * (c - f)
        a, b, c = (d - first[0]) * inverse, (e - first[1]) * inverse, (f - first[2]) * inverse
        d = node_of(a, box.between, most[0])
        e = node_of(b, box.between, most[1])
        f = node_of(c, box.between, most[2])
        block[_PLACE + n], block[_PLACE + _MOST + n] = a - d, b - e
        block[_PLACE + 2 * _MOST + n] = c - f
        block[_CELL + n] = d * box.across + e * box.along + f


@leaf
def _holds(cells, block, n):
    """Whether the n-th point lies in one of the cells."""
    cell = np.uint32(np.int64(block[_CELL + n]))
    word = cells.bits[np.uint64(cell >> np.uint32(5))] >> (cell & np.uint32(31))
    return word & np.uint32(1) != 0 and block[_BEYOND + n] == 0.0


@inner
def _read_distances(model, block, count):
    """Signed distance and gradient at each point; alpha, which costs nothing, elsewhere."""
    field, cells = model.field, model.free.cells
    for n in range(count):
        s, nx, ny, nz = model.alpha, 0.0, 0.0, 0.0
        if _holds(cells, block, n):
            cell = np.uint64(np.int64(block[_CELL + n]))
            if field.trilinear:
                u, v = block[_PLACE + n], block[_PLACE + _MOST + n]
                w = block[_PLACE + 2 * _MOST + n]
                s, nx, ny, nz = distance_between_nodes(field.box, field.table, cell, u, v, w)
            else:
                table = field.table
                s, nx, ny, nz = table[cell, 0], table[cell, 1], table[cell, 2], table[cell, 3]
        block[_READ + n], block[_READ + _MOST + n] = s, nx
        block[_READ + 2 * _MOST + n], block[_READ + 3 * _MOST + n] = ny, nz


@inner
def _read_weights(free, numbers, first, block, count):
    """Weight, and it times the normal, of each point in a free voxel; else 0."""
    weights = free.weights
    for n in range(count):
        w = nx = ny = nz = 0.0
        if _holds(free.cells, block, n):
            at = np.uint64(numbers[first + n])
            w, nx, ny, nz = weights[at, 0], weights[at, 1], weights[at, 2], weights[at, 3]
        block[_READ + n], block[_READ + _MOST + n] = w, nx
        block[_READ + 2 * _MOST + n], block[_READ + 3 * _MOST + n] = ny, nz


@inner
def _multiply_violations(model, block, count):
    """lambda sum max(0, alpha - s), with gradient -lambda max(0, alpha - s) n (Eq. 8)."""
    alpha, scale, exact = model.alpha, model.free_scale, model.exact_gradient
    for n in range(count):
        violation = max(alpha - block[_READ + n], 0.0)
        size = -scale * slope(exact, violation)
        gx, gy = size * block[_READ + _MOST + n], size * block[_READ + 2 * _MOST + n]
        gz = size * block[_READ + 3 * _MOST + n]
        x, y, z = block[_POINT + n], block[_POINT + _MOST + n], block[_POINT + 2 * _MOST + n]
        _multiply(block, n, scale * violation, gx, gy, gz, x, y, z)
        _store(block, n, gx, gy, gz)


@inner
def _multiply_weights(pose, block, count):
    """A weight w at y = R^T (m - t), with gradient w R^T n by y: inwards, out of the free voxel."""
    for n in range(count):
        gx, gy, gz = (
            block[_READ + _MOST + n],
            block[_READ + 2 * _MOST + n],
            block[_READ + 3 * _MOST + n],
        )
        a, b, c = turned_back(pose, gx, gy, gz)
        x, y, z = block[_POINT + n], block[_POINT + _MOST + n], block[_POINT + 2 * _MOST + n]
        x, y, z = x - pose[9], y - pose[10], z - pose[11]
        _multiply(block, n, block[_READ + n], x, y, z, a, b, c)
        _store(block, n, -gx, -gy, -gz)


@leaf
def _multiply(block, n, value, p, q, r, a, b, c):
    """A value, and the gradient (p, q, r) (a, b, c)^T by the rotation."""
    block[_PRODUCTS + n] = value
    block[_PRODUCTS + _MOST + n] = p * a
    block[_PRODUCTS + 2 * _MOST + n] = p * b
    block[_PRODUCTS + 3 * _MOST + n] = p * c
    block[_PRODUCTS + 4 * _MOST + n] = q * a
    block[_PRODUCTS + 5 * _MOST + n] = q * b
    block[_PRODUCTS + 6 * _MOST + n] = q * c
    block[_PRODUCTS + 7 * _MOST + n] = r * a
    block[_PRODUCTS + 8 * _MOST + n] = r * b
    block[_PRODUCTS + 9 * _MOST + n] = r * c


@leaf
def _store(block, n, x, y, z):
    """The gradient by the translation."""
    block[_PRODUCTS + 10 * _MOST + n] = x
    block[_PRODUCTS + 11 * _MOST + n] = y
    block[_PRODUCTS + 12 * _MOST + n] = z


@inner
def _added(sums, block, count):
    """Sums with the products of each point, one after the other."""
    cost, (a, b, c, d, e, f, g, h, i, x, y, z) = sums.cost, sums.by_pose
    for n in range(count):
        cost += block[_PRODUCTS + n]
        a += block[_PRODUCTS + _MOST + n]
        b += block[_PRODUCTS + 2 * _MOST + n]
        c += block[_PRODUCTS + 3 * _MOST + n]
        d += block[_PRODUCTS + 4 * _MOST + n]
        e += block[_PRODUCTS + 5 * _MOST + n]
        f += block[_PRODUCTS + 6 * _MOST + n]
        g += block[_PRODUCTS + 7 * _MOST + n]
        h += block[_PRODUCTS + 8 * _MOST + n]
        i += block[_PRODUCTS + 9 * _MOST + n]
        x += block[_PRODUCTS + 10 * _MOST + n]
        y += block[_PRODUCTS + 11 * _MOST + n]
        z += block[_PRODUCTS + 12 * _MOST + n]
    return CostAndGradient(cost, (a, b, c, d, e, f, g, h, i, x, y, z))
