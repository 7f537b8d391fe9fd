"""What points of the free term cost at a pose (CHSEL, Eq. 8), one after the other, in vectors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.cost.pose_lanes import slope
from chsel.numerics.cell_set import node_of
from chsel.numerics.compiler import inner, leaf
from chsel.numerics.pose_tuples import Pose, turned_back
from chsel.problem.sdf_lookup import distance_between_nodes

# A block holds the numbers of 64 points, a row for each quantity or four numbers for each point.
_MOST = 64
_BEYOND = 0  # row: squared distance to the box
_PLACE = 1 * _MOST  # the first of 3 rows: from the node of the cell, in cells
_CELL = 4 * _MOST  # row
_POINT = 5 * _MOST  # the first of 3 rows
_READ = 8 * _MOST  # four: signed distance and gradient, or weight and direction
_LEFT = 12 * _MOST  # four: the gradient by the rotation is an outer product of three of these,
_RIGHT = 16 * _MOST  # four: and three of these
_SUMMAND = 20 * _MOST  # four: the gradient by the translation, and the value
_SUMS = 24 * _MOST  # 3 rows of the gradient by the rotation, each with a further number; summands
SIZE = 24 * _MOST + 16


class CostAndGradient(NamedTuple):
    """The relaxed cost of a pose, and its gradient by the pose's 12 numbers."""

    cost: float
    by_pose: Pose


NOTHING = CostAndGradient(0.0, (0.0,) * 12)


@inner
def sums_over(model, pose, move, numbers, count, block):
    """The sums over the first `count` points by number, block by block."""
    free = model.free
    spheres, nodes = free.tree.spheres, len(free.tree.starts) - 1
    for i in range(16):
        block[_SUMS + i] = 0.0
    for first in range(0, count, _MOST):
        size = min(_MOST, count - first)
        for n in range(size):
            at = np.uint64(nodes + numbers[first + n])
            x, y, z = spheres[0, at], spheres[1, at], spheres[2, at]
            block[_POINT + n], block[_POINT + _MOST + n], block[_POINT + 2 * _MOST + n] = x, y, z
            if not free.interior:
                _put(block, _RIGHT, n, x, y, z, 0.0)
        whole = (size + 3) // 4 * 4  # vectors read what is left of another block, for nothing
        _locate(move, free.cells.box, block, whole)
        if free.interior:
            _read_weights(free, numbers, first, block, size)
            _weigh(pose, block, whole)
            _add(block, _LEFT, size)
        else:
            _read_distances(model, block, size)
            _violate(model, block, whole)
            _add(block, _SUMMAND, size)
    return _sums_in(block)


@inner
def sums_over_all(free, pose, block):
    """The sums over all interior points, which are all in free voxels."""
    weights, spheres, nodes = free.weights, free.tree.spheres, len(free.tree.starts) - 1
    for i in range(16):
        block[_SUMS + i] = 0.0
    for first in range(0, len(weights), _MOST):
        size = min(_MOST, len(weights) - first)
        for n in range(size):
            at, point = np.uint64(first + n), np.uint64(nodes + first + n)
            block[_POINT + n], block[_POINT + _MOST + n] = spheres[0, point], spheres[1, point]
            block[_POINT + 2 * _MOST + n] = spheres[2, point]
            w, nx, ny, nz = weights[at, 0], weights[at, 1], weights[at, 2], weights[at, 3]
            _put(block, _READ, n, w, nx, ny, nz)
        _weigh(pose, block, (size + 3) // 4 * 4)
        _add(block, _LEFT, size)
    return _sums_in(block)


@leaf
def _sums_in(block):
    a, b, c, _ = _four(block, _SUMS, 0)
    d, e, f, _ = _four(block, _SUMS, 1)
    g, h, i, _ = _four(block, _SUMS, 2)
    x, y, z, cost = _four(block, _SUMS, 3)
    return CostAndGradient(cost, (a, b, c, d, e, f, g, h, i, x, y, z))


@leaf
def _put(block, first, n, a, b, c, d):
    """Set four numbers of the n-th point."""
    at = np.uint64(first) + np.uint64(4) * np.uint64(n)
    block[at], block[at + np.uint64(1)] = a, b
    block[at + np.uint64(2)], block[at + np.uint64(3)] = c, d


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
    return cells.steps[np.uint64(np.int64(block[_CELL + n]))] == 0 and block[_BEYOND + n] == 0.0


@inner
def _read_distances(model, block, count):
    """Signed distance and gradient at each point; alpha, which costs nothing, elsewhere."""
    field, cells, table = model.field, model.free.cells, model.field.table
    for n in range(count):
        s, nx, ny, nz = model.alpha, 0.0, 0.0, 0.0
        if _holds(cells, block, n):
            cell = np.uint64(np.int64(block[_CELL + n]))
            if field.trilinear:
                u, v = block[_PLACE + n], block[_PLACE + _MOST + n]
                w = block[_PLACE + 2 * _MOST + n]
                s, nx, ny, nz = distance_between_nodes(field.box, table, cell, u, v, w)
            else:
                s, nx, ny, nz = table[cell, 0], table[cell, 1], table[cell, 2], table[cell, 3]
        _put(block, _READ, n, s, nx, ny, nz)


@inner
def _read_weights(free, numbers, first, block, count):
    """Weight, and it times the normal, of each point in a free voxel; else 0."""
    weights = free.weights
    for n in range(count):
        w = nx = ny = nz = 0.0
        if _holds(free.cells, block, n):
            at = np.uint64(numbers[first + n])
            w, nx, ny, nz = weights[at, 0], weights[at, 1], weights[at, 2], weights[at, 3]
        _put(block, _READ, n, w, nx, ny, nz)


@inner
def _violate(model, block, count):
    """lambda sum max(0, alpha - s), with gradient -lambda max(0, alpha - s) n (Eq. 8)."""
    alpha, scale, exact = model.alpha, model.free_scale, model.exact_gradient
    for n in range(count):
        at = _READ + 4 * n
        violation = max(alpha - block[at], 0.0)
        size = -scale * slope(exact, violation)
        gx, gy, gz = size * block[at + 1], size * block[at + 2], size * block[at + 3]
        _put(block, _SUMMAND, n, gx, gy, gz, scale * violation)


@inner
def _weigh(pose, block, count):
    """A weight w at y = R^T (m - t), with gradient w R^T n by y: inwards, out of the free voxel."""
    for n in range(count):
        at = _READ + 4 * n
        gx, gy, gz = block[at + 1], block[at + 2], block[at + 3]
        a, b, c = turned_back(pose, gx, gy, gz)
        x, y, z = block[_POINT + n], block[_POINT + _MOST + n], block[_POINT + 2 * _MOST + n]
        _put(block, _LEFT, n, x - pose[9], y - pose[10], z - pose[11], 0.0)
        _put(block, _RIGHT, n, a, b, c, 0.0)
        _put(block, _SUMMAND, n, -gx, -gy, -gz, block[at])


@inner
def _add(block, left, count):
    """Add the products and summands of each point, one after the other, to the sums."""
    a, b, c, u = _four(block, _SUMS, 0)
    d, e, f, v = _four(block, _SUMS, 1)
    g, h, i, w = _four(block, _SUMS, 2)
    x, y, z, cost = _four(block, _SUMS, 3)
    for n in range(np.uint64(count)):
        p, q, r, _ = _four(block, left, n)
        j, k, m, o = _four(block, _RIGHT, n)
        a, b, c, u = a + p * j, b + p * k, c + p * m, u + p * o
        d, e, f, v = d + q * j, e + q * k, f + q * m, v + q * o
        g, h, i, w = g + r * j, h + r * k, i + r * m, w + r * o
        p, q, r, value = _four(block, _SUMMAND, n)
        x, y, z, cost = x + p, y + q, z + r, cost + value
    _put(block, _SUMS, 0, a, b, c, u)
    _put(block, _SUMS, 1, d, e, f, v)
    _put(block, _SUMS, 2, g, h, i, w)
    _put(block, _SUMS, 3, x, y, z, cost)


@leaf
def _four(block, first, n):
    """The four numbers of the n-th point."""
    at = np.uint64(first) + np.uint64(4) * np.uint64(n)
    return (
        block[at],
        block[at + np.uint64(1)],
        block[at + np.uint64(2)],
        block[at + np.uint64(3)],
    )
