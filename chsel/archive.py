"""The grid archive of quality-diversity search (CHSEL, Sec. IV-C)."""

from __future__ import annotations

import numpy as np

from chsel.arrays import FloatArray, IntArray
from chsel.measures import Measure
from chsel.problem import ArchiveSnapshot

_ROUNDING = 1e-6  # of a cell: a measure on a border belongs to the cell above it


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
        self._objectives = np.full(cells, -np.inf)
        self._solutions = np.zeros((cells, dimension))
        self._measures = np.zeros((cells, measure.count))

    def cells_of(self, measures: FloatArray) -> IntArray:
        """Row-major index (B,) of the cell of measures (B, k), last measure fastest."""
        bins = np.array(self.shape)
        inside = self.measure.unwrapped(measures, (self.lower + self.upper) / 2.0)
        index = (bins * (inside - self.lower) + _ROUNDING) / (self.upper - self.lower)
        index = np.trunc(np.clip(index, 0, bins - 1)).astype(np.int64)
        return np.asarray(np.ravel_multi_index(tuple(index.T), self.shape), dtype=np.int64)

    def add(
        self, solutions: FloatArray, objectives: FloatArray, measures: FloatArray
    ) -> tuple[IntArray, FloatArray]:
        """Offer solutions (B, d) with objectives (B,) and measures (B, k).

        Status (B,): 2 for a cell that was empty, 1 for a better objective, 0 for neither, all
        against the archive before this batch. Value (B,): the objective for status 2, else its
        gain over the cell's. Of a batch, each cell keeps the highest, the first on a tie.
        """
        cells = self.cells_of(measures)
        old = self._objectives[cells]
        empty = np.isneginf(old)
        status = np.where(objectives > old, np.where(empty, 2, 1), 0)
        value = np.where(empty, objectives, objectives - np.where(empty, 0.0, old))
        for i in np.flatnonzero(status):
            if objectives[i] > self._objectives[cells[i]]:
                self._objectives[cells[i]] = objectives[i]
                self._solutions[cells[i]] = solutions[i]
                self._measures[cells[i]] = measures[i]
        return status, value

    @property
    def occupied(self) -> IntArray:
        """Indices (C,) of the cells that hold a solution, ascending."""
        return np.flatnonzero(~np.isneginf(self._objectives))

    @property
    def solutions(self) -> FloatArray:
        """Solutions (C, d) of the occupied cells."""
        return self._solutions[self.occupied]

    @property
    def costs(self) -> FloatArray:
        """Costs (C,) of the occupied cells."""
        return -self._objectives[self.occupied]

    @property
    def best_solution(self) -> FloatArray:
        """The solution (d,) of lowest cost."""
        return self._solutions[int(np.argmax(self._objectives))]

    def sample_elite(self, uniform: float) -> FloatArray:
        """The solution (d,) of one occupied cell, chosen by a number from [0, 1)."""
        occupied = self.occupied
        return self._solutions[occupied[int(uniform * len(occupied))]]

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
            solutions=self._solutions[cells],
            objectives=self._objectives[cells],
            measures=self._measures[cells],
        )
