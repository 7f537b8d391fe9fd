"""Signed distances at many points, in numbers of 32 bits, in vectors as far as possible.

Nodes are read point by point: those around a point in the grid's box, and those around the nearest
point of its border otherwise.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.compiler import inner, leaf
from chsel.numerics.pose_tuples import Triple

# A block holds the numbers of 256 points, a row for each quantity, in cells of the SDF grid.
MOST = 256
TERM = 0 * MOST  # row: signed distance, then what it adds to a sum
_GAP = 1 * MOST  # the first of 3 rows: from the grid's box to the point
_SHARE = 4 * MOST  # the first of 3 rows: from the lowest node of the cell, once in the box
_ACROSS = 7 * MOST  # row: of these, that along the first side of the box that is nearest,
_ALONG = 8 * MOST  # row: and that along the second
_BEYOND = 9 * MOST  # row: 1 beyond the box, else 0
BLOCK = 10 * MOST
# Integers of these points.
_CELL = 0 * MOST  # row: the lowest node of the cell
_CORNER = 1 * MOST  # row: of that of its sides that is on the box's border,
_STEP_ACROSS = 2 * MOST  # row: and how far the next nodes are
_STEP_ALONG = 3 * MOST  # row
_WITHIN = 4 * MOST  # row: numbers of the points in the box
_OUTSIDE = 5 * MOST  # row: and of the others
NUMBERS = 6 * MOST + 1


class NarrowField(NamedTuple):
    """An SDF grid; lengths are in its cells."""

    rows: Any  # (nodes, 4) value and gradient of each node; float32
    values: Any  # (nodes,) value alone; float32
    last: Triple  # the greatest index of a node per axis
    across: int  # steps to the next node on the first axis,
    along: int  # and on the second
    nearest: bool  # read the nearest node, else interpolate
    # of the distance to a surface point beyond the box: 1, or 0 for that to the box
    surface: float
    side: float  # of a cell of the grid that points are given in, in cells of this one,
    margin: float  # and how many of them are around it


class PointBlock(NamedTuple):
    """Scratch of one thread, for S points."""

    # (4, S) points in cells of another grid around, and a number of each; float32
    points: Any
    block: Any  # (BLOCK,) float32
    numbers: Any  # (NUMBERS,) int32
    read: Any  # (4 * 256,) signed distance and gradient of each point of a block; float32


def point_block(size: int) -> PointBlock:
    """Scratch for `size` points."""
    return PointBlock(
        points=np.zeros((4, size + MOST), dtype=np.float32),
        block=np.zeros(BLOCK, dtype=np.float32),
        numbers=np.zeros(NUMBERS, dtype=np.int32),
        read=np.zeros(4 * MOST, dtype=np.float32),
    )


@inner
def read_distances(field, scratch, start, count):
    """Fill the terms of a block with the signed distances at points from `start` on."""
    block, numbers, read = scratch.block, scratch.numbers, scratch.read
    _locate(field, scratch, start, whole_vectors(count))
    within = _split(block, numbers, count)
    _read_within(field, block, numbers, read, within)
    _read_beyond(field, block, numbers, read, count - within)
    _measure(field, block, read, whole_vectors(count))


@inner
def _locate(field, scratch, start, count):
    """Find where the points lie in the grid, or the nearest points of its box."""
    side, margin = np.float32(field.side), np.float32(field.margin)
    points, block, numbers = scratch.points, scratch.block, scratch.numbers
    us, vs, ws = points[0], points[1], points[2]
    p, q, r = field.last
    p, q, r = np.float32(p), np.float32(q), np.float32(r)
    zero, one, nearest = np.float32(0.0), np.float32(1.0), field.nearest
    across, along = np.int32(field.across), np.int32(field.along)
    for n in range(count):
        at = np.uint64(start) + np.uint64(n)
        x, y, z = us[at], vs[at], ws[at]
        x, y, z = (x - margin) * side, (y - margin) * side, (z - margin) * side
        u, v, w = min(max(zero, x), p), min(max(zero, y), q), min(max(zero, z), r)
        x, y, z = x - u, y - v, z - w
        block[_GAP + n], block[_GAP + MOST + n], block[_GAP + 2 * MOST + n] = x, y, z
        u = np.rint(u) if nearest else u
        v = np.rint(v) if nearest else v
        w = np.rint(w) if nearest else w
        i, j, k = min(np.floor(u), p - one), min(np.floor(v), q - one), min(np.floor(w), r - one)
        u, v, w = u - i, v - j, w - k
        block[_SHARE + n], block[_SHARE + MOST + n], block[_SHARE + 2 * MOST + n] = u, v, w
        cell = np.int32(np.int32(i) * across) + np.int32(np.int32(j) * along) + np.int32(k)
        numbers[_CELL + n] = cell
        # A coordinate that is not in the box is 0 or 1 cells from the lowest node.
        first, second = x != zero, y != zero
        upper = np.int32(np.int32(v) * along) if second else np.int32(w)
        upper = np.int32(np.int32(u) * across) if first else upper
        numbers[_CORNER + n] = cell + upper
        numbers[_STEP_ACROSS + n] = along if first else across
        numbers[_STEP_ALONG + n] = np.int32(1) if first | second else along
        block[_ACROSS + n] = v if first else u
        block[_ALONG + n] = w if first | second else v
        block[_BEYOND + n] = one if first | second | (z != zero) else zero


@inner
def _split(block, numbers, count):
    """Number the points in the box and those beyond it; returns how many are in it."""
    within, outside = np.uint64(_WITHIN), np.uint64(_OUTSIDE)
    for n in range(count):
        numbers[within] = numbers[outside] = n
        is_beyond = block[_BEYOND + n] > np.float32(0.0)
        outside += np.uint64(is_beyond)
        within += np.uint64(not is_beyond)
    return np.int64(within) - _WITHIN


@inner
def _read_within(field, block, numbers, read, count):
    """Read the distance between the nodes around the points in the box."""
    values, one = field.values, np.uint64(1)
    across, along = np.uint64(field.across), np.uint64(field.along)
    for i in range(count):
        n = np.uint64(numbers[_WITHIN + i])
        at = np.uint64(numbers[np.uint64(_CELL) + n])
        u, v = block[np.uint64(_SHARE) + n], block[np.uint64(_SHARE + MOST) + n]
        w = block[np.uint64(_SHARE + 2 * MOST) + n]
        a = _between(values[at], values[at + one], w)
        b = _between(values[at + along], values[at + along + one], w)
        at += across
        c = _between(values[at], values[at + one], w)
        d = _between(values[at + along], values[at + along + one], w)
        read[np.uint64(4) * n] = _between(_between(a, b, v), _between(c, d, v), u)


@inner
def _read_beyond(field, block, numbers, read, count):
    """Read distance and gradient between the four nodes around the nearest points of the box."""
    rows = field.rows
    for i in range(count):
        n = np.uint64(numbers[_OUTSIDE + i])
        at = np.uint64(numbers[np.uint64(_CORNER) + n])
        across = np.uint64(numbers[np.uint64(_STEP_ACROSS) + n])
        along = np.uint64(numbers[np.uint64(_STEP_ALONG) + n])
        u, v = block[np.uint64(_ACROSS) + n], block[np.uint64(_ALONG) + n]
        near = _rows_between(rows, at, at + along, v)
        far = _rows_between(rows, at + across, at + across + along, v)
        at = np.uint64(4) * n
        read[at] = _between(near[0], far[0], u)
        read[at + np.uint64(1)] = _between(near[1], far[1], u)
        read[at + np.uint64(2)] = _between(near[2], far[2], u)
        read[at + np.uint64(3)] = _between(near[3], far[3], u)


@leaf
def _between(near, far, share):
    return near + share * (far - near)


@leaf
def _rows_between(rows, near, far, share):
    a, b = (
        _between(rows[near, 0], rows[far, 0], share),
        _between(rows[near, 1], rows[far, 1], share),
    )
    c, d = (
        _between(rows[near, 2], rows[far, 2], share),
        _between(rows[near, 3], rows[far, 3], share),
    )
    return a, b, c, d


@inner
def _measure(field, block, read, count):
    """Fill the terms: what is read in the box, else the distance to the surface point."""
    surface, shortest, zero = np.float32(field.surface), np.float32(1e-12), np.float32(0.0)
    for n in range(count):
        s, x, y, z = read[4 * n], read[4 * n + 1], read[4 * n + 2], read[4 * n + 3]
        scale = surface * s / max(np.sqrt(x * x + y * y + z * z), shortest)
        x = block[_GAP + n] + scale * x
        y = block[_GAP + MOST + n] + scale * y
        z = block[_GAP + 2 * MOST + n] + scale * z
        away = np.sqrt(x * x + y * y + z * z)
        block[TERM + n] = away if block[_BEYOND + n] > zero else s


@inner
def sum_of_terms(block, count):
    """The sum of the terms of the first `count` points: of each eighth, then of these eight."""
    whole = whole_vectors(count)
    for n in range(np.uint64(count), np.uint64(whole)):
        block[np.uint64(TERM) + n] = np.float32(0.0)
    for first in range(8, whole, 8):
        for lane in range(8):
            block[TERM + lane] += block[TERM + first + lane]
    total = 0.0
    for lane in range(8):
        total += np.float64(block[TERM + lane])
    return total


@leaf
def whole_vectors(count):
    """A number rounded up to whole vectors, which read what is left of another block besides."""
    return (count + 7) // 8 * 8
