"""Signed distances at many points of one pose, which are located a block at a time.

A block holds the numbers of points in rows, so that the compiler makes vector instructions of what
does not look anything up.
"""

from __future__ import annotations

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import node_of
from chsel.numerics.compiler import inner, leaf, spliced
from chsel.numerics.pose_tuples import moved
from chsel.problem.sdf_lookup import (
    distance_between_nodes,
    distance_beyond_box,
    value_between_nodes,
)

MOST = 32  # points of a block
X = 0 * MOST  # rows: coordinates in the world, metres
Y = 1 * MOST
Z = 2 * MOST
U = 3 * MOST  # from the cell's lowest node, in cells
V = 4 * MOST
W = 5 * MOST
CELL = 6 * MOST  # its lowest node, a whole number
BEYOND = 7 * MOST  # squared distance to the grid's box, metres^2
S = 8 * MOST  # signed distance, metres
SIZE = 9 * MOST


def blocks_of(points: FloatArray) -> FloatArray:
    """Return blocks (B SIZE,) of points (N, 3) of the world, metres, which are not located yet."""
    blocks = np.zeros((-(-len(points) // MOST), SIZE // MOST, MOST))
    for n, point in enumerate(points):
        blocks[n // MOST, :3, n % MOST] = point
    return blocks.reshape(-1)


@spliced
def block_of(blocks, n):
    """Return the block (SIZE,) of point n, of blocks one after the other."""
    first = n // MOST * SIZE
    return blocks[first : first + SIZE]


@inner
def locate_block(box, pose, block, count):
    """Fill the rows of places from those of coordinates; the box is one between nodes."""
    first = box.first
    last = box.last
    most = box.most
    inverse = box.inverse
    for n in range(count):
        x, y, z = block[X + n], block[Y + n], block[Z + n]
        a = pose[0] * x + pose[1] * y + pose[2] * z + pose[9]
        b = pose[3] * x + pose[4] * y + pose[5] * z + pose[10]
        c = pose[6] * x + pose[7] * y + pose[8] * z + pose[11]
        d = min(max(first[0], a), last[0])  # in this order, NaN ends up in the box
        e = min(max(first[1], b), last[1])
        f = min(max(first[2], c), last[2])
        block[BEYOND + n] = (a - d) * (a - d) + (b - e) * (b - e) + (c - f) * (c - f)
        a, b, c = (d - first[0]) * inverse, (e - first[1]) * inverse, (f - first[2]) * inverse
        d = node_of(a, 1.0, most[0])
        e = node_of(b, 1.0, most[1])
        f = node_of(c, 1.0, most[2])
        block[U + n] = a - d
        block[V + n] = b - e
        block[W + n] = c - f
        block[CELL + n] = d * box.across + e * box.along + f


@leaf
def distance_in_box_block(field, block, n):
    """Return the signed distance at a point, or at the nearest one of the box."""
    box = field.box
    across, along = np.int64(box.across), np.int64(box.along)
    cell = np.int64(block[CELL + n])
    u, v, w = block[U + n], block[V + n], block[W + n]
    return value_between_nodes(field.table, cell, across, along, u, v, w)


@leaf
def distance_in_block(field, pose, block, n):
    """Return the signed distance at a point."""
    s = distance_in_box_block(field, block, n)
    if block[BEYOND + n] > 0.0:
        s = gradient_in_block(field, pose, block, n)[0]
    return s


@inner
def gradient_in_block(field, pose, block, n):
    """Return signed distance and gradient (s, n_x, n_y, n_z) at a point."""
    cell = np.int64(block[CELL + n])
    u, v, w = block[U + n], block[V + n], block[W + n]
    looked_up = distance_between_nodes(field.box, field.table, cell, u, v, w)
    if block[BEYOND + n] > 0.0:
        x, y, z = moved(pose, block[X + n], block[Y + n], block[Z + n])
        return distance_beyond_box(field.box_distance, field.box, looked_up, x, y, z)
    return looked_up
