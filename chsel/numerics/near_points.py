"""The points of a tree that may lie in a set of cells, found in 32-bit arithmetic.

Distances are rounded so that no point is left out: whether a point lies in the set, and what it
adds to a sum, is then decided in 64 bits for the few that are left.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.arrays import IntArray
from chsel.numerics.compiler import compiled, inner, leaf, spliced
from chsel.numerics.octree import Tree
from chsel.numerics.pose_tuples import Triple

_HALF, _ZERO = np.float32(0.5), np.float32(0.0)
_UNIT = 2.0**-20  # 16 roundings of 32-bit numbers: more than are on the way to any coordinate
_COARSEST = 0.25  # cells: if rounding moves a point further, 32 bits are not enough
_MOST_LIMIT = 1e6  # of squared distances, in cells
LONGEST = 16_000  # points, of lists that are kept


class RoughTree(NamedTuple):
    """A tree with its nodes and points as 32-bit numbers, near to zero."""

    rows: Any  # (4 (M + N),) centre - origin and radius of each, which is 0 for points; float32
    origin: Triple  # metres
    reach: float  # the greatest coordinate, metres
    starts: IntArray  # (M + 1,) as in Tree
    levels: IntArray  # (L + 1,) as in Tree


class NearPoints(NamedTuple):
    """Scratch for P lists of the points that are near a set of cells."""

    x: Any  # (P C + S,) float32, relative to the tree's origin
    y: Any
    z: Any
    kept: Any  # (P C + S,) which points they are, ascending, int32
    begin: IntArray  # (P,) where each list begins: in its C places, or in the S for a longer one
    number: IntArray  # (P,) how many each has
    rows: Any  # (4 S,) nodes that a walk looks at, as in RoughTree
    nodes: Any  # (S,) which they are, int32
    cells: Any  # (S,) where they lie, int32
    limits: Any  # (S,) how far the set may be, int32
    hits: Any  # (S,) those of a list that may lie in the set, int32


def rough_tree(tree: Tree) -> RoughTree:
    """The same tree in 32 bits."""
    nodes = len(tree.starts) - 1
    top = tree.spheres[:, : tree.levels[min(1, len(tree.levels) - 1)]]
    low, high = (top[:3].min(axis=1), top[:3].max(axis=1)) if nodes else (np.zeros(3),) * 2
    origin = 0.5 * low + 0.5 * high
    away = np.abs(top[:3] - origin[:, None]) + top[3]  # of any point, at most
    x, y, z = origin.tolist()
    rows = np.empty(4 * tree.spheres.shape[1], dtype=np.float32)
    _fill_rows(tree.spheres, x, y, z, rows)
    reach = float(away.max(initial=0.0)) * (1.0 + 1e-6)
    return RoughTree(rows, (x, y, z), reach, tree.starts, tree.levels)


@compiled
def _fill_rows(spheres, x, y, z, rows):
    """Fill rows from spheres (4, M + N)."""
    for n in range(spheres.shape[1]):
        rows[4 * n] = np.float32(spheres[0, n] - x)
        rows[4 * n + 1] = np.float32(spheres[1, n] - y)
        rows[4 * n + 2] = np.float32(spheres[2, n] - z)
        rows[4 * n + 3] = np.float32(spheres[3, n] * (1.0 + 1e-6))


def near_points_for(tree: RoughTree, lists: int) -> NearPoints:
    """Scratch for so many lists of the points of a tree.

    Each has little room, as it takes longer to get much memory than to use a little of it.
    """
    size = len(tree.rows) // 4 - len(tree.starts) + 9  # no level has more nodes than points
    room = lists * min(size, LONGEST) + size
    x, y, z = (np.empty(room, dtype=np.float32) for _ in range(3))
    kept = np.empty(room, dtype=np.int32)
    begin, number = (np.zeros(lists, dtype=np.int64) for _ in range(2))
    rows = np.empty(4 * size, dtype=np.float32)
    nodes, cells, limits, hits = (np.empty(size, dtype=np.int32) for _ in range(4))
    return NearPoints(x, y, z, kept, begin, number, rows, nodes, cells, limits, hits)


@leaf
def is_kept(near, n):
    """Whether the n-th list stays while others are filled: a long one lies where others may."""
    return near.begin[n] < len(near.x) - len(near.hits)


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
    """Fill the n-th list with the points within `slack` metres of the set, and some more.

    to_cell: as to_cells makes it; slack includes its rounding. See is_kept.
    """
    rows, nodes, limits, where = near.rows, near.nodes, near.limits, near.cells
    squares, levels, source = cells.squares, tree.levels, tree.rows
    x, y, z, kept = near.x, near.y, near.z, near.kept
    scale = np.float32(cells.box.inverse * (1.0 + 1e-6))
    slack = np.float32(slack)
    count, last = levels[1], len(levels) - 1
    for node in range(count):
        _copy(source, node, rows, node)
        nodes[node] = node
    for level in range(last + 1):
        _locate_nodes(rows, count, to_cell, cells.box, scale, slack, where, limits)
        total = 0
        if level < last:
            for at in range(count):
                nodes[total] = nodes[at]
                total += 1 if squares[np.uint64(where[at])] <= limits[at] else 0
            count = _expand(tree, total, nodes, near.hits, rows)
        else:
            first, most = levels[last], (len(x) - len(near.hits)) // len(near.number)
            begin = np.uint64(n * most if count <= most else len(near.number) * most)
            for at in range(count):
                to = begin + np.uint64(total)
                kept[to] = nodes[at] - first
                x[to], y[to], z[to] = rows[4 * at], rows[4 * at + 1], rows[4 * at + 2]
                total += 1 if squares[np.uint64(where[at])] <= limits[at] else 0
            near.begin[n], near.number[n] = begin, total


@inner
def is_within(tree, cells, depths, to_cell, slack):
    """Whether all points of a tree stay in cells of a set while they move by `slack` metres.

    depths: squared gaps (nodes,) from cells of the set to others, among which is every cell at a
    border of the box; see gather.
    """
    box, rows = cells.box, tree.rows
    scale, slack = np.float32(box.inverse * (1.0 + 1e-6)), np.float32(slack)
    across, along = np.int32(box.across), np.int32(box.along)
    p, q, r = _last_centres(box)
    for node in range(tree.levels[1]):
        x, y, z = rows[4 * node], rows[4 * node + 1], rows[4 * node + 2]
        a = to_cell[0] * x + to_cell[1] * y + to_cell[2] * z + to_cell[9]
        b = to_cell[3] * x + to_cell[4] * y + to_cell[5] * z + to_cell[10]
        c = to_cell[6] * x + to_cell[7] * y + to_cell[8] * z + to_cell[11]
        i = np.int32(min(max(_HALF, a), p))
        j = np.int32(min(max(_HALF, b), q))
        k = np.int32(min(max(_HALF, c), r))
        reach = (rows[4 * node + 3] + slack) * scale
        cell = np.uint64(np.int32(np.int32(i * across) + np.int32(j * along)) + k)
        if not np.float32(depths[cell]) > reach * reach:
            return False
    return True


@inner
def _locate_nodes(rows, count, move, box, scale, slack, where, limits):
    """Fill the cells of nodes, and the greatest square at which each is near enough; vectorised."""
    shift = np.float32(0.5 - 0.5 * box.between)
    across, along = np.int32(box.across), np.int32(box.along)
    p, q, r = _last_centres(box)
    last = (
        np.float32((box.last[0] - box.first[0]) * box.inverse) + shift,
        np.float32((box.last[1] - box.first[1]) * box.inverse) + shift,
        np.float32((box.last[2] - box.first[2]) * box.inverse) + shift,
    )
    for n in range(count):
        x, y, z = rows[4 * n], rows[4 * n + 1], rows[4 * n + 2]
        reach = (rows[4 * n + 3] + slack) * scale
        a = move[0] * x + move[1] * y + move[2] * z + move[9]
        b = move[3] * x + move[4] * y + move[5] * z + move[10]
        c = move[6] * x + move[7] * y + move[8] * z + move[11]
        d = a - min(max(shift, a), last[0])
        e = b - min(max(shift, b), last[1])
        f = c - min(max(shift, c), last[2])
        # The set lies within its box, which is convex: at least this far, by Pythagoras.
        limit = reach * reach - (d * d + e * e + f * f)
        limits[n] = np.int32(min(max(np.float32(-1.0), limit), np.float32(_MOST_LIMIT)))
        i = np.int32(min(max(_HALF, a), p))
        j = np.int32(min(max(_HALF, b), q))
        k = np.int32(min(max(_HALF, c), r))
        where[n] = np.int32(np.int32(np.int32(i * across) + np.int32(j * along)) + k)


@leaf
def _last_centres(box):
    """The centre of the last cell, in cells."""
    most = box.most
    return (
        np.float32(most[0] + 0.5),
        np.float32(most[1] + 0.5),
        np.float32(most[2] + 0.5),
    )


@leaf
def _copy(source, node, rows, n):
    """Copy the row of a node."""
    at, to = np.uint64(4 * node), np.uint64(4 * n)
    one, two, three = np.uint64(1), np.uint64(2), np.uint64(3)
    a, b, c, d = source[at], source[at + one], source[at + two], source[at + three]
    rows[to], rows[to + one], rows[to + two], rows[to + three] = a, b, c, d


@spliced
def _expand(tree, count, nodes, parents, rows):
    """Replace nodes by their children; returns how many these are."""
    starts, total = tree.starts, 0
    for n in range(count):
        parents[n] = nodes[n]
    for n in range(count):
        parent = np.uint64(parents[n])
        for child in range(starts[parent], starts[parent + np.uint64(1)]):
            nodes[np.uint64(total)] = child
            _copy(tree.rows, child, rows, total)
            total += 1
    return total


@inner
def select(cells, to_cell, rounding, near, n):
    """Fill hits with those of the n-th list that may lie in the set; returns how many.

    rounding: by how many metres it may move a point.
    """
    where, bits, kept = near.cells, cells.bits, near.kept
    begin, count = np.uint64(near.begin[n]), near.number[n]
    unsure = np.int32(len(cells.squares))  # the index of the bit that is always set
    edge = np.float32(0.5 - rounding * cells.box.inverse)
    _locate_points(near, begin, count, to_cell, cells.box, edge, unsure)
    total = 0
    for at in range(count):
        cell = np.uint32(where[at])
        near.hits[total] = kept[begin + np.uint64(at)]
        word = bits[np.uint64(cell >> np.uint32(5))] >> (cell & np.uint32(31))
        total += 1 if word & np.uint32(1) else 0
    return total


@inner
def _locate_points(near, begin, count, move, box, edge, unsure):
    """Fill the cells of points, or `unsure` where rounding may put one in another; vectorised."""
    across, along = np.int32(box.across), np.int32(box.along)
    p, q, r = _last_centres(box)
    xs, ys, zs, where = near.x, near.y, near.z, near.cells
    for n in range(count):
        at = begin + np.uint64(n)
        x, y, z = xs[at], ys[at], zs[at]
        a = move[0] * x + move[1] * y + move[2] * z + move[9]
        b = move[3] * x + move[4] * y + move[5] * z + move[10]
        c = move[6] * x + move[7] * y + move[8] * z + move[11]
        a, b, c = min(max(_HALF, a), p), min(max(_HALF, b), q), min(max(_HALF, c), r)
        i, j, k = np.int32(a), np.int32(b), np.int32(c)
        d, e, f = (
            abs(a - np.float32(i) - _HALF),
            abs(b - np.float32(j) - _HALF),
            abs(c - np.float32(k) - _HALF),
        )
        cell = np.int32(np.int32(np.int32(i * across) + np.int32(j * along)) + k)
        where[n] = unsure if max(d, max(e, f)) > edge else cell
