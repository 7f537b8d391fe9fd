"""Grids of cells: which cell a point lies in, and how far cells are from a set of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.arrays import BoolArray, FloatArray, IntArray, read_only
from chsel.numerics.compiler import compiled, inner, leaf

_FAR = 2**60
_MOST_STEPS = 225  # squared sides of a cell: 15, the greatest that a byte holds squared


class Box(NamedTuple):
    """The nodes of a grid and the cells of its points, in numbers alone."""

    first: tuple[float, float, float]  # corner nodes, metres
    last: tuple[float, float, float]  # the last node, metres
    inverse: float  # nodes per metre
    between: float  # 0: cells lie around nodes; 1: between nodes, numbered by their lowest node
    most: tuple[float, float, float]  # the greatest index of a cell per axis
    across: float  # steps in a flat array to the next node on the first axis,
    along: float  # and on the second


class CellSet(NamedTuple):
    """A set of grid cells in a small table: which cells it has, and how far others are from it.

    Distances are those between cells as boxes, in sides of a cell: 0 for neighbours, too.
    """

    box: Box  # of the cells
    # (nodes + 2,) 0 in the set, else 1 + the squared distance to it, at most 226; then 0 for points
    # that may be in the set, and 255 for none; uint8
    steps: Any


def box_of(
    first: FloatArray, resolution: float, *, shape: Sequence[int], between: bool = False
) -> Box:
    """Return the box of a grid of nodes (nx, ny, nz) whose first node is at `first` (3,)."""
    x, y, z = (int(count) for count in shape)
    last = first + (np.array([x, y, z]) - 1) * resolution
    most = triple(np.array([x, y, z]) - (2 if between else 1))
    down = 1.0 if between else 0.0
    return Box(
        triple(first),
        triple(last),
        inverse=1.0 / resolution,
        between=down,
        most=most,
        across=float(y * z),
        along=float(z),
    )


def triple(values: Sequence[float] | FloatArray) -> tuple[float, float, float]:
    """Return three numbers as a tuple, which kernels pass on at no cost."""
    x, y, z = (float(value) for value in values)
    return x, y, z


def cell_set_of(box: Box, cells: BoolArray) -> CellSet:
    """Return the set of the flagged cells (nx, ny, nz) of a box."""
    halves = np.empty(cells.shape, np.int64)
    steps = np.empty(cells.size + 2, dtype=np.uint8)
    squared_clearances(~cells, halves, 2)
    steps[:-2] = np.where(cells, 0, 1 + np.minimum(halves // 4, _MOST_STEPS)).reshape(-1)
    steps[-2:] = 0, 255
    return CellSet(box, steps)


@compiled
def squared_clearances(inside: BoolArray, out: IntArray, gap: int) -> None:
    """Fill out (nx, ny, nz) with squared distances of voxels to the nearest that is not inside.

    Distances are in half sides of a voxel: the least over all voxels w that are not inside of the
    sum over the axes of max(2 |v - w| - gap, 0)^2, computed axis by axis (Felzenszwalb and
    Huttenlocher, 2012). gap: 1 for the distance from the centre of v to the cube w, 2 for that
    between cubes. If all are inside, no distance is less than 2^60.
    """
    flat, flags = out.reshape(-1), inside.reshape(-1)
    for n in range(len(flat)):
        flat[n] = _FAR if flags[n] else 0
    nx, ny, nz = out.shape
    line = np.empty(max(nx, ny, nz), dtype=np.int64)
    _along(flat, nz, 1, line, gap)
    _along(flat, ny, nz, line, gap)
    _along(flat, nx, ny * nz, line, gap)


@inner
def _along(flat: IntArray, count: int, stride: int, line: IntArray, gap: int) -> None:
    """Fill one axis, whose neighbours are `stride` apart in lines of `count` voxels."""
    for block in range(0, len(flat), count * stride):
        for start in range(block, block + stride):
            for k in range(count):
                line[k] = flat[start + k * stride]
            for k in range(count):
                flat[start + k * stride] = _nearest(line, count, k, gap)


@inner
def _nearest(line: IntArray, count: int, k: int, gap: int) -> int:
    """Return the least of line[j] + max(2 |k - j| - gap, 0)^2, going outwards."""
    least, reach = line[k], max(k, count - 1 - k)
    for step in range(1, reach + 1):
        along = (2 * step - gap) * (2 * step - gap)
        if along >= least:
            break
        if step <= k:
            least = min(least, line[k - step] + along)
        if k + step < count:
            least = min(least, line[k + step] + along)
    return least


def bounds_of(points: FloatArray) -> FloatArray:
    """Return the least and the greatest coordinates (2, 3) of points (N, 3), N > 0."""
    bounds = np.empty((2, 3))
    _fill_bounds(read_only(points), bounds)
    return bounds


@compiled
def _fill_bounds(points: FloatArray, bounds: FloatArray) -> None:
    bounds[0], bounds[1] = np.inf, -np.inf
    for n in range(len(points)):
        for axis in range(3):
            bounds[0, axis] = min(bounds[0, axis], points[n, axis])
            bounds[1, axis] = max(bounds[1, axis], points[n, axis])


@compiled
def set_voxels(points: FloatArray, first: FloatArray, side: float, flags: BoolArray) -> None:
    """Set the flags (nx, ny, nz) of the voxels nearest to points (N, 3), ties to even, plus one.

    first (3,): centre of a voxel, which is (1, 1, 1); no point may be further than one beyond.
    """
    for n in range(len(points)):
        i, j, k = voxel_of(first, side, points[n, 0], points[n, 1], points[n, 2])
        flags[int(i) + 1, int(j) + 1, int(k) + 1] = True


def voxels_of(points: FloatArray, first: FloatArray, *, side: float) -> IntArray:
    """Return indices (N, 3) of the voxels nearest to points (N, 3), ties to even.

    first (3,): centre of the voxel 0, 0, 0. side: of voxels, metres.
    """
    return np.rint((points - first) / side).astype(np.int64)


@leaf
def voxel_of(first, side, x, y, z):
    """Return the indices, whole numbers as floats, of the voxel nearest to a point, ties to even.

    The same numbers as of `voxels_of`.
    """
    return (
        np.rint((x - first[0]) / side),
        np.rint((y - first[1]) / side),
        np.rint((z - first[2]) / side),
    )


@leaf
def nearest_node(first, inverse, x, y, z):
    """Return the indices, whole numbers as floats, of the node nearest to a point, ties to even.

    inverse: nodes per metre, as a Box has it; rounding may differ from that of `voxel_of`.
    """
    return (
        np.rint((x - first[0]) * inverse),
        np.rint((y - first[1]) * inverse),
        np.rint((z - first[2]) * inverse),
    )


class Places(NamedTuple):
    """Cells of S points in a grid: scratch of one thread."""

    beyond: FloatArray  # (S,) squared distance to the grid's box, m^2
    cell: Any  # (S,) flat index of the cell, int32
    u: FloatArray  # (S,) from the cell's node to the point, clamped to the box, in cells
    v: FloatArray  # on the second axis
    w: FloatArray  # on the third axis


def places_for(size: int) -> Places:
    """Return scratch for `size` points."""
    u, v, w = (np.empty(size) for _ in range(3))
    return Places(np.empty(size), np.empty(size, dtype=np.int32), u=u, v=v, w=w)


@inner
def locate(move, box, x, y, z, places, count):
    """Fill the places of the first `count` points x, y, z moved by `move`; vectorised."""
    first = box.first
    last = box.last
    most = box.most
    inverse = box.inverse
    beyond, cell = places.beyond, places.cell
    u, v, w = places.u, places.v, places.w
    for n in range(count):
        a = move[0] * x[n] + move[1] * y[n] + move[2] * z[n] + move[9]
        b = move[3] * x[n] + move[4] * y[n] + move[5] * z[n] + move[10]
        c = move[6] * x[n] + move[7] * y[n] + move[8] * z[n] + move[11]
        d = min(max(first[0], a), last[0])  # in this order, NaN ends up in the box
        e = min(max(first[1], b), last[1])
        f = min(max(first[2], c), last[2])
        beyond[n] = (a - d) * (a - d) + (b - e) * (b - e) + (c - f) * (c - f)
        a, b, c = (d - first[0]) * inverse, (e - first[1]) * inverse, (f - first[2]) * inverse
        d = node_of(a, box.between, most[0])
        e = node_of(b, box.between, most[1])
        f = node_of(c, box.between, most[2])
        u[n] = a - d
        v[n] = b - e
        w[n] = c - f
        cell[n] = np.int32(d * box.across + e * box.along + f)


@leaf
def node_of(g, between, most):
    """Return the node of the cell that holds a grid coordinate: the nearest, or the one below."""
    nearest = np.rint(g)
    below = nearest - between
    return min(below if nearest > g else nearest, most)
