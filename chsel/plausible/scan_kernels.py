"""Which poses of a grid cost less than a limit: sieves of blocks of positions, then exact costs.

Blocks of a layer are looked up together, point by point, so that numbers are taken several at a
time; those whose bounds are too high are left out after every few points.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.compiler import compiled, inner, leaf, spliced
from chsel.numerics.octree import Candidates
from chsel.numerics.pose_tuples import turned
from chsel.plausible.evaluation_cost import EvaluationModel, cost_below, scratch_for
from chsel.plausible.position_blocks import Blocks, DistanceBounds

LANES = 16  # blocks that are looked up at a time
_FEW, _MANY = 4, 16  # points between two times that blocks are left out: at first, and later
_ENOUGH = 16  # points from which on it is the latter


class Scan(NamedTuple):
    """All that a scan reads: every rotation with every position."""

    model: EvaluationModel
    blocks: Blocks  # of the positions, with centres from the grid's
    bounds: DistanceBounds
    rotations: FloatArray  # (R, 9), object_from_world
    positions: FloatArray  # (P, 3), world
    known: FloatArray  # (3, M), from the grid's centre, the most informative first
    known_sdf: Any  # (M,), m; float32
    limit: float  # costs are below it
    known_limit: Any  # more than the sum over known points of any such pose; float32


class ScanBuffer(NamedTuple):
    """Scratch of one thread, and the poses below the limit that it collects."""

    cost_scratch: Candidates
    points: Any  # (3, M) turned known points, from the corner of a table, cells; float32
    centres: Any  # (3, S) turned centres of blocks, cells; float32
    total: Any  # (S,) lower bounds of their sums over known points, m; float32
    block: Any  # (S,) their numbers; int32
    within: Any  # (S,) those of the blocks within; int32
    cell: Any  # (_MANY * LANES,) where they are looked up; int32
    pose: IntArray  # (C,) numbers of poses
    cost: FloatArray  # (C,)


def scan_buffer(scan: Scan, capacity: int) -> ScanBuffer:
    """A buffer for so many poses."""
    size = (len(scan.blocks.position) // LANES + 1) * LANES
    known = scan.known.shape[1]
    return ScanBuffer(
        cost_scratch=scratch_for(scan.model),
        points=np.empty((3, known), dtype=np.float32),
        centres=np.zeros((3, size), dtype=np.float32),
        total=np.zeros(size, dtype=np.float32),
        block=np.empty(size, dtype=np.int32),
        within=np.empty(size, dtype=np.int32),
        cell=np.empty(_MANY * LANES, dtype=np.int32),
        pose=np.empty(capacity, dtype=np.int64),
        cost=np.empty(capacity),
    )


@compiled
def scan_rotations(scan, first, last, buffer):
    """Collect the poses below the limit, of rotations from `first` to before `last`.

    Returns the rotation to go on with, which is less than `last` where the buffer may be too small
    for it, and the number of poses in the buffer.
    """
    positions, blocks, layers = scan.positions, scan.blocks, scan.bounds.layers
    block, count = buffer.block, 0
    for n in range(first, last):
        if len(buffer.pose) - count < len(positions):
            return n, count
        rotation = _rotation_at(scan.rotations, n)
        left = blocks.layers[1]
        for i in range(left):
            block[i] = i
        for layer in range(len(layers)):
            if layer > 0:
                left = _open(blocks, buffer, left)
            _turn(scan, layers[layer], rotation, buffer, left)
            left = _sieve(scan, layers[layer], buffer, left)
        for i in range(left):
            position = blocks.position[block[i]]
            x, y, z = positions[position]
            x, y, z = turned(rotation, x, y, z)
            a, b, c, d, e, f, g, h, j = rotation
            pose = (a, b, c, d, e, f, g, h, j, -x, -y, -z)
            cost = cost_below(scan.model, pose, scan.limit, buffer.cost_scratch)
            if cost < scan.limit:
                buffer.pose[count] = n * len(positions) + position
                buffer.cost[count] = cost
                count += 1
    return last, count


@spliced
def _rotation_at(rotations, n):
    """Row n of rotations (R, 9)."""
    a, b, c, d = rotations[n, 0], rotations[n, 1], rotations[n, 2], rotations[n, 3]
    e, f, g, h = rotations[n, 4], rotations[n, 5], rotations[n, 6], rotations[n, 7]
    return a, b, c, d, e, f, g, h, rotations[n, 8]


@inner
def _open(blocks, buffer, count):
    """Replace the first `count` blocks by the blocks within them; returns how many."""
    block, within, total = buffer.block, buffer.within, 0
    for i in range(count):
        for child in range(blocks.starts[block[i]], blocks.starts[block[i] + 1]):
            within[total] = child
            total += 1
    for i in range(total):
        block[i] = within[i]
    return total


@inner
def _turn(scan, bounds, rotation, buffer, count):
    """Turn the known points, and the centres of the first `count` blocks, in cells of a layer."""
    known, centres, block = scan.known, scan.blocks.centres, buffer.block
    p, q, r, inverse = bounds.corner_x, bounds.corner_y, bounds.corner_z, bounds.inverse
    us, vs, ws = buffer.points[0], buffer.points[1], buffer.points[2]
    for m in range(known.shape[1]):
        x, y, z = turned(rotation, known[0, m], known[1, m], known[2, m])
        us[m] = np.float32((x - p) * inverse)
        vs[m] = np.float32((y - q) * inverse)
        ws[m] = np.float32((z - r) * inverse)
    us, vs, ws = buffer.centres[0], buffer.centres[1], buffer.centres[2]
    for i in range(count):
        n = block[i]
        x, y, z = turned(rotation, centres[0, n], centres[1, n], centres[2, n])
        us[i], vs[i] = np.float32(x * inverse), np.float32(y * inverse)
        ws[i] = np.float32(z * inverse)


@inner
def _sieve(scan, bounds, buffer, count):
    """Keep those of the first `count` blocks that can hold a pose below the limit; how many."""
    block, total, limit = buffer.block, buffer.total, scan.known_limit
    us, vs, ws = buffer.centres[0], buffer.centres[1], buffer.centres[2]
    for i in range(count):
        total[i] = np.float32(0.0)
    first, last, most = 0, 0, buffer.points.shape[1]
    while last < most and count > 0:
        first, last = last, min(last + (_FEW if last < _ENOUGH else _MANY), most)
        for start in range(0, count, LANES):
            _look_up(bounds, buffer, start, first, last)
            _add(scan, buffer, start, first, last)
        kept = 0
        for i in range(count):
            us[kept], vs[kept], ws[kept] = us[i], vs[i], ws[i]
            total[kept], block[kept] = total[i], block[i]
            kept += 1 if total[i] <= limit else 0
        count = kept
    return count


@leaf
def _look_up(bounds, buffer, start, first, last):
    """Fill buffer.cell for the blocks from `start` on and points from `first` to before `last`."""
    cell, points, unsure = buffer.cell, buffer.points, bounds.unsure
    us, vs, ws = buffer.centres[0], buffer.centres[1], buffer.centres[2]
    across, along, row, unknown = bounds.across, bounds.along, bounds.row, bounds.unknown
    half, sure = np.float32(0.5), np.float32(1.0) - unsure
    p, q, r = bounds.most_x + half, bounds.most_y + half, bounds.most_z + half
    place = 0
    for m in range(first, last):
        u, v, w = points[0, m], points[1, m], points[2, m]
        for i in range(LANES):
            a = min(max(half, u - us[start + i]), p)
            b = min(max(half, v - vs[start + i]), q)
            c = min(max(half, w - ws[start + i]), r)
            x, y, z = np.int32(a), np.int32(b), np.int32(c)
            cell[place + i] = np.int32(x * across + y * along + z + row)
        if unsure > np.float32(0.0):
            for i in range(LANES):
                a = min(max(half, u - us[start + i]), p)
                b = min(max(half, v - vs[start + i]), q)
                c = min(max(half, w - ws[start + i]), r)
                a -= np.float32(np.int32(a))
                b -= np.float32(np.int32(b))
                c -= np.float32(np.int32(c))
                least, greatest = min(min(a, b), c), max(max(a, b), c)
                known = (least > unsure) & (greatest < sure)
                cell[place + i] = cell[place + i] if known else unknown
        place += LANES


@leaf
def _add(scan, buffer, start, first, last):
    """Add the bounds in buffer.cell to the totals of the blocks from `start` on."""
    table, cell, total, values = scan.bounds.table, buffer.cell, buffer.total, scan.known_sdf
    zero, place = np.float32(0.0), 0
    for m in range(first, last):
        if scan.bounds.common:
            for i in range(LANES):
                total[start + i] += table[0, np.uint64(cell[place + i])]
        else:
            for i in range(LANES):
                at, value = np.uint64(cell[place + i]), values[m]
                bound = max(table[0, at] - value, table[1, at] + value)
                total[start + i] += max(bound, zero)
        place += LANES
