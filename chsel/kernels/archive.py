"""Insertion into the grid archive of quality-diversity search, and the ranking of a batch."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.arrays import FloatArray, IntArray
from chsel.kernels.compiler import compiled, inner

_ROUNDING = 1e-6  # of a cell: a measure on a border belongs to the cell above it
_TURN = 2.0 * np.pi


class Cells(NamedTuple):
    """The cells of a grid over k measures, `bins` along each, row-major, last measure fastest.

    lower, upper (k,): the grid's range. circular: the measures are angles. objectives (cells,):
    -inf where a cell is empty. solutions (cells, d). measures (cells, k).
    """

    lower: FloatArray
    upper: FloatArray
    bins: int
    circular: bool
    objectives: FloatArray
    solutions: FloatArray
    measures: FloatArray


class Batch(NamedTuple):
    """Solutions that are offered to an archive at once, and what becomes of them.

    vectors (B, d), objectives (B,) and measures (B, k) go in; cells (B,), status (B,), value (B,)
    and order (B,), best first, come out.
    """

    vectors: FloatArray
    objectives: FloatArray
    measures: FloatArray
    cells: IntArray
    status: IntArray
    value: FloatArray
    order: IntArray


def batch_of(count: int, dimension: int, measures: int) -> Batch:
    """Room for `count` solutions of `dimension` numbers with so many measures."""
    return Batch(
        vectors=np.zeros((count, dimension)),
        objectives=np.full(count, -np.inf),
        measures=np.zeros((count, measures)),
        cells=np.full(count, -1),
        status=np.zeros(count, dtype=np.int64),
        value=np.full(count, -np.inf),
        order=np.arange(count),
    )


@inner
def all_finite(vector: FloatArray) -> bool:
    """Whether a vector holds neither infinity nor NaN."""
    finite = True
    for x in vector:
        finite &= np.isfinite(x)
    return finite


@inner
def cell_of(
    lower: FloatArray, upper: FloatArray, bins: int, circular: bool, measures: FloatArray
) -> int:
    """Index of the cell of finite measures (k,); the nearest one for measures out of range."""
    cell = 0
    for i in range(len(measures)):
        x = measures[i]
        if circular:
            x -= _TURN * np.rint((x - (lower[i] + upper[i]) / 2.0) / _TURN)
        index = (bins * (x - lower[i]) + _ROUNDING) / (upper[i] - lower[i])
        if not index > 0.0:  # written so that NaN, of an endless range, is below too
            index = 0.0
        cell = cell * bins + int(min(index, bins - 1.0))
    return cell


@compiled
def cells_of(archive: Cells, measures: FloatArray, cells: IntArray) -> None:
    """Fill cells (B,) for measures (B, k); -1 for measures that are not finite."""
    for i in range(len(cells)):
        cells[i] = cell_for(archive, 0.0, measures[i], measures[i])


@inner
def cell_for(archive: Cells, objective: float, vector: FloatArray, measures: FloatArray) -> int:
    """The cell of a solution; -1 if any of its numbers is not finite, which no cell may hold."""
    if np.isfinite(objective) and all_finite(measures) and all_finite(vector):
        return cell_of(archive.lower, archive.upper, archive.bins, archive.circular, measures)
    return -1


@inner
def keep_better(
    archive: Cells, cell: int, objective: float, vector: FloatArray, measures: FloatArray
) -> None:
    """Put a solution into its cell if its objective is higher."""
    if cell < 0 or objective <= archive.objectives[cell]:
        return
    archive.objectives[cell] = objective
    for j in range(len(vector)):
        archive.solutions[cell, j] = vector[j]
    for j in range(len(measures)):
        archive.measures[cell, j] = measures[j]


@compiled
def insert(archive: Cells, batch: Batch) -> None:
    """Offer a batch: status and value against the archive before it, then each cell's highest.

    Status 2 for a cell that was empty, 1 for a better objective, 0 for neither. Value: the
    objective where the cell was empty, else its gain over the cell's. Of a batch, each cell keeps
    the first of the highest. A solution of which any number is not finite is refused: cell -1,
    status 0, value -inf.
    """
    vectors, objectives, measures = batch.vectors, batch.objectives, batch.measures
    cells, status, value = batch.cells, batch.status, batch.value
    for i in range(len(objectives)):
        cells[i] = cell_for(archive, objectives[i], vectors[i], measures[i])
        status[i], value[i] = 0, -np.inf
        if cells[i] < 0:
            continue
        old = archive.objectives[cells[i]]
        if old == -np.inf:
            status[i], value[i] = 2, objectives[i]
        else:
            status[i], value[i] = int(objectives[i] > old), objectives[i] - old
    for i in range(len(objectives)):
        keep_better(archive, cells[i], objectives[i], vectors[i], measures[i])


@inner
def _precedes(status: IntArray, value: FloatArray, i: int, j: int) -> bool:
    if status[i] != status[j]:
        return status[i] > status[j]
    if value[i] != value[j]:
        return value[i] > value[j]
    return i > j


@inner
def rank(status: IntArray, value: FloatArray, order: IntArray) -> int:
    """Fill the order (B,): by status, then by value; ties the later first. How many improved.

    By Shell's sort: no two rank alike, so that any way of sorting gives one order.
    """
    count, improved = len(order), 0
    for i in range(count):
        order[i] = i
        improved += int(status[i] > 0)
    gap = count // 2
    while gap > 0:
        for i in range(gap, count):
            item, place = order[i], i
            while place >= gap and _precedes(status, value, item, order[place - gap]):
                order[place] = order[place - gap]
                place -= gap
            order[place] = item
        gap //= 2
    return improved


@inner
def sampled_cell(objectives: FloatArray, uniform: float) -> int:
    """A cell of objectives (cells,) that is occupied, chosen by a number from [0, 1), or -1."""
    occupied = 0
    for objective in objectives:
        occupied += int(objective > -np.inf)
    left = int(uniform * occupied)
    for cell in range(len(objectives)):
        if objectives[cell] > -np.inf:
            if left == 0:
                return cell
            left -= 1
    return -1
