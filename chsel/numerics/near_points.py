"""The points of a tree that may lie in a set of cells, found in 32-bit arithmetic.

Distances are rounded so that no point is left out: whether a point lies in the set, and what it
adds to a sum, is then decided in 64 bits for the few that are left. Eight nodes or points, the
lanes of a vector instruction, are tested at a time.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.arrays import IntArray, scratch
from chsel.numerics.compiler import inner, leaf
from chsel.numerics.rough_tree import LANES, RoughTree

_HALF, _ONE = np.float32(0.5), np.float32(1.0)
_ROW = np.uint64(LANES)
_U1, _U2, _U3, _U4, _U5, _U6, _U7 = (np.uint64(n) for n in range(1, 8))
_UNIT = 2.0**-20  # 16 roundings of 32-bit numbers: more than are on the way to any coordinate
_COARSEST = 0.25  # cells: if rounding moves a point further, 32 bits are not enough
_MOST_LIMIT = 1e6  # of squared distances, in cells
LONGEST = 16_000  # points, of lists that are kept


class NearPoints(NamedTuple):
    """Scratch for P lists of the packets of points that are near a set of cells."""

    x: Any  # (P C + S,) of spheres around packets, as in RoughTree.blocks; float32
    y: Any
    z: Any
    radius: Any
    kept: Any  # (P C + S,) which packets they are, ascending, int32
    own: int  # C, the places of each list
    begin: IntArray  # (P,) where each list begins: in its C places, or in the S for a longer one
    number: IntArray  # (P,) how many packets each has
    rows: Any  # (4, S') nodes, or points, that are looked at: x, y, z, radius; float32
    nodes: Any  # (S',) nodes or packets, int32
    cells: Any  # (S',) where they lie, int32
    limits: Any  # (S',) which of CellSet.steps is near enough, int32
    hits: Any  # (S',) points of a list that may lie in the set, int32


def near_points_for(tree: RoughTree, lists: int) -> NearPoints:
    """Scratch for so many lists of the points of a tree.

    Each has little room, as it takes longer to get much memory than to use a little of it.
    """
    packets = len(tree.places)
    own = min(packets, LONGEST // LANES)
    room = lists * own + packets + LANES  # vectors reach beyond the last list
    x, y, z, radius = (np.empty(room, dtype=np.float32) for _ in range(4))
    kept = np.empty(room, dtype=np.int32)
    begin, number = (scratch(lists, dtype=np.int64) for _ in range(2))
    most = LANES * (max(packets, len(tree.first), len(tree.starts)) + 1)
    rows = np.empty((4, most), dtype=np.float32)
    nodes, cells, limits, hits = (np.empty(most, dtype=np.int32) for _ in range(4))
    return NearPoints(x, y, z, radius, kept, own, begin, number, rows, nodes, cells, limits, hits)


@leaf
def is_kept(near, n):
    """Whether the n-th list stays while others are filled: a long one lies where others may."""
    return near.begin[n] < len(near.number) * near.own


@leaf
def to_cells(tree, box, move):
    """The map from a tree's 32-bit coordinates to those of a grid, in cells that begin at 0.

    Also by how many metres rounding may move a point on the way; negative if by too many.
    """
    x, y, z = tree.origin
    a = move[0] * x + move[1] * y + move[2] * z + (move[9] - box.first[0])
    b = move[3] * x + move[4] * y + move[5] * z + (move[10] - box.first[1])
    c = move[6] * x + move[7] * y + move[8] * z + (move[11] - box.first[2])
    scale, shift = box.inverse, 0.5 - 0.5 * box.between
    rounding = (tree.reach + max(abs(a), max(abs(b), abs(c))) + 1.0 / scale) * _UNIT
    if not rounding * scale <= _COARSEST:
        rounding = -1.0
        a = b = c = 0.0
    f = np.float32
    rotation = (
        f(move[0] * scale), f(move[1] * scale), f(move[2] * scale),
        f(move[3] * scale), f(move[4] * scale), f(move[5] * scale),
        f(move[6] * scale), f(move[7] * scale), f(move[8] * scale),
    )  # fmt: skip
    return (*rotation, f(a * scale + shift), f(b * scale + shift), f(c * scale + shift)), rounding


@inner
def gather(tree, cells, to_cell, slack, near, n):
    """Fill the n-th list with the packets that have points within `slack` metres of the set.

    to_cell: as to_cells makes it; slack includes its rounding. See is_kept.
    """
    x, y, z, radius = near.rows[0], near.rows[1], near.rows[2], near.rows[3]
    nodes, count, none = near.nodes, 1, np.uint64(0)
    nodes[0] = 0
    for _ in range(tree.depth):
        count = _expand(tree, nodes, count, near)
        _locate_spheres(x, y, z, radius, none, count, to_cell, cells.box, slack, near)
        count = _keep(nodes, none, count, cells.steps, near)
    begin = n * near.own if count <= near.own else len(near.number) * near.own
    for at in range(np.uint64(count)):
        packet, to = nodes[at], np.uint64(begin) + at
        place = np.uint64(tree.places[np.uint64(packet)])
        near.kept[to] = packet
        near.x[to], near.y[to] = tree.blocks[place], tree.blocks[place + _ROW]
        near.z[to] = tree.blocks[place + np.uint64(2) * _ROW]
        near.radius[to] = tree.blocks[place + np.uint64(3) * _ROW]
    near.begin[n], near.number[n] = begin, count


@inner
def is_within(tree, cells, depths, to_cell, slack):
    """Whether all points of a tree stay in cells of a set while they move by `slack` metres.

    depths: squared gaps (nodes,) from cells of the set to others, among which is every cell at a
    border of the box; see gather.
    """
    box, blocks = cells.box, tree.blocks
    scale, slack = np.float32(box.inverse * (1.0 + 1e-6)), np.float32(slack)
    across, along = np.int32(box.across), np.int32(box.along)
    p, q, r = _last_centres(box)
    for child in range(LANES * tree.starts[1]):
        at = np.uint64(child // LANES * 4 * LANES + child % LANES)
        x, y, z = blocks[at], blocks[at + _ROW], blocks[at + np.uint64(2) * _ROW]
        radius = blocks[at + np.uint64(3) * _ROW]
        a = to_cell[0] * x + to_cell[1] * y + to_cell[2] * z + to_cell[9]
        b = to_cell[3] * x + to_cell[4] * y + to_cell[5] * z + to_cell[10]
        c = to_cell[6] * x + to_cell[7] * y + to_cell[8] * z + to_cell[11]
        i = np.int32(min(max(_HALF, a), p))
        j = np.int32(min(max(_HALF, b), q))
        k = np.int32(min(max(_HALF, c), r))
        reach = (radius + slack) * scale
        cell = np.uint64(np.int32(np.int32(i * across) + np.int32(j * along)) + k)
        if np.float32(depths[cell]) <= reach * reach:  # never where the radius is NaN
            return False
    return True


@inner
def gather_points(tree, cells, to_cell, slack, near):
    """Fill rows and nodes with the points themselves, number[0] with how many; see gather."""
    gather(tree, cells, to_cell, slack, near, 0)
    x, y, z, radius = near.rows[0], near.rows[1], near.rows[2], near.rows[3]
    nodes, begin, packets = near.nodes, np.uint64(near.begin[0]), near.number[0]
    for at in range(np.uint64(packets)):
        packet = np.uint64(near.kept[begin + at])
        _copy_points(tree, packet, at, x, y, z)
        for lane in range(_ROW):
            nodes[at * _ROW + lane] = tree.begins[packet] + np.int32(lane)
    for n in range(np.uint64(packets) * _ROW):
        radius[n] = x[n] - x[n]  # 0, or NaN where there is no point
    count, none, total = LANES * packets, np.uint64(0), np.uint64(0)
    _locate_spheres(x, y, z, radius, none, count, to_cell, cells.box, slack, near)
    for n in range(np.uint64(count)):
        x[total], y[total], z[total], nodes[total] = x[n], y[n], z[n], nodes[n]
        total += np.uint64(np.int32(cells.steps[np.uint64(near.cells[n])]) <= near.limits[n])
    near.number[0] = np.int64(total)


@leaf
def _copy_points(tree, packet, at, x, y, z):
    """Copy the points of a packet to the at-th place for packets."""
    place, to = packet * np.uint64(3) * _ROW, at * _ROW
    _copy(tree.points, place, x, to)
    _copy(tree.points, place + _ROW, y, to)
    _copy(tree.points, place + np.uint64(2) * _ROW, z, to)


@leaf
def _expand(tree, nodes, count, near):
    """Replace nodes by their children, block by block; returns how many lanes these have."""
    starts, first, parents, one = tree.starts, tree.first, near.cells, np.uint64(1)
    for n in range(np.uint64(count)):
        parents[n] = nodes[n]
    total = np.uint64(0)
    for n in range(np.uint64(count)):
        node = np.uint64(parents[n])
        for block in range(np.uint64(starts[node]), np.uint64(starts[node + one])):
            for row in range(4):
                step = np.uint64(row)
                _copy(tree.blocks, (np.uint64(4) * block + step) * _ROW, near.rows[row], total)
            for lane in range(_ROW):
                nodes[total + lane] = first[block] + np.int32(lane)
            total += _ROW
    return np.int64(total)


@leaf
def _copy(source, at, out, to):
    """Copy as many numbers as a block has lanes."""
    a, b, c, d = source[at], source[at + _U1], source[at + _U2], source[at + _U3]
    e, f, g, h = source[at + _U4], source[at + _U5], source[at + _U6], source[at + _U7]
    out[to], out[to + _U1], out[to + _U2], out[to + _U3] = a, b, c, d
    out[to + _U4], out[to + _U5], out[to + _U6], out[to + _U7] = e, f, g, h


@leaf
def _keep(nodes, begin, count, steps, near):
    """Keep those of some nodes that are near enough, in their order; returns how many."""
    where, limits, kept, total = near.cells, near.limits, near.nodes, np.uint64(0)
    for n in range(np.uint64(count)):
        kept[total] = nodes[begin + n]
        total += np.uint64(np.int32(steps[np.uint64(where[n])]) <= limits[n])
    return np.int64(total)


@inner
def _locate_spheres(xs, ys, zs, radii, begin, count, move, box, slack, near):
    """Fill the cells of spheres, and which of CellSet.steps is near enough to each; vectorised.

    Where the radius is NaN, nothing is.
    """
    where, limits = near.cells, near.limits
    shift = np.float32(0.5 - 0.5 * box.between)
    scale, slack = np.float32(box.inverse * (1.0 + 1e-6)), np.float32(slack)
    across, along = np.int32(box.across), np.int32(box.along)
    p, q, r = _last_centres(box)
    last = (
        np.float32((box.last[0] - box.first[0]) * box.inverse) + shift,
        np.float32((box.last[1] - box.first[1]) * box.inverse) + shift,
        np.float32((box.last[2] - box.first[2]) * box.inverse) + shift,
    )
    whole = (np.uint64(count) + np.uint64(LANES - 1)) // _ROW * _ROW  # the rest is scratch
    for n in range(whole):
        x, y, z = xs[begin + n], ys[begin + n], zs[begin + n]
        reach = (radii[begin + n] + slack) * scale
        a = move[0] * x + move[1] * y + move[2] * z + move[9]
        b = move[3] * x + move[4] * y + move[5] * z + move[10]
        c = move[6] * x + move[7] * y + move[8] * z + move[11]
        d = a - min(max(shift, a), last[0])
        e = b - min(max(shift, b), last[1])
        f = c - min(max(shift, c), last[2])
        # The set lies within its box, which is convex: at least this far, by Pythagoras.
        limit = reach * reach - (d * d + e * e + f * f) + _ONE
        limits[n] = np.int32(min(max(np.float32(-1.0), limit), np.float32(_MOST_LIMIT)))
        i = np.int32(min(max(_HALF, a), p))
        j = np.int32(min(max(_HALF, b), q))
        k = np.int32(min(max(_HALF, c), r))
        where[n] = np.int32(np.int32(np.int32(i * across) + np.int32(j * along)) + k)


@leaf
def _last_centres(box):
    """The centre of the last cell, in cells."""
    p, q, r = box.most
    return np.float32(p + 0.5), np.float32(q + 0.5), np.float32(r + 0.5)


@inner
def select(tree, cells, to_cell, rounding, near, n):
    """Fill hits with the points of the n-th list that may lie in the set; returns how many.

    rounding: by how many metres it may move a point.
    """
    steps, where, nodes, hits, begins = cells.steps, near.cells, near.nodes, near.hits, tree.begins
    begin, count = np.uint64(near.begin[n]), near.number[n]
    _locate_spheres(
        near.x, near.y, near.z, near.radius, begin, count, to_cell, cells.box, rounding, near
    )
    packets = _keep(near.kept, begin, count, steps, near)
    x, y, z = near.rows[0], near.rows[1], near.rows[2]
    for at in range(np.uint64(packets)):
        _copy_points(tree, np.uint64(nodes[at]), at, x, y, z)
    _locate_points(x, y, z, packets, to_cell, cells, rounding, where)
    total = np.uint64(0)
    for at in range(np.uint64(packets)):
        point = begins[np.uint64(nodes[at])]
        for lane in range(_ROW):
            hits[total] = point + np.int32(lane)
            total += np.uint64(steps[np.uint64(where[at * _ROW + lane])] == 0)
    return np.int64(total)


@inner
def _locate_points(x, y, z, packets, move, cells, rounding, where):
    """Fill the cells of the points of packets; vectorised.

    That of a step of 0 where rounding may put a point in another, that of 255 where x is NaN.
    """
    box = cells.box
    unsure, nothing = np.int32(len(cells.steps) - 2), np.int32(len(cells.steps) - 1)
    edge = np.float32(0.5 - rounding * box.inverse)
    across, along = np.int32(box.across), np.int32(box.along)
    p, q, r = _last_centres(box)
    for n in range(np.uint64(packets) * _ROW):
        a = move[0] * x[n] + move[1] * y[n] + move[2] * z[n] + move[9]
        b = move[3] * x[n] + move[4] * y[n] + move[5] * z[n] + move[10]
        c = move[6] * x[n] + move[7] * y[n] + move[8] * z[n] + move[11]
        a, b, c = min(max(_HALF, a), p), min(max(_HALF, b), q), min(max(_HALF, c), r)
        i, j, k = np.int32(a), np.int32(b), np.int32(c)
        d, e = abs(a - np.float32(i) - _HALF), abs(b - np.float32(j) - _HALF)
        f = abs(c - np.float32(k) - _HALF)
        cell = np.int32(np.int32(np.int32(i * across) + np.int32(j * along)) + k)
        cell = unsure if max(d, max(e, f)) > edge else cell
        where[n] = cell if x[n] == x[n] else nothing
