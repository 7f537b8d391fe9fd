"""The grid archive of quality-diversity search (CHSEL, Sec. IV-C)."""

from __future__ import annotations

import numpy as np

from chsel.arrays import FloatArray, IntArray
from chsel.errors import ChselError
from chsel.kernels.archive import Cells, batch_of, cells_of, insert
from chsel.measures import Measure
from chsel.problem import ArchiveSnapshot


class GridArchive:
    """Keeps in every cell of a measure grid the solution with the highest objective.

    Objectives are minus costs. Solutions outside of the range go to the cells at its edge.
    """

    def __init__(
        self,
        measure: Measure,
        lower: FloatArray,
        upper: FloatArray,
        *,
        bins: int,
        dimension: int,
    ) -> None:
        self.measure = measure
        self.shape = (bins,) * measure.count
        self.lower, self.upper = lower, upper
        cells = bins**measure.count
        self.cells = Cells(
            lower=np.array(lower, dtype=np.float64),
            upper=np.array(upper, dtype=np.float64),
            bins=int(bins),
            circular=measure.circular,
            objectives=np.full(cells, -np.inf),
            solutions=np.zeros((cells, dimension)),
            measures=np.zeros((cells, measure.count)),
        )

    def cells_of(self, measures: FloatArray) -> IntArray:
        """Row-major index (B,) of the cell of measures (B, k), last measure fastest.

        -1 for measures that are not finite.
        """
        cells = np.zeros(len(measures), dtype=np.int64)
        cells_of(self.cells, np.array(measures, dtype=np.float64, order="C"), cells)
        return cells

    def add(
        self, solutions: FloatArray, objectives: FloatArray, measures: FloatArray
    ) -> tuple[IntArray, FloatArray]:
        """Offer solutions (B, d) with objectives (B,) and measures (B, k).

        Status (B,): 2 for a cell that was empty, 1 for a better objective, 0 for neither, all
        against the archive before this batch. Value (B,): the objective where the cell was empty,
        else its gain over the cell's. Of a batch, each cell keeps the highest, the first on a
        tie. A solution of which any number is not finite is refused: status 0, value -inf.
        """
        batch = batch_of(len(solutions), self.cells.solutions.shape[1], self.measure.count)
        batch.vectors[:], batch.objectives[:], batch.measures[:] = solutions, objectives, measures
        insert(self.cells, batch)
        return batch.status, batch.value

    @property
    def occupied(self) -> IntArray:
        """Indices (C,) of the cells that hold a solution, ascending."""
        return np.flatnonzero(~np.isneginf(self.cells.objectives))

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
        """A copy of the occupied cells."""
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
