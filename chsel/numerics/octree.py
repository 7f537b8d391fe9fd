"""Which points a region can hold: an octree of points.

A point may be left out of a sum only if it adds nothing to it, so that a sum over what is left
is the sum over all points, to the bit. The points' order is that of the tree, always.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.errors import PointsError
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.cell_set import Places, locate, places_for
from chsel.numerics.compiler import compiled, leaf, spliced

_LEAF_SIZE = 4  # points in a leaf at least, in the mean
_TOP_SIZE = 64  # nodes of the uppermost level at most
_SUBDIVISION = 4  # cells of the finest level per spacing of the points, and a power of two
_RADIX_BITS = 11


class Tree(NamedTuple):
    """Points in Morton order, and the cells of an octree over them, level by level.

    spheres (4, M + N): centre and radius that hold what is in a node, the uppermost level first;
    the N points are the last level, of radius 0. starts (M + 1,): the first child of each node,
    then M + N. levels (L + 1,): the first node of each level, then M. order (N,): the places
    that the points had.
    """

    spheres: FloatArray
    starts: IntArray
    levels: IntArray
    order: IntArray


class Found(NamedTuple):
    """Scratch of one thread for points or nodes in question, and for what a walk finds.

    x, y, z, radius (S,): of them. places: see locate. nodes, kept (S,): which they are.
    """

    x: FloatArray
    y: FloatArray
    z: FloatArray
    radius: FloatArray
    places: Places
    nodes: Any
    kept: Any


def found_for(size: int) -> Found:
    """Scratch for so many points and nodes."""
    x, y, z, radius = (np.empty(size) for _ in range(4))
    nodes, kept = (np.empty(size, dtype=np.int32) for _ in range(2))
    return Found(x, y, z, radius, places_for(size), nodes, kept)


def octree(points: FloatArray, spacing: float) -> Tree:
    """The tree of points (N, 3) about `spacing` metres apart.

    Points in one cell of the finest level stay in their order. Raises PointsError for points too
    far apart for their distance to be a number.
    """
    count = len(points)
    if count == 0:
        none = np.zeros(0, dtype=np.int64)
        return Tree(np.zeros((4, 0)), np.zeros(1, np.int64), np.zeros(1, np.int64), none)
    points, box = np.array(points), np.empty(6)
    _bounds(points, box)
    extent = max(high - low for low, high in zip(*box.reshape(2, 3).tolist(), strict=True))
    if not extent < np.inf:
        raise PointsError(f"points span {extent} m; accepted: a finite extent")
    index_bits = count.bit_length()
    most = float((1 << (63 - index_bits) // 3) - 1)
    quantum = spacing / _SUBDIVISION
    while extent / quantum >= most:
        quantum *= 2.0
    keys = np.empty(count, dtype=np.int64)
    _morton_keys(points, box[:3], 1.0 / quantum, index_bits, keys)
    key_bits = 3 * int(extent / quantum + 1.0).bit_length()
    keys = _sorted(keys, np.empty_like(keys), index_bits, index_bits + key_bits)
    order = keys & ((1 << index_bits) - 1)
    levels = np.zeros(24, dtype=np.int64)
    depth, finest = _count_levels(keys, index_bits, levels)
    levels = levels[: depth + 1]
    spheres = np.empty((4, levels[-1] + count))
    starts = np.empty(levels[-1] + 1, dtype=np.int64)
    size = rounding_margin(box)
    _build(points, keys, order, index_bits + 3 * finest, size, spheres, starts, levels)
    return Tree(spheres, starts, levels, order)


def rounding_margin(coordinates: FloatArray) -> float:
    """More metres than rounding moves a point of such coordinates that is turned and shifted."""
    return 1e-9 + 1e-12 * float(np.abs(coordinates).max(initial=0.0))


@compiled
def _bounds(points, box):
    """Fill box (6,) with the least and the greatest coordinates of points (N, 3), N > 0."""
    x0, y0, z0 = points[0, 0], points[0, 1], points[0, 2]
    x1, y1, z1 = x0, y0, z0
    for n in range(1, len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
        x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
    box[0], box[1], box[2], box[3], box[4], box[5] = x0, y0, z0, x1, y1, z1


@compiled
def _morton_keys(points, lower, inverse, index_bits, keys):
    """Interleaved bits of the points' cells on the finest level, then the points' indices."""
    for n in range(len(points)):
        key = 0
        for axis in range(3):
            cell = int(np.rint((points[n, axis] - lower[axis]) * inverse))
            key |= _spread_bits(cell) << axis
        keys[n] = key << index_bits | n


@leaf
def _spread_bits(cell):
    """Two zeros between each of 21 bits."""
    cell = (cell | cell << 32) & 0x1F00000000FFFF
    cell = (cell | cell << 16) & 0x1F0000FF0000FF
    cell = (cell | cell << 8) & 0x100F00F00F00F00F
    cell = (cell | cell << 4) & 0x10C30C30C30C30C3
    return (cell | cell << 2) & 0x1249249249249249


@compiled
def _sorted(keys, other, first_bit, last_bit):
    """Keys in order of their bits from first_bit on: a stable radix sort. `other` is scratch."""
    mask = (1 << _RADIX_BITS) - 1
    starts = np.empty(mask + 1, dtype=np.int64)
    for shift in range(first_bit, last_bit, _RADIX_BITS):
        starts[:] = 0
        for n in range(len(keys)):
            starts[(keys[n] >> shift) & mask] += 1
        total = 0
        for digit in range(mask + 1):
            count = starts[digit]
            starts[digit] = total
            total += count
        for n in range(len(keys)):
            digit = (keys[n] >> shift) & mask
            other[starts[digit]] = keys[n]
            starts[digit] += 1
        keys, other = other, keys
    return keys


@compiled
def _count_levels(keys, index_bits, levels):
    """Fill levels with offsets; how many levels there are, and how coarse the lowest is."""
    changes = np.zeros(24, dtype=np.int64)  # neighbours that share a cell from this level on
    for n in range(1, len(keys)):
        differing = (keys[n] ^ keys[n - 1]) >> index_bits
        level = 0
        while differing:
            differing >>= 3
            level += 1
        changes[level] += 1
    finest, cells = 0, len(keys) - changes[0]
    while cells * _LEAF_SIZE > len(keys) and cells > 1:
        finest += 1
        cells -= changes[finest]
    depth, level = 1, finest
    levels[1] = cells
    while cells > _TOP_SIZE:
        level += 1
        cells -= changes[level]
        depth += 1
        levels[depth] = cells
    for n in range(1, (depth + 1) // 2 + 1):  # from the top down, and summed
        other = depth + 1 - n
        if n < other:
            levels[n], levels[other] = levels[other], levels[n]
    for n in range(1, depth + 1):
        levels[n] += levels[n - 1]
    return depth, finest


@compiled
def _build(points, keys, order, shift, size, spheres, starts, levels):
    """Fill spheres and starts from the points upwards. shift: bits of a key below a leaf's."""
    nodes, count = levels[-1], len(points)
    low, high = np.empty((3, nodes)), np.empty((3, nodes))
    for n in range(count):
        for axis in range(3):
            spheres[axis, nodes + n] = points[order[n], axis]
        spheres[3, nodes + n] = 0.0
    starts[nodes] = nodes + count
    inner, depth = np.empty(nodes, dtype=np.int64), len(levels) - 1
    for level in range(depth - 1, -1, -1):
        below, until = levels[level + 1], levels[level + 2] if level < depth - 1 else nodes + count
        node = levels[level] - 1
        last = -1
        for child in range(below, until):
            key = keys[child - nodes] >> shift if level == depth - 1 else inner[child] >> 3
            if key != last:
                last = key
                node += 1
                starts[node] = child
                inner[node] = key
            _widen(low, high, node, child, starts[node] == child, nodes, spheres)
    for node in range(nodes):
        squared = 0.0
        for axis in range(3):
            spheres[axis, node] = 0.5 * (low[axis, node] + high[axis, node])
            half = 0.5 * (high[axis, node] - low[axis, node])
            squared += half * half
        spheres[3, node] = np.sqrt(squared) * (1.0 + 1e-12) + size


@spliced
def _widen(low, high, node, child, is_first, nodes, spheres):
    """Make the box of a node hold a child's: another node's box, or a point."""
    for axis in range(3):
        if child >= nodes:
            a = b = spheres[axis, child]
        else:
            a, b = low[axis, child], high[axis, child]
        low[axis, node] = a if is_first else min(low[axis, node], a)
        high[axis, node] = b if is_first else max(high[axis, node], b)


@spliced
def walk(tree, region, move, slack, found):
    """Find the points that are within `slack` metres of a region once moved; how many they are.

    They are in found.x, y, z, kept, in ascending order. A node is left out if no point of its
    sphere can be so near; all points are found for an infinite slack.
    """
    levels = tree.levels
    count = 0
    if levels[len(levels) - 1] > 0:
        for node in range(levels[1]):
            found.kept[node] = node
        count = _take(tree.spheres, found.kept, levels[1], found)
        for level in range(len(levels)):
            locate(move, region.box, found.x, found.y, found.z, found.places, count)
            count = _keep(region.clearance, slack, found, count)
            if level < len(levels) - 1:
                count = _expand(tree.spheres, tree.starts, count, found)
    return count


@spliced
def _take(spheres, nodes, count, found):
    for n in range(count):
        node = nodes[n]
        found.nodes[n] = node
        found.x[n], found.y[n] = spheres[0, node], spheres[1, node]
        found.z[n], found.radius[n] = spheres[2, node], spheres[3, node]
    return count


@spliced
def _expand(spheres, starts, count, found):
    """The children of the nodes kept."""
    kept, nodes = found.kept, found.nodes
    x, y, z, radius = found.x, found.y, found.z, found.radius
    total = 0
    for n in range(count):
        for child in range(starts[kept[n]], starts[kept[n] + 1]):
            nodes[total] = child
            x[total], y[total] = spheres[0, child], spheres[1, child]
            z[total], radius[total] = spheres[2, child], spheres[3, child]
            total += 1
    return total


@spliced
def _keep(clearance, slack, found, count):
    """Keep what is near enough, in its order; the counting is free of branches."""
    x, y, z, radius, nodes, kept = found.x, found.y, found.z, found.radius, found.nodes, found.kept
    cell, beyond = found.places.cell, found.places.beyond
    total = 0
    for n in range(count):
        # The region lies within its box, which is convex: so far at least, by Pythagoras.
        squared = max(clearance[cell[n]], np.float32(0.0)) + beyond[n]
        reach = radius[n] + slack
        kept[total] = nodes[n]
        x[total], y[total], z[total] = x[n], y[n], z[n]
        total += 1 if squared <= reach * reach else 0
    return total
