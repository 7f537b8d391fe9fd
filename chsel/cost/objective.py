"""The relaxed cost as a function of search vectors, its gradient, and its descent by Adam."""

from __future__ import annotations

from typing import Any

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_kernels import Model, Work, evaluate, forget, gradient_of, put_pose, work_of
from chsel.cost.free_kernels import MOST_SLACK, SEARCH_SLACK
from chsel.cost.pose_lanes import LANES, SUMS
from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import compiled, implements, leaf, spliced
from chsel.numerics.pose_tuples import all_finite, decode, pull_back
from chsel.numerics.threads import spread
from chsel.problem.search_space import SearchSpace

BETA1, BETA2 = 0.9, 0.999
EPSILON = 1e-8


@leaf
def adam_step(slope, moments, j, powers, rate, epsilon):
    """The step down a slope along coordinate j (Kingma and Ba, 2015); updates moments (2, d).

    powers: beta_1 and beta_2 to the power of the number of steps, this one included.
    """
    moments[0, j] = BETA1 * moments[0, j] + (1.0 - BETA1) * slope
    moments[1, j] = BETA2 * moments[1, j] + (1.0 - BETA2) * slope * slope
    step = rate * (moments[0, j] / (1.0 - powers[0]))
    return step / (np.sqrt(moments[1, j] / (1.0 - powers[1])) + epsilon)


def cost_of(model, space, vector, work):
    """The cost of a search vector (d,), in kernels alone; see who implements it for a model."""
    raise NotImplementedError


def costs_of(model, space, vectors, costs, work):
    """Fill the costs (B,) of search vectors (B, d), likewise; infinite if one is not finite."""
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


@compiled
def descend(model, space, vectors, rate, divisor, iterations, first, last, work):
    """Move search vectors (B, d), from `first` to before `last`, by Adam, LANES at a time.

    divisor: what gradients are divided by.
    """
    dimension = vectors.shape[1]
    gradient, moments = np.empty(dimension), np.empty((LANES, 2, dimension))
    for start in range(first, last, LANES):
        count = min(LANES, last - start)
        moments[:] = 0.0
        power1 = power2 = 1.0
        forget(work)
        for _ in range(iterations):
            for lane in range(count):
                put_pose(work.lanes, lane, decode(space, vectors[start + lane]))
            evaluate(model, work, 0, count, MOST_SLACK)
            power1 *= BETA1
            power2 *= BETA2
            for lane in range(count):
                vector = vectors[start + lane]
                pull_back(space, vector, gradient_of(work.lanes, lane), gradient)
                for j in range(dimension):
                    slope = gradient[j] / divisor
                    step = adam_step(slope, moments[lane], j, (power1, power2), rate, EPSILON)
                    vector[j] -= step


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
        moved = np.array(vectors)

        def run(first: int, last: int, work: Any) -> None:
            space = self.space_arrays
            descend(self.model, space, moved, rate, divisor, iterations, first, last, work)

        spread(run, len(moved), self.work, multiple=LANES)
        return moved
