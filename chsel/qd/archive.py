"""The grid archive of quality-diversity search (CHSEL, Sec. IV-C)."""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Protocol

import numpy as np

from chsel.errors import ChselError
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.compiler import compiled, inner
from chsel.numerics.pose_tuples import all_finite
from chsel.problem.registration_problem import ArchiveSnapshot
from chsel.problem.search_space import SearchSpace
from chsel.qd.measures import Measure

_ROUNDING = 1e-6  # of a cell: a measure on a border belongs to the cell above it
_TURN = 2.0 * np.pi


class SearchObjective(Protocol):
    """A cost of search vectors: what searches lower, and hypotheses are ranked by."""

    space: SearchSpace
    model: Any  # of the cost, and
    space_arrays: Any  # of the space, as the kernels take them

    def work(self) -> Any:
        """Return scratch for one thread."""

    def costs(self, vectors: FloatArray) -> FloatArray:
        """Return costs (B,) of vectors (B, d)."""


class Evaluated(NamedTuple):
    """Search vectors with their costs and measures."""

    vectors: FloatArray  # (B, d)
    costs: FloatArray  # (B,)
    measures: FloatArray  # (B, k)


def evaluated(
    objective: SearchObjective, measure: Measure, *, vectors: FloatArray, costs: Any = None
) -> Evaluated:
    """Return vectors (B, d) with their measures, and their costs (B,) unless known already."""
    costs = objective.costs(vectors) if costs is None else costs
    return Evaluated(vectors, costs, measures=measure.values(objective.space, vectors))


class Cells(NamedTuple):
    """The cells of a grid over k measures, row-major, last measure fastest."""

    lower: FloatArray  # (k,), of the grid's range
    upper: FloatArray  # (k,)
    bins: int  # along each measure
    circular: bool  # the measures are angles
    objectives: FloatArray  # (cells,), -inf where a cell is empty
    solutions: FloatArray  # (cells, d)
    measures: FloatArray  # (cells, k)


class Batch(NamedTuple):
    """Solutions that are offered to an archive at once, and what becomes of them."""

    vectors: FloatArray  # (B, d)
    objectives: FloatArray  # (B,)
    measures: FloatArray  # (B, k)
    cells: IntArray  # (B,), filled by `insert`, -1 for refused ones
    status: IntArray  # (B,), filled by `insert`
    value: FloatArray  # (B,), filled by `insert`
    order: IntArray  # (B,), filled by `rank`, best first


def batch_of(count: int, dimension: int, *, measures: int) -> Batch:
    """Return an empty batch of `count` solutions of `dimension` numbers."""
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
def cell_for(archive: Cells, objective: float, vector: FloatArray, measures: FloatArray) -> int:
    """Return the cell of a solution, the nearest one for measures (k,) out of range; -1 if NaN."""
    if not (np.isfinite(objective) and all_finite(measures) and all_finite(vector)):
        return -1
    lower = archive.lower
    upper = archive.upper
    bins = archive.bins
    cell = 0
    for i in range(len(measures)):
        x = measures[i]
        if archive.circular:
            x -= _TURN * np.rint((x - (lower[i] + upper[i]) / 2.0) / _TURN)
        index = (bins * (x - lower[i]) + _ROUNDING) / (upper[i] - lower[i])
        if not index > 0.0:  # NaN, of an endless range, too
            index = 0.0
        cell = cell * bins + int(min(index, bins - 1.0))
    return cell


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
    """Offer a batch; fills its cells, status and value, see GridArchive.add."""
    vectors = batch.vectors
    objectives = batch.objectives
    measures = batch.measures
    cells = batch.cells
    status = batch.status
    value = batch.value
    for i in range(len(objectives)):
        cells[i] = cell_for(archive, objectives[i], vectors[i], measures[i])
        old = archive.objectives[cells[i]]
        if cells[i] < 0:
            status[i], value[i] = 0, -np.inf
        elif old == -np.inf:
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
    """Fill the order (B,): by status, by value, the later first. Returns how many improved."""
    count, improved = len(order), 0
    for i in range(count):
        order[i] = i
        improved += int(status[i] > 0)
    gap = count // 2  # Shell's sort; the order is total, so that all algorithms give the same
    while gap > 0:
        for i in range(gap, count):
            item, at = order[i], i
            while at >= gap and _precedes(status, value, item, order[at - gap]):
                order[at] = order[at - gap]
                at -= gap
            order[at] = item
        gap //= 2
    return improved


@inner
def sampled_cell(objectives: FloatArray, uniform: float) -> int:
    """Return an occupied cell of objectives (cells,) by a number from [0, 1); -1 if none is."""
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


class GridArchive:
    """Keeps in every cell of a measure grid the solution with the highest objective.

    Objectives are minus costs. Solutions outside of the range go to the cells at its edge.
    """

    def __init__(
        self, measure: Measure, lower: FloatArray, *, upper: FloatArray, bins: int, dimension: int
    ) -> None:
        self.measure = measure
        self.shape = (bins,) * measure.count
        self.lower, self.upper = lower, upper
        cells = math.prod(self.shape)
        self.cells = Cells(
            lower=np.array(lower, dtype=np.float64),
            upper=np.array(upper, dtype=np.float64),
            bins=int(bins),
            circular=measure.circular,
            objectives=np.full(cells, -np.inf),
            solutions=np.zeros((cells, dimension)),
            measures=np.zeros((cells, measure.count)),
        )

    def add(self, solutions: FloatArray, objectives: FloatArray, *, measures: FloatArray) -> Batch:
        """Offer solutions (B, d) with objectives (B,) and measures (B, k).

        Status and value against the archive before: 2 and the objective for an empty cell, 1 for a
        higher objective and 0 for a lower one, and the gain. A cell keeps the highest, the first of
        equals. A solution of which any number is not finite is refused: cell -1, 0 and -inf.
        """
        batch = batch_of(len(solutions), self.cells.solutions.shape[1], measures=self.measure.count)
        batch.vectors[:] = solutions
        batch.objectives[:] = objectives
        batch.measures[:] = measures
        insert(self.cells, batch)
        return batch

    def update_cells(self, *offered: Evaluated) -> None:
        """Offer one batch of solutions after the other (CHSEL, Alg. 1, line 5)."""
        for batch in offered:
            self.add(batch.vectors, -batch.costs, measures=batch.measures)

    @property
    def occupied(self) -> IntArray:
        """Indices (C,) of the cells that hold a solution, ascending."""
        return np.flatnonzero(self.cells.objectives != -np.inf)

    @property
    def solutions(self) -> FloatArray:
        """Solutions (C, d) of the occupied cells."""
        return self.cells.solutions[self.occupied]

    @property
    def costs(self) -> FloatArray:
        """Costs (C,) of the occupied cells."""
        return -self.cells.objectives[self.occupied]

    @property
    def best_solution(self) -> FloatArray:
        """The solution (d,) of lowest cost. Raises ChselError if the archive is empty."""
        if len(self.occupied) == 0:
            raise ChselError(
                "the archive is empty, as no pose that was offered to it has a finite cost; "
                "accepted: points, SDF and scales by which the cost of some pose is finite"
            )
        return self.cells.solutions[int(np.argmax(self.cells.objectives))]

    def snapshot(self, iteration: int, refinement: int) -> ArchiveSnapshot:
        """Return a copy of the occupied cells."""
        cells = self.occupied
        return ArchiveSnapshot(
            iteration=iteration,
            refinement=refinement,
            measure_names=self.measure.axes,
            shape=self.shape,
            lower=self.lower.copy(),
            upper=self.upper.copy(),
            cells=cells,
            solutions=self.cells.solutions[cells],
            objectives=self.cells.objectives[cells],
            measures=self.cells.measures[cells],
        )
