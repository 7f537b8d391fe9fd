"""The relaxed cost as a function of search vectors: what the optimizers ask."""

from __future__ import annotations

from typing import Any

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.objective_kernels import Work, costs_and_gradients, descend, work_for
from chsel.numerics.arrays import FloatArray
from chsel.numerics.threads import spread
from chsel.problem.search_space import SearchSpace


class Objective:
    """The relaxed cost, and its gradients, over the vectors of a search space."""

    def __init__(self, cost: CompiledCost, space: SearchSpace) -> None:
        self._cost = cost
        self.space = space
        self.model = cost.model
        self.space_arrays = space.arrays

    def work(self) -> Work:
        """Scratch for one thread."""
        return work_for(self.model)

    def costs(self, vectors: FloatArray) -> FloatArray:
        """Costs (B,) of vectors (B, d)."""
        return self._cost.costs(self.space.poses(vectors))

    def costs_and_gradients(self, vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Costs (B,) and the defined gradients (B, d) at vectors (B, d)."""
        costs, gradients = np.empty(len(vectors)), np.empty(vectors.shape)

        def run(first: int, last: int, work: Any) -> None:
            space = self.space_arrays
            costs_and_gradients(self.model, space, vectors, costs, gradients, first, last, work)

        spread(run, len(vectors), self.work)
        return costs, gradients

    def descended(
        self, vectors: FloatArray, divisor: float, rate: float, iterations: int
    ) -> FloatArray:
        """Vectors (B, d) after some iterations of Adam; gradients are divided by `divisor`."""
        moved = np.array(vectors)

        def run(first: int, last: int, work: Any) -> None:
            space = self.space_arrays
            descend(self.model, space, moved, rate, divisor, iterations, first, last, work)

        spread(run, len(moved), self.work)
        return moved
