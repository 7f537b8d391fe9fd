"""The points that may lie in a set of cells: a tree of points, searched in 32-bit arithmetic.

A point may be left out of a sum only if it adds nothing to it. Distances are rounded so that no
such point is: whether a point lies in the set, and what it adds, is then decided in 64 bits for
the few that are left. Eight nodes or points, the lanes of a vector instruction, are tested at a
time. Sums always run in the order of the tree, so that culling changes no bit.
"""

from __future__ import annotations

from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from chsel.errors import PointsError
from chsel.numerics.arrays import FloatArray, IntArray, read_only, scratch
from chsel.numerics.cell_set import bounds_of, nearest_node, triple
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.pose_tuples import Triple

LANES = 8
_SUBDIVISION = 4  # cells of the Morton order per spacing of the points, and a power of two
_LEAST = 4  # points of a packet on average
_HALF, _ONE = np.float32(0.5), np.float32(1.0)
_ROW = np.uint64(LANES)
_BLOCK = np.uint64(4 * LANES)
_U1, _U2, _U3, _U4, _U5, _U6, _U7 = (np.uint64(n) for n in range(1, 8))
_UNIT = 2.0**-20  # 16 roundings of 32-bit numbers: more than are on the way to any coordinate
_UNIT_64 = 1e-12  # more than all roundings of 64-bit numbers in a rigid motion
_COARSEST = 0.25  # cells: if rounding moves a point further, 32 bits are not enough
_MOST_LIMIT = 1e6  # of squared distances, in cells


class PointTree(NamedTuple):
    """An octree of N points in Morton order: B blocks of at most LANES children, the root's first.

    The children of the last P blocks, the packets, are points; those of others are blocks, given by
    spheres around their points. Coordinates in blocks are relative to the origin.
    """

    points: FloatArray  # (3, N) metres
    order: IntArray  # (N,) indices that the points had before
    blocks: Any  # (4 LANES B,) x of each child, then y, z, radius; NaN where there is none; float32
    first: Any  # (B,) the first child of each block; int32
    offsets: Any  # (B,) where blocks have the x of each block; int32
    roots: int  # blocks without a parent, at most LANES
    depth: int  # levels above the packets
    packets: int  # P
    origin: Triple  # metres
    reach: float  # the greatest coordinate in blocks, metres
    rounding: float  # more metres than rounding in 64 bits moves a point in a rigid motion


def point_tree(points: FloatArray, spacing: float) -> PointTree:
    """Return the tree of points (N, 3) about `spacing` metres apart.

    Points in one cell of the Morton order stay in their order. Raises PointsError if the extent
    of the points is not finite.
    """
    points, count = read_only(points), len(points)
    lower, upper = bounds = bounds_of(points) if count else np.zeros((2, 3))
    extent = max(high - low for low, high in bounds.T.tolist())
    if not extent < np.inf:
        raise PointsError(f"points span {extent} m; accepted: a finite extent")
    bits = count.bit_length()
    most = float((1 << (63 - bits) // 3) - 1)
    quantum = spacing / _SUBDIVISION
    while extent / quantum >= most:
        quantum *= 2.0
    keys = np.empty(count, dtype=np.int64)
    _fill_keys(points, lower, 1.0 / quantum, extent, bits, keys)
    keys.sort()
    levels = _levels(keys, bits)
    below = [*accumulate(map(len, levels[:-1])), 0]  # the number of the first child
    first = np.concatenate([level + np.int32(n) for level, n in zip(levels, below, strict=True)])
    order = keys & ((1 << bits) - 1)
    origin = 0.5 * lower + 0.5 * upper
    tree = PointTree(
        points=np.empty((3, count)),
        order=order,
        blocks=np.full(4 * LANES * len(first), np.float32(np.nan)),
        first=first,
        offsets=np.zeros(len(first), dtype=np.int32),
        roots=len(levels[0]),
        depth=len(levels) - 1,
        packets=len(levels[-1]),
        origin=triple(origin),
        reach=float((upper - origin).max()) * (1.0 + 1e-6),
        rounding=1e-9 + 2.0 * _UNIT_64 * float(np.abs(bounds).max()),
    )
    _fill_blocks(points, tree)
    return tree


def _levels(keys: IntArray, bits: int) -> list[Any]:
    """Return for each level, the uppermost first, the first child of each block, of those below.

    The cells of each level are the finest that make its blocks full enough.
    """
    levels: list[Any] = []
    begins = np.empty(len(keys), dtype=np.int32)
    while len(levels) < 2 or len(levels[0]) > LANES:
        count = _begin_blocks(keys, min(bits, 63), begins)
        if count * _LEAST <= len(keys) or bits > 63:
            levels.insert(0, begins[:count].copy())
            keys = keys[levels[0]]
        bits += 3
    return levels


@compiled
def _begin_blocks(keys, bits, begins):
    """Fill the first children of blocks whose keys differ in the lowest bits alone; how many."""
    count = 0
    for n in range(len(keys)):
        if n == 0 or n - begins[count - 1] == LANES or (keys[n] ^ keys[n - 1]) >> bits:
            begins[count] = n
            count += 1
    return count


@compiled
def _fill_keys(points, lower, inverse, extent, index_bits, keys):
    """Fill keys: interleaved bits of the points' cells on the finest level, then their indices."""
    spread = np.empty(int(np.rint(extent * inverse)) + 1, dtype=np.int64)
    for cell in range(len(spread)):
        spread[cell] = _spread_bits(cell) << index_bits
    for n in range(len(points)):
        x, y, z = nearest_node(lower, inverse, points[n, 0], points[n, 1], points[n, 2])
        i, j, k = np.uint64(np.int32(x)), np.uint64(np.int32(y)), np.uint64(np.int32(z))
        keys[n] = spread[i] | spread[j] << 1 | spread[k] << 2 | n


@leaf
def _spread_bits(cell):
    """Return two zeros between each of 21 bits."""
    cell = (cell | cell << 32) & 0x1F00000000FFFF
    cell = (cell | cell << 16) & 0x1F0000FF0000FF
    cell = (cell | cell << 8) & 0x100F00F00F00F00F
    cell = (cell | cell << 4) & 0x10C30C30C30C30C3
    return (cell | cell << 2) & 0x1249249249249249


@compiled
def _fill_blocks(points, tree):
    """Fill PointTree.points, blocks and offsets, axis by axis, from the points up."""
    blocks = tree.blocks
    first = tree.first
    order = tree.order
    count = len(tree.first)
    # of boxes
    low = np.empty(count)
    high = np.empty(count)
    squares = np.zeros(count)
    for axis in range(3):
        placed, origin = tree.points[axis], tree.origin[axis]
        end = len(order)
        for block in range(count - 1, -1, -1):
            least, most = np.inf, -np.inf
            at = np.uint64(4 * LANES * block + LANES * axis)
            for child in range(first[block], end):
                if block >= count - tree.packets:
                    a = b = placed[child] = points[order[child], axis]
                else:
                    a, b = low[child], high[child]
                    tree.offsets[child] = at - np.uint64(LANES * axis)
                    radius = np.sqrt(squares[child]) * (1.0 + 1e-6)
                    blocks[at + np.uint64(LANES * (3 - axis))] = np.float32(radius)
                blocks[at] = np.float32(0.5 * a + 0.5 * b - origin)
                least = min(least, a)
                most = max(most, b)
                at = at + np.uint64(1)
            low[block], high[block] = least, most
            half = 0.5 * most - 0.5 * least
            squares[block] += half * half
            end = count if block == count - tree.packets else first[block]


class NearPoints(NamedTuple):
    """Scratch for P lists of the packets of points that are near a set of cells."""

    x: Any  # (P C + 8,) of spheres around packets, C for each list, as in PointTree.blocks; float32
    y: Any  # (P C + 8,); float32
    z: Any  # (P C + 8,); float32
    radius: Any  # (P C + 8,); float32
    kept: Any  # (P C + 8,) which packets they are, ascending, int32
    number: IntArray  # (P,) how many packets each has
    rows: Any  # (4, S) nodes, or points, that are looked at: x, y, z, radius; float32
    nodes: Any  # (S,) nodes or packets, int32
    cells: Any  # (S,) where they lie, int32
    limits: Any  # (S,) which of CellSet.steps is near enough, int32
    hits: Any  # (S,) points of a list that may lie in the set, int32


def near_points_for(tree: PointTree, lists: int) -> NearPoints:
    """Return scratch for so many lists of the points of a tree."""
    packets = tree.packets
    room = lists * packets + LANES  # vectors reach beyond the last list
    x, y, z, radius = (np.empty(room, dtype=np.float32) for _ in range(4))
    kept = np.empty(room, dtype=np.int32)
    number = scratch(lists, dtype=np.int64)
    most = LANES * (packets + 1)
    rows = np.empty((4, most), dtype=np.float32)
    nodes, cells, limits, hits = (np.empty(most, dtype=np.int32) for _ in range(4))
    return NearPoints(
        x,
        y,
        z=z,
        radius=radius,
        kept=kept,
        number=number,
        rows=rows,
        nodes=nodes,
        cells=cells,
        limits=limits,
        hits=hits,
    )


@leaf
def to_cells(tree, box, move):
    """Return the map from a tree's 32-bit coordinates to those of a grid, in cells that begin at 0.

    Also by how many metres rounding may move a point on the way; negative if by too many.
    """
    x, y, z = tree.origin
    a = move[0] * x + move[1] * y + move[2] * z + (move[9] - box.first[0])
    b = move[3] * x + move[4] * y + move[5] * z + (move[10] - box.first[1])
    c = move[6] * x + move[7] * y + move[8] * z + (move[11] - box.first[2])
    scale, shift = box.inverse, 0.5 - 0.5 * box.between
    far = abs(box.first[0]) + abs(box.first[1]) + abs(box.first[2])
    rounding = (tree.reach + max(abs(a), max(abs(b), abs(c))) + 1.0 / scale) * _UNIT
    rounding += tree.rounding + far * _UNIT_64
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

    to_cell: as to_cells makes it; slack includes its rounding.
    """
    x = near.rows[0]
    y = near.rows[1]
    z = near.rows[2]
    radius = near.rows[3]
    nodes = near.nodes
    count = tree.roots
    none = np.uint64(0)
    for at in range(np.uint64(count)):
        nodes[at] = at
    for _ in range(tree.depth):
        count = _expand(tree, nodes, count, near)
        _locate_spheres(x, y, z, radius, none, count, to_cell, cells.box, slack, near)
        count = _keep(nodes, none, count, cells.steps, near)
    begin = np.uint64(n * tree.packets)
    for at in range(np.uint64(count)):
        packet, to = nodes[at], begin + at
        offset = np.uint64(tree.offsets[np.uint64(packet)])
        near.kept[to] = packet
        near.x[to], near.y[to] = tree.blocks[offset], tree.blocks[offset + _ROW]
        near.z[to] = tree.blocks[offset + np.uint64(2) * _ROW]
        near.radius[to] = tree.blocks[offset + np.uint64(3) * _ROW]
    near.number[n] = count


@leaf
def _expand(tree, nodes, count, near):
    """Replace blocks by their children; returns how many lanes these have."""
    parents, total = near.cells, np.uint64(0)
    for n in range(np.uint64(count)):
        parents[n] = nodes[n]
    for n in range(np.uint64(count)):
        block = np.uint64(parents[n])
        for row in range(4):
            _copy(tree.blocks, block * _BLOCK + np.uint64(row) * _ROW, near.rows[row], total)
        for lane in range(_ROW):
            nodes[total + lane] = tree.first[block] + np.int32(lane)
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
    where = near.cells
    limits = near.limits
    kept = near.nodes
    total = np.uint64(0)
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
    """Return the centre of the last cell, in cells."""
    p, q, r = box.most
    return np.float32(p + 0.5), np.float32(q + 0.5), np.float32(r + 0.5)


@inner
def select(tree, cells, to_cell, rounding, near, n):
    """Fill hits with the points of the n-th list that may lie in the set; returns how many.

    rounding: by how many metres it may move a point.
    """
    steps = cells.steps
    where = near.cells
    nodes = near.nodes
    hits = near.hits
    begin, count = np.uint64(n * tree.packets), near.number[n]
    _locate_spheres(
        near.x, near.y, near.z, near.radius, begin, count, to_cell, cells.box, rounding, near
    )
    packets = _keep(near.kept, begin, count, steps, near)
    x, y, z = near.rows[0], near.rows[1], near.rows[2]
    for at in range(np.uint64(packets)):
        offset, to = np.uint64(nodes[at]) * _BLOCK, at * _ROW
        _copy(tree.blocks, offset, x, to)
        _copy(tree.blocks, offset + _ROW, y, to)
        _copy(tree.blocks, offset + np.uint64(2) * _ROW, z, to)
    _locate_points(x, y, z, packets, to_cell, cells, rounding, where)
    total = np.uint64(0)
    for at in range(np.uint64(packets)):
        point = tree.first[np.uint64(nodes[at])]
        for lane in range(_ROW):
            hits[total] = point + np.int32(lane)
            total += np.uint64(steps[np.uint64(where[at * _ROW + lane])] == 0)
    return np.int64(total)


@inner
def _locate_points(x, y, z, packets, move, cells, rounding, where):
    """Fill the cells of the points of packets; vectorised.

    It is one with a step of 0 where rounding may put a point in another, and of 255 where x is NaN.
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
