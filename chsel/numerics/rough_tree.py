"""An octree in 32-bit numbers, laid out for vector instructions."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.compiler import compiled, leaf
from chsel.numerics.octree import Tree
from chsel.numerics.pose_tuples import Triple

LANES = 8


class RoughTree(NamedTuple):
    """A tree of J inner nodes, the root first, over C packets of at most LANES points each.

    The children of a node are in K blocks of at most LANES: inner nodes, or packets on the lowest
    level. Coordinates are relative to the origin. What a block or packet lacks of LANES is NaN.
    """

    blocks: Any  # (4 K LANES,) in each block the children's x, then y, z and radius; float32
    starts: Any  # (J + 1,) the first block of each inner node, then K; int32
    first: Any  # (K,) the first child of each block; int32
    depth: int  # levels of inner nodes
    points: Any  # (3 C LANES,) in each packet x, then y, z; float32
    begins: Any  # (C + 1,) the first point of each packet, then N; int32
    places: Any  # (C,) where blocks have the x of each packet; int32
    origin: Triple  # metres
    reach: float  # the greatest coordinate, metres


def rough_tree(tree: Tree) -> RoughTree:
    """The same tree in 32 bits."""
    top = tree.spheres[:, : tree.levels[min(1, len(tree.levels) - 1)]]
    low, high = (top[:3].min(axis=1), top[:3].max(axis=1)) if top.size else (np.zeros(3),) * 2
    origin = 0.5 * low + 0.5 * high
    away = np.abs(top[:3] - origin[:, None]) + top[3]  # of any point, at most
    x, y, z = origin.tolist()
    points, begins, packets = _packed(tree, x, y, z)
    blocks, starts, first, places = _linked(tree, x, y, z, begins, packets)
    return RoughTree(
        blocks=blocks,
        starts=starts,
        first=first,
        depth=len(tree.levels) - 1,
        points=points,
        begins=begins,
        places=places,
        origin=(x, y, z),
        reach=float(away.max(initial=0.0)) * (1.0 + 1e-6),
    )


@compiled
def _packed(tree, x, y, z):
    """RoughTree.points and begins, and the first packet (leaves + 1,) of each leaf, then C."""
    spheres, starts, levels = tree.spheres, tree.starts, tree.levels
    nodes, count = levels[-1], spheres.shape[1] - levels[-1]
    leaves = levels[len(levels) - 2] if len(levels) > 1 else nodes
    packets, total = np.zeros(nodes - leaves + 1, dtype=np.int32), 0
    for node in range(leaves, nodes):
        total += (starts[node + 1] - starts[node] + LANES - 1) // LANES
        packets[node + 1 - leaves] = total
    begins, packet = np.empty(total + 1, dtype=np.int32), 0
    points = np.full(3 * LANES * total, np.float32(np.nan))
    for node in range(leaves, nodes):
        for begin in range(starts[node], starts[node + 1], LANES):
            begins[packet] = begin - nodes
            for n in range(begin, min(begin + LANES, starts[node + 1])):
                at = np.uint64(3 * LANES * packet + n - begin)
                points[at] = np.float32(spheres[0, n] - x)
                points[at + np.uint64(LANES)] = np.float32(spheres[1, n] - y)
                points[at + np.uint64(2 * LANES)] = np.float32(spheres[2, n] - z)
            packet += 1
    begins[total] = count
    return points, begins, packets


@compiled
def _linked(tree, x, y, z, begins, packets):
    """RoughTree.blocks, starts, first and places."""
    spheres, starts, levels = tree.spheres, tree.starts, tree.levels
    nodes, depth = levels[-1], len(levels) - 1
    leaves = levels[depth - 1] if depth > 0 else 0
    first_blocks, total = np.zeros(leaves + 2, dtype=np.int32), 0
    for node in range(leaves + 1):
        low, high = _children(starts, levels, packets, node)
        total += (high - low + LANES - 1) // LANES
        first_blocks[node + 1] = total
    blocks = np.full(4 * LANES * total, np.float32(np.nan))
    first, places = np.empty(total, dtype=np.int32), np.empty(len(begins) - 1, dtype=np.int32)
    for node in range(leaves + 1):
        low, high = _children(starts, levels, packets, node)
        is_lowest = depth == 1 or (depth > 1 and node > levels[depth - 2])
        for child in range(low, high):
            block = first_blocks[node] + (child - low) // LANES
            place = 4 * LANES * block + (child - low) % LANES
            if place % LANES == 0:
                first[block] = child
            if is_lowest:
                places[child] = place
                a, b, c, radius = _sphere_around(spheres, nodes, begins[child], begins[child + 1])
            else:
                a, b, c = spheres[0, child - 1], spheres[1, child - 1], spheres[2, child - 1]
                radius = spheres[3, child - 1]
            blocks[place], blocks[place + LANES] = np.float32(a - x), np.float32(b - y)
            blocks[place + 2 * LANES] = np.float32(c - z)
            blocks[place + 3 * LANES] = np.float32(radius * (1.0 + 1e-6))
    return blocks, first_blocks, first, places


@leaf
def _children(starts, levels, packets, node):
    """The first child of an inner node, and the one after its last: inner nodes, or packets."""
    depth = len(levels) - 1
    if depth == 0:
        return 0, 0
    low, high = (starts[node - 1], starts[node]) if node > 0 else (0, levels[1])
    leaves = levels[depth - 1]
    if low >= leaves:
        return np.int64(packets[low - leaves]), np.int64(packets[high - leaves])
    return low + 1, high + 1


@leaf
def _sphere_around(spheres, nodes, begin, end):
    """Centre and radius of a sphere around points, but for what rounding moves them."""
    x, y, z = spheres[0, nodes + begin], spheres[1, nodes + begin], spheres[2, nodes + begin]
    a, b, c = x, y, z
    for n in range(np.uint64(nodes + begin + 1), np.uint64(nodes + end)):
        x, y, z = min(x, spheres[0, n]), min(y, spheres[1, n]), min(z, spheres[2, n])
        a, b, c = max(a, spheres[0, n]), max(b, spheres[1, n]), max(c, spheres[2, n])
    p, q, r = 0.5 * (a - x), 0.5 * (b - y), 0.5 * (c - z)
    radius = np.sqrt(p * p + q * q + r * r) * (1.0 + 1e-12)
    return 0.5 * (x + a), 0.5 * (y + b), 0.5 * (z + c), radius
