"""Grids of cells: which cell a point lies in, and how far cells are from a set of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.numerics.clearance import squared_clearances, squared_gaps
from chsel.numerics.compiler import inner, leaf


class Box(NamedTuple):
    """The nodes of a grid and the cells of its points, in numbers alone."""

    first: tuple[float, float, float]  # corner nodes, metres
    last: tuple[float, float, float]
    inverse: float  # nodes per metre
    between: float  # 0: cells lie around nodes; 1: between nodes, numbered by their lowest node
    most: tuple[float, float, float]  # the greatest index of a cell per axis
    across: float  # steps in a flat array to the next node on the first axis,
    along: float  # and on the second


class Region(NamedTuple):
    """A set of grid cells, and how far every other cell is from it."""

    box: Box
    clearance: Any  # (nodes,) -1 in the set, else at most the squared distance to it, m^2; float32


class CellSet(NamedTuple):
    """A set of grid cells in a small table: which cells it has, and how far others are from it.

    Distances are those between cells as boxes, in sides of a cell: 0 for neighbours, too.
    """

    box: Box
    # (nodes + 2,) 0 in the set, else 1 + the squared distance to it, see squared_gaps; then 0 for
    # points that may be in the set, and 255 for none; uint8
    steps: Any


def box_of(
    first: FloatArray, resolution: float, shape: Sequence[int], *, between: bool = False
) -> Box:
    """The box of a grid of nodes (nx, ny, nz) whose first node is at `first` (3,)."""
    x, y, z = (int(count) for count in shape)
    last = first + (np.array([x, y, z]) - 1) * resolution
    most = triple(np.array([x, y, z]) - (2 if between else 1))
    down = 1.0 if between else 0.0
    return Box(triple(first), triple(last), 1.0 / resolution, down, most, float(y * z), float(z))


def triple(values: Sequence[float] | FloatArray) -> tuple[float, float, float]:
    """Three numbers as a tuple, which kernels pass on at no cost."""
    x, y, z = (float(value) for value in values)
    return x, y, z


def clearance_of(cells: BoolArray, resolution: float) -> Any:
    """Squared distances of grid cells (nx, ny, nz) to the set ones: Region.clearance."""
    if not cells.any():
        return np.full(cells.size, np.inf, dtype=np.float32)
    halves = np.empty(cells.shape, dtype=np.int64)  # squared distances between cells as boxes
    squared_clearances(~cells, halves, 2)
    distance = np.sqrt(halves.astype(np.float64)) / 2.0 * resolution
    squared = (distance * (1.0 - 1e-6)) ** 2
    squared[cells] = -1.0
    return squared.astype(np.float32).reshape(-1)


def cell_set_of(box: Box, cells: BoolArray) -> CellSet:
    """The set of the flagged cells (nx, ny, nz) of a box."""
    gaps = np.empty(cells.shape, dtype=np.uint8)
    squared_gaps(~cells, gaps)
    steps = np.empty(cells.size + 2, dtype=np.uint8)
    steps[:-2] = gaps.reshape(-1) + np.uint8(1)
    steps[:-2][cells.reshape(-1)] = 0
    steps[-2:] = 0, 255
    return CellSet(box, steps)


class Places(NamedTuple):
    """Where S points lie in a grid: scratch of one thread."""

    beyond: FloatArray  # (S,) squared distance to the grid's box, m^2
    cell: Any  # (S,) flat index of the cell, int32
    u: FloatArray  # (S,) from the cell's node to the point, clamped to the box, in cells
    v: FloatArray
    w: FloatArray


def places_for(size: int) -> Places:
    """Scratch for `size` points."""
    u, v, w = (np.empty(size) for _ in range(3))
    return Places(np.empty(size), np.empty(size, dtype=np.int32), u, v, w)


@inner
def locate(move, box, x, y, z, places, count):
    """Fill the places of the first `count` points x, y, z moved by `move`; vectorised."""
    first, last, most, inverse = box.first, box.last, box.most, box.inverse
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
        u[n], v[n], w[n] = a - d, b - e, c - f
        cell[n] = np.int32(d * box.across + e * box.along + f)


@leaf
def node_of(g, between, most):
    """The node of the cell that holds a grid coordinate: the nearest, or the one below."""
    nearest = np.rint(g)
    below = nearest - between
    return min(below if nearest > g else nearest, most)
