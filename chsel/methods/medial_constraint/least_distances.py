"""What the signed distance is at least in the cells of a grid that reaches beyond an SDF's box.

A ball that is no larger than that in the cell of its centre does not touch the object. One lookup
of 8 bits sorts out most balls.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import triple
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.pose_tuples import Triple
from chsel.problem.sdf_grid import SdfGrid

ASTRAY = 1e-4  # cells that a point may be away from where it was looked up, at most
_MOST_CELLS = 3_000_000
_STEPS = 254  # of the reach
_REACH_STEP = 8  # the reach is rounded up to so many cells


class LeastDistances(NamedTuple):
    """Lower bounds of the distance that a grid reads, of cells within a box."""

    first: Triple  # corner of the first cell, object frame, metres
    inverse: float  # cells per metre
    most: Triple  # the greatest index of a cell per axis
    across: int  # steps in the table to the next cell on the first axis,
    along: int  # and on the second
    step: float  # metres
    steps: Any  # (cells,) whole steps, 0 for any below 1; of the outermost also beyond them; uint8


def least_distances(sdf: SdfGrid, outside: str, reach: float) -> LeastDistances:
    """Bounds up to `reach` metres beyond the box of a grid, whichever way it is looked up."""
    stride, pad = _sizes(sdf, reach)
    key = "least distances", outside, stride, pad
    return sdf.derived(key, lambda: _made(sdf, outside, stride, pad))


def _sizes(sdf: SdfGrid, reach: float) -> tuple[int, int]:
    """How many cells of an SDF grid make one along each side, and how many of these lie around."""
    stride = 1
    while True:
        pad = -(-math.ceil(reach / (stride * sdf.resolution) + 1.0) // _REACH_STEP) * _REACH_STEP
        if math.prod(_shape(sdf, stride, pad)) <= _MOST_CELLS:
            return stride, pad
        stride *= 2


def _shape(sdf: SdfGrid, stride: int, pad: int) -> list[int]:
    return [-(-(int(count) - 1) // stride) + 2 * pad for count in sdf.shape]


def _made(sdf: SdfGrid, outside: str, stride: int, pad: int) -> LeastDistances:
    shape, size = _shape(sdf, stride, pad), stride * sdf.resolution
    bounds = np.empty(shape)
    counts = [int(count) for count in sdf.shape]
    grid = Nodes(sdf.table, counts[0], counts[1], counts[2], sdf.resolution)
    _fill(grid, stride, pad, outside == "bounding_box", bounds)
    # A point that is looked up in the neighbouring cell, as numbers of 32 bits are rounded, reads
    # its own cell's nodes with a weight of three times as many cells at most. Twice as much is
    # what a direction between nodes can turn by, of a distance no greater than the greatest.
    greatest = float(np.abs(sdf.values).max()) + size
    bounds -= 1e-9 + 16.0 * ASTRAY * stride * greatest
    _, ny, nz = shape
    step = pad * size / _STEPS
    return LeastDistances(
        first=triple(sdf.origin - pad * size),
        inverse=1.0 / size,
        most=triple(np.array(shape) - 1.0),
        across=ny * nz,
        along=nz,
        step=step,
        steps=np.clip(np.floor(bounds / step), 0.0, 255.0).astype(np.uint8).reshape(-1),
    )


class Nodes(NamedTuple):
    """The nodes of an SDF grid."""

    table: FloatArray  # (nodes, 4), value and gradient
    nx: int
    ny: int
    nz: int
    spacing: float  # metres


class _Side(NamedTuple):
    """A cell along one axis."""

    low: int  # the nodes that its points read, clamped to the grid's box
    high: int
    near: float  # how far the cell lies beyond the box, with a sign, metres: from here
    far: float  # to here


@leaf
def _side(cell: int, stride: int, count: int, spacing: float) -> _Side:
    """The side of a cell that starts `cell` cells after the first node of `count`."""
    last, low, high = count - 1, cell * stride, (cell + 1) * stride
    near, far = min(low, 0), min(high, 0)
    if high > last:
        near, far = max(low - last, 0), high - last
    low, high = min(max(low, 0), last), min(max(high, 0), last)
    return _Side(low, high, near * spacing, far * spacing)


@compiled
def _fill(nodes: Nodes, stride: int, pad: int, box_distance: bool, out: FloatArray) -> None:
    """Fill out (cells) with lower bounds; cells of `stride` nodes along each side.

    Beyond the outermost cells, all is at least as far from the box as they are.
    """
    for i in range(out.shape[0]):
        x = _side(i - pad, stride, nodes.nx, nodes.spacing)
        for j in range(out.shape[1]):
            y = _side(j - pad, stride, nodes.ny, nodes.spacing)
            for k in range(out.shape[2]):
                z = _side(k - pad, stride, nodes.nz, nodes.spacing)
                outermost = i == 0 or j == 0 or k == 0 or i == out.shape[0] - 1
                outermost = outermost or j == out.shape[1] - 1 or k == out.shape[2] - 1
                out[i, j, k] = _least(nodes, x, y, z, box_distance or outermost)


@inner
def _least(nodes: Nodes, x: _Side, y: _Side, z: _Side, by_box: bool) -> float:
    """A lower bound of the distance in a cell of sides x, y, z.

    In the grid's box, the distance is a mean of nodes' values. Beyond, it is |a + s n|, of the way
    a out of the box and of means s and n / |n| over nodes at the box's border: with any unit
    vector d at least d . a + s d . n / |n|. Or at least |a|, as a ball that is no larger does not
    count, whatever is read there. by_box: only this.
    """
    a, b, c = _nearest(x), _nearest(y), _nearest(z)
    away = np.sqrt(a * a + b * b + c * c)
    low, high = np.inf, -np.inf
    s = p = q = r = longest = 0.0
    table = nodes.table
    for i in range(x.low, x.high + 1):
        for j in range(y.low, y.high + 1):
            for k in range(z.low, z.high + 1):
                at = (i * nodes.ny + j) * nodes.nz + k
                value, u, v, w = table[at, 0], table[at, 1], table[at, 2], table[at, 3]
                low, high = min(low, value), max(high, value)
                s, p, q, r = s + value, p + u, q + v, r + w
                longest = max(longest, u * u + v * v + w * w)
    if x.near == x.far and y.near == y.far and z.near == z.far:
        return low
    if by_box:
        return away
    count = (x.high - x.low + 1) * (y.high - y.low + 1) * (z.high - z.low + 1)
    s /= count * max(np.sqrt(p * p + q * q + r * r), 1e-12)
    a, b, c = 0.5 * (x.near + x.far), 0.5 * (y.near + y.far), 0.5 * (z.near + z.far)
    a, b, c = a + s * p, b + s * q, c + s * r
    length = max(np.sqrt(a * a + b * b + c * c), 1e-12)
    a, b, c = a / length, b / length, c / length
    along = np.inf
    for i in range(x.low, x.high + 1):
        for j in range(y.low, y.high + 1):
            for k in range(z.low, z.high + 1):
                at = (i * nodes.ny + j) * nodes.nz + k
                along = min(along, a * table[at, 1] + b * table[at, 2] + c * table[at, 3])
    if low >= 0.0 and along >= 0.0:
        least = low * along / max(np.sqrt(longest), 1e-12)
    else:
        least = -max(abs(low), abs(high))
    least += min(a * x.near, a * x.far) + min(b * y.near, b * y.far) + min(c * z.near, c * z.far)
    return max(least, away) if away > 0.0 else least


@leaf
def _nearest(side: _Side) -> float:
    """How far a side is from the box."""
    return min(abs(side.near), abs(side.far))
