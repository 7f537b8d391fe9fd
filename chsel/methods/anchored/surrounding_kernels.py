"""The free points that can cost something at a pose, gathered once for poses close to each other.

They are left out in 32-bit arithmetic, which leaves out none that matters: those that remain are
looked up in 64 bits, in the order of the tree, so that a sum over them is that over all points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.cost.cost_kernels import Model
from chsel.cost.free_kernels import is_apart, remember, travel
from chsel.methods.anchored.fine_cells import FineCells
from chsel.numerics.arrays import FloatArray, scratch
from chsel.numerics.compiler import inner, leaf, spliced
from chsel.numerics.near_points import NearPoints, gather_points, near_points_for, to_cells
from chsel.numerics.pose_tuples import moved, rigid

_HALF = np.float32(0.5)
_ALL = -1  # instead of the number of points that were gathered


class Surrounding(NamedTuple):
    """The free points that can matter while a pose moves little: scratch of one thread."""

    points: NearPoints  # one list
    memory: FloatArray  # (12,), where the object was when they were gathered, see remember
    fine: FineCells  # parts of the grid's cells, see fine_cells_below


def surrounding_for(model: Model, fine: FineCells) -> Surrounding:
    """Scratch for one thread. fine: where free points cost something."""
    return Surrounding(near_points_for(model.free.rough, 1), scratch(12), fine)


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
        gather_points(free.rough, free.cells, to_cell, reach, points)


@leaf
def look_around(model, pose, near):
    """Fill hits with those gathered that may cost something at a pose; returns how many."""
    free, points, fine = model.free, near.points, near.fine
    if points.number[0] == 0:
        return 0
    to_cell, rounding = to_cells(free.rough, fine.box, pose)
    if points.number[0] != _ALL and rounding >= 0.0:
        _locate(to_cell, fine, rounding + free.margin, points)
        return _select(fine.bits, points)
    count = len(free.tree.order)
    for at in range(count):
        points.hits[at] = at
    return count


@leaf
def _locate(move, fine, rounding, points):
    """Fill the cells of the points gathered, or that of the last bit where rounding may matter."""
    box = fine.box
    across, along = np.int32(box.across), np.int32(box.along)
    most, edge = box.most, np.float32(0.5 - rounding * box.inverse)
    p, q, r = np.float32(most[0] + 0.5), np.float32(most[1] + 0.5), np.float32(most[2] + 0.5)
    unsure, cells = np.int32(fine.unsure), points.cells
    xs, ys, zs = points.rows[0], points.rows[1], points.rows[2]
    for n in range(points.number[0]):
        x, y, z = xs[n], ys[n], zs[n]
        a = move[0] * x + move[1] * y + move[2] * z + move[9]
        b = move[3] * x + move[4] * y + move[5] * z + move[10]
        c = move[6] * x + move[7] * y + move[8] * z + move[11]
        a, b, c = min(max(_HALF, a), p), min(max(_HALF, b), q), min(max(_HALF, c), r)
        i, j, k = np.int32(a), np.int32(b), np.int32(c)
        off = max(abs(a - np.float32(i) - _HALF), abs(b - np.float32(j) - _HALF))
        off = max(off, abs(c - np.float32(k) - _HALF))
        cell = np.int32(np.int32(np.int32(i * across) + np.int32(j * along)) + k)
        cells[n] = unsure if off > edge else cell


@leaf
def _select(bits, points):
    """Fill hits with the points gathered whose bits are set; returns how many."""
    cells, kept, hits = points.cells, points.nodes, points.hits
    total = np.uint64(0)
    for n in range(points.number[0]):
        cell = np.uint32(cells[n])
        word = bits[np.uint64(cell >> np.uint32(5))] >> (cell & np.uint32(31))
        hits[total] = kept[n]
        total += np.uint64(word & np.uint32(1))
    return np.int64(total)


@leaf
def hit(model, near, n):
    """The n-th of the hits: a point of the world."""
    free = model.free
    at, spheres = np.uint64(len(free.tree.starts) - 1 + near.points.hits[n]), free.tree.spheres
    return spheres[0, at], spheres[1, at], spheres[2, at]


@leaf
def place_of(model, pose, point):
    """Where a point of the world lies in the grid: the lowest node of its cell, or -1.

    With the fractions u, v, w of the cell's sides. -1: where free points cost nothing.
    """
    box = model.field.box
    first, last, most, inverse = box.first, box.last, box.most, box.inverse
    x, y, z = moved(pose, point[0], point[1], point[2])
    a, b, c = (
        min(max(first[0], x), last[0]),
        min(max(first[1], y), last[1]),
        min(max(first[2], z), last[2]),
    )
    u, v, w = (a - first[0]) * inverse, (b - first[1]) * inverse, (c - first[2]) * inverse
    i, j, k = min(np.floor(u), most[0]), min(np.floor(v), most[1]), min(np.floor(w), most[2])
    cell = int(i * box.across + j * box.along + k)
    if a != x or b != y or c != z or model.free.region.clearance[np.uint64(cell)] >= 0.0:
        cell = -1
    return cell, u - i, v - j, w - k


@spliced
def travel_since_gathering(model, pose, near):
    """How far in the world any point of the object moved at most, metres."""
    return travel(model.free, pose, near.memory)
