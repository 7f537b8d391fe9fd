"""The relaxed cost as a function of search vectors, and its gradient."""

from __future__ import annotations

from typing import Any

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_kernels import Model, Work, evaluate, gradient_of, put_pose, work_of
from chsel.cost.descent import descend
from chsel.cost.free_kernels import SEARCH_SLACK
from chsel.cost.pose_lanes import LANES, SUMS
from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import compiled, implements, spliced
from chsel.numerics.pose_tuples import all_finite, decode, pull_back
from chsel.numerics.threads import spread
from chsel.problem.search_space import SearchSpace


def costs_of(model, space, vectors, costs, work):
    """Fill the costs (B,) of search vectors (B, d), infinite if one is not finite.

    In kernels alone; see who implements it for a model.
    """
    raise NotImplementedError


@implements(costs_of, Model)
def _relaxed_costs_of(model, space, vectors, costs, work):
    for first in range(0, len(vectors), LANES):
        count = min(LANES, len(vectors) - first)
        for lane in range(count):
            vector = vectors[first + lane]
            if all_finite(vector):
                put_pose(work.lanes, lane, decode(space, vector))
            else:
                work.lanes[lane] = np.inf
        evaluate(model, work, 0, count, SEARCH_SLACK)
        for lane in range(count):
            costs[first + lane] = work.lanes[SUMS + lane]


@spliced
def cost_and_gradient_of(model, space, vector, gradient, work):
    """The cost of a search vector (d,); fills its gradient (d,)."""
    put_pose(work.lanes, 0, decode(space, vector))
    evaluate(model, work, 0, 1, SEARCH_SLACK)
    pull_back(space, vector, gradient_of(work.lanes, 0), gradient)
    return work.lanes[SUMS]


@compiled
def costs_and_gradients(model, space, vectors, costs, gradients, first, last, work):
    """Fill costs (B,) and gradients (B, d) at search vectors (B, d), from `first` to `last`."""
    for start in range(first, last, LANES):
        count = min(LANES, last - start)
        for lane in range(count):
            put_pose(work.lanes, lane, decode(space, vectors[start + lane]))
        evaluate(model, work, 0, count, 0.0)
        for lane in range(count):
            costs[start + lane] = work.lanes[SUMS + lane]
            by_pose = gradient_of(work.lanes, lane)
            pull_back(space, vectors[start + lane], by_pose, gradients[start + lane])


class Objective:
    """The relaxed cost, and its gradients, over the vectors of a search space."""

    def __init__(self, cost: CompiledCost, space: SearchSpace) -> None:
        self._cost = cost
        self.space = space
        self.model = cost.model
        self.space_arrays = space.arrays

    def work(self) -> Work:
        """Scratch for one thread."""
        return work_of(self.model)

    def costs(self, vectors: FloatArray) -> FloatArray:
        """Costs (B,) of vectors (B, d)."""
        return self._cost.costs(self.space.poses(vectors))

    def costs_and_gradients(self, vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Costs (B,) and the defined gradients (B, d) at vectors (B, d)."""
        costs, gradients = np.empty(len(vectors)), np.empty(vectors.shape)

        def run(first: int, last: int, work: Any) -> None:
            space = self.space_arrays
            costs_and_gradients(self.model, space, vectors, costs, gradients, first, last, work)

        spread(run, len(vectors), self.work, multiple=LANES)
        return costs, gradients

    def descended(
        self, vectors: FloatArray, divisor: float, rate: float, iterations: int
    ) -> FloatArray:
        """Vectors (B, d) after some iterations of Adam; gradients are divided by `divisor`."""
        return self._descended(vectors, divisor, rate, iterations, ends_on_poses=False)[0]

    def block(
        self, vectors: FloatArray, divisor: float, rate: float, iterations: int
    ) -> tuple[FloatArray, FloatArray]:
        """The same, as vectors of poses again, with their costs (B,)."""
        if not self.space_arrays.planar:
            return self._descended(vectors, divisor, rate, iterations, ends_on_poses=True)
        moved = self.descended(vectors, divisor, rate, iterations)
        moved = self.space.encode(self.space.poses(moved))
        return moved, self.costs(moved)

    def _descended(
        self,
        vectors: FloatArray,
        divisor: float,
        rate: float,
        iterations: int,
        *,
        ends_on_poses: bool,
    ) -> tuple[FloatArray, FloatArray]:
        moved, costs = vectors.copy(), np.empty(len(vectors))
        adam = iterations, float(rate), float(divisor), ends_on_poses

        def run(first: int, last: int, work: Any) -> None:
            descend(self.model, self.space_arrays, moved, costs, *adam, first, last, work)

        spread(run, len(vectors), self.work, multiple=LANES)
        return moved, costs
