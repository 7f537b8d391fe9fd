"""The relaxed cost as a function of search vectors, its gradient, and its descent by Adam."""

from __future__ import annotations

from typing import Any

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_kernels import (
    MOST_SLACK,
    Model,
    Neighbours,
    evaluate,
    forget,
    neighbours_of,
)
from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import compiled, implements, leaf, spliced
from chsel.numerics.pose_tuples import decode, pull_back
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


@implements(cost_of, Model)
def _relaxed_cost_of(model, space, vector, near):
    return evaluate(model, decode(space, vector), near, 0.0).cost


@spliced
def cost_and_gradient_of(model, space, vector, gradient, near):
    """The cost of a search vector (d,); fills its gradient (d,)."""
    sums = evaluate(model, decode(space, vector), near, 0.0)
    pull_back(space, vector, sums.by_pose, gradient)
    return sums.cost


@compiled
def costs_and_gradients(model, space, vectors, costs, gradients, first, last, near):
    """Fill costs (B,) and gradients (B, d) at search vectors (B, d), from `first` to `last`."""
    for n in range(first, last):
        costs[n] = cost_and_gradient_of(model, space, vectors[n], gradients[n], near)


@compiled
def descend(model, space, vectors, rate, divisor, iterations, first, last, near):
    """Move search vectors (B, d), from `first` to before `last`, by Adam.

    divisor: what gradients are divided by.
    """
    dimension = vectors.shape[1]
    gradient, moments = np.empty(dimension), np.empty((2, dimension))
    for n in range(first, last):
        vector = vectors[n]
        moments[:] = 0.0
        power1 = power2 = 1.0
        forget(near)
        for _ in range(iterations):
            sums = evaluate(model, decode(space, vector), near, MOST_SLACK)
            pull_back(space, vector, sums.by_pose, gradient)
            power1 *= BETA1
            power2 *= BETA2
            for j in range(dimension):
                slope = gradient[j] / divisor
                vector[j] -= adam_step(slope, moments, j, (power1, power2), rate, EPSILON)


class Objective:
    """The relaxed cost, and its gradients, over the vectors of a search space."""

    def __init__(self, cost: CompiledCost, space: SearchSpace) -> None:
        self._cost = cost
        self.space = space
        self.model = cost.model
        self.space_arrays = space.arrays

    def work(self) -> Neighbours:
        """Scratch for one thread."""
        return neighbours_of(self.model)

    def costs(self, vectors: FloatArray) -> FloatArray:
        """Costs (B,) of vectors (B, d)."""
        return self._cost.costs(self.space.poses(vectors))

    def costs_and_gradients(self, vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Costs (B,) and the defined gradients (B, d) at vectors (B, d)."""
        costs, gradients = np.empty(len(vectors)), np.empty(vectors.shape)

        def run(first: int, last: int, near: Any) -> None:
            space = self.space_arrays
            costs_and_gradients(self.model, space, vectors, costs, gradients, first, last, near)

        spread(run, len(vectors), self.work)
        return costs, gradients

    def descended(
        self, vectors: FloatArray, divisor: float, rate: float, iterations: int
    ) -> FloatArray:
        """Vectors (B, d) after some iterations of Adam; gradients are divided by `divisor`."""
        moved = np.array(vectors)

        def run(first: int, last: int, near: Any) -> None:
            space = self.space_arrays
            descend(self.model, space, moved, rate, divisor, iterations, first, last, near)

        spread(run, len(moved), self.work)
        return moved
