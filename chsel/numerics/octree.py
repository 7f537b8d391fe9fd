"""An octree of points, and the points of it that can lie in a region.

A point may be left out of a sum only if it adds nothing to it, so that the sum over the others is
the sum over all points, to the bit. Sums always run in the order of the tree.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.errors import PointsError
from chsel.numerics.arrays import FloatArray, IntArray, read_only
from chsel.numerics.cell_set import Places, locate, places_for
from chsel.numerics.compiler import compiled, leaf, spliced
from chsel.numerics.voxels import bounds_of

_LEAF_SIZE = 4  # points in a leaf on average, at least
_TOP_SIZE = 64  # nodes of the uppermost level at most
_SUBDIVISION = 4  # cells of the finest level per spacing of the points, and a power of two


class Tree(NamedTuple):
    """N points in Morton order, and the M nodes of an octree over them, level by level."""

    spheres: FloatArray  # (4, M + N) centre and radius around what is in a node; points have 0
    starts: IntArray  # (M + 1,) the first child of each node, then M + N
    levels: IntArray  # (L + 1,) the first node of each level, the uppermost first, then M
    order: IntArray  # (N,) indices that the points had before


class Candidates(NamedTuple):
    """Scratch of one thread: the points or nodes that a walk looks at and keeps."""

    x: FloatArray  # (S,)
    y: FloatArray
    z: FloatArray
    radius: FloatArray
    places: Places  # where they lie once moved
    nodes: Any  # (S,) which they are, int32
    kept: Any  # (S,) those that a walk keeps, int32


def candidates_for(size: int) -> Candidates:
    """Scratch for `size` points and nodes."""
    x, y, z, radius = (np.empty(size) for _ in range(4))
    nodes, kept = (np.empty(size, dtype=np.int32) for _ in range(2))
    return Candidates(x, y, z, radius, places_for(size), nodes, kept)


def octree(points: FloatArray, spacing: float) -> Tree:
    """The tree of points (N, 3) about `spacing` metres apart.

    Points in one cell of the finest level stay in their order. Raises PointsError if the extent
    of the points is not finite.
    """
    count = len(points)
    if count == 0:
        none = np.zeros(0, dtype=np.int64)
        return Tree(np.zeros((4, 0)), np.zeros(1, np.int64), np.zeros(1, np.int64), none)
    points, bounds = read_only(points), bounds_of(points)
    extent = max(high - low for low, high in bounds.T.tolist())
    if not extent < np.inf:
        raise PointsError(f"points span {extent} m; accepted: a finite extent")
    index_bits = count.bit_length()
    most = float((1 << (63 - index_bits) // 3) - 1)
    quantum = spacing / _SUBDIVISION
    while extent / quantum >= most:
        quantum *= 2.0
    keys = np.empty(count, dtype=np.int64)
    _fill_keys(points, bounds[0], 1.0 / quantum, extent, index_bits, keys)
    keys.sort()
    levels = np.zeros(24, dtype=np.int64)
    depth, finest = _count_levels(keys, index_bits, levels)
    levels = levels[: depth + 1]
    spheres = np.empty((4, levels[-1] + count))
    starts = np.empty(levels[-1] + 1, dtype=np.int64)
    margin = rounding_margin(bounds)
    tree = Tree(spheres, starts, levels, keys)
    _build(points, index_bits, finest, margin, tree)
    return tree


def rounding_margin(coordinates: FloatArray) -> float:
    """More metres than rounding moves a point of such coordinates in a rigid motion."""
    return 1e-9 + 1e-12 * float(np.abs(coordinates).max(initial=0.0))


@compiled
def _fill_keys(points, lower, inverse, extent, index_bits, keys):
    """Interleaved bits of the points' cells on the finest level, then the points' indices."""
    spread = np.empty(int(np.rint(extent * inverse)) + 1, dtype=np.int64)
    for cell in range(len(spread)):
        spread[cell] = _spread_bits(cell) << index_bits
    x, y, z = lower[0], lower[1], lower[2]
    for n in range(len(points)):
        i = np.uint64(np.int32(np.rint((points[n, 0] - x) * inverse)))
        j = np.uint64(np.int32(np.rint((points[n, 1] - y) * inverse)))
        k = np.uint64(np.int32(np.rint((points[n, 2] - z) * inverse)))
        keys[n] = spread[i] | spread[j] << 1 | spread[k] << 2 | n


@leaf
def _spread_bits(cell):
    """Two zeros between each of 21 bits."""
    cell = (cell | cell << 32) & 0x1F00000000FFFF
    cell = (cell | cell << 16) & 0x1F0000FF0000FF
    cell = (cell | cell << 8) & 0x100F00F00F00F00F
    cell = (cell | cell << 4) & 0x10C30C30C30C30C3
    return (cell | cell << 2) & 0x1249249249249249


@compiled
def _count_levels(keys, index_bits, levels):
    """Fill levels with offsets; returns how many levels there are, and how coarse the lowest is."""
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
def _build(points, index_bits, finest, margin, tree):
    """Fill the tree from its levels and, in place of the order, its keys, the points first.

    finest: how coarse the leaves are.
    """
    spheres, starts, levels, keys = tree
    nodes, depth = levels[-1], len(levels) - 1
    low, high = np.empty((nodes, 3)), np.empty((nodes, 3))
    inner = np.empty(nodes, dtype=np.int64)
    node, last = levels[depth - 1] - 1, -1
    x = y = z = a = b = c = 0.0
    for n in range(len(points)):
        key, at = keys[n] >> (index_bits + 3 * finest), keys[n] & ((1 << index_bits) - 1)
        p, q, r = points[at, 0], points[at, 1], points[at, 2]
        keys[n] = at
        spheres[0, nodes + n], spheres[1, nodes + n], spheres[2, nodes + n] = p, q, r
        spheres[3, nodes + n] = 0.0
        if key != last:
            last, node = key, node + 1
            starts[node], inner[node] = nodes + n, key
            x, y, z, a, b, c = p, q, r, p, q, r
        x, y, z = min(x, p), min(y, q), min(z, r)
        a, b, c = max(a, p), max(b, q), max(c, r)
        low[node, 0], low[node, 1], low[node, 2] = x, y, z
        high[node, 0], high[node, 1], high[node, 2] = a, b, c
    starts[nodes] = nodes + len(points)
    for level in range(depth - 2, -1, -1):
        node, last = levels[level] - 1, -1
        for child in range(levels[level + 1], levels[level + 2]):
            key = inner[child] >> 3
            if key != last:
                last, node = key, node + 1
                starts[node], inner[node] = child, key
                for axis in range(3):
                    low[node, axis], high[node, axis] = low[child, axis], high[child, axis]
            for axis in range(3):
                low[node, axis] = min(low[node, axis], low[child, axis])
                high[node, axis] = max(high[node, axis], high[child, axis])
    for node in range(nodes):
        squared = 0.0
        for axis in range(3):
            spheres[axis, node] = 0.5 * (low[node, axis] + high[node, axis])
            half = 0.5 * (high[node, axis] - low[node, axis])
            squared += half * half
        spheres[3, node] = np.sqrt(squared) * (1.0 + 1e-12) + margin


@spliced
def walk(tree, region, move, slack, candidates):
    """Collect the points that are within `slack` metres of a region once moved; returns how many.

    They are in candidates.x, y, z, kept, in ascending order. A node is left out if no point of its
    sphere can be so near; an infinite slack keeps all points.
    """
    levels, nodes = tree.levels, candidates.nodes
    x, y, z = candidates.x, candidates.y, candidates.z
    count = 0
    if levels[len(levels) - 1] > 0:
        count = levels[1]
        for node in range(count):
            nodes[node] = node
            copy_centre(tree.spheres, node, candidates, node)
            candidates.radius[node] = tree.spheres[3, node]
        for level in range(len(levels)):
            locate(move, region.box, x, y, z, candidates.places, count)
            count = _keep(region.clearance, slack, candidates, count)
            if level < len(levels) - 1:
                count = _expand(tree.spheres, tree.starts, count, candidates)
    return count


@leaf
def copy_centre(spheres, node, candidates, n):
    """Make the centre of a node, or a point, that of the n-th candidate."""
    candidates.x[n], candidates.y[n] = spheres[0, node], spheres[1, node]
    candidates.z[n] = spheres[2, node]


@spliced
def _expand(spheres, starts, count, candidates):
    """Replace the nodes kept by their children."""
    kept, nodes, radius = candidates.kept, candidates.nodes, candidates.radius
    total = 0
    for n in range(count):
        for child in range(starts[kept[n]], starts[kept[n] + 1]):
            nodes[total] = child
            copy_centre(spheres, child, candidates, total)
            radius[total] = spheres[3, child]
            total += 1
    return total


@spliced
def _keep(clearance, slack, candidates, count):
    """Keep what is near enough, in its order, without branches."""
    x, y, z, radius = candidates.x, candidates.y, candidates.z, candidates.radius
    nodes, kept = candidates.nodes, candidates.kept
    cell, beyond = candidates.places.cell, candidates.places.beyond
    total = 0
    for n in range(count):
        # The region lies within its box, which is convex: at least this far, by Pythagoras.
        squared = max(clearance[cell[n]], np.float32(0.0)) + beyond[n]
        reach = radius[n] + slack
        kept[total] = nodes[n]
        x[total], y[total], z[total] = x[n], y[n], z[n]
        total += 1 if squared <= reach * reach else 0
    return total
