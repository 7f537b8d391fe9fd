"""The relaxed cost as a function of search vectors, its gradient, and descents by Adam."""

from __future__ import annotations

from functools import partial

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_kernels import (
    LANES,
    SUMS,
    Model,
    Work,
    evaluate,
    forget,
    gradient_of,
    put_pose,
    work_of,
)
from chsel.cost.free_kernels import MOST_SLACK, SEARCH_SLACK
from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import compiled, implements, leaf, spliced
from chsel.numerics.pose_tuples import all_finite, decode, pull_back
from chsel.numerics.threads import parallel_for
from chsel.problem.search_space import SearchSpace

BETA1, BETA2 = 0.9, 0.999  # of Adam (Kingma and Ba, 2015)
EPSILON = 1e-8


def costs_of(model, space, vectors, costs, work):
    """Fill the costs (B,) of search vectors (B, d), infinite if one is not finite.

    Kernels alone call it; `implements` has one for each model.
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
    """Return the cost of a search vector (d,); fills its gradient (d,)."""
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


@leaf
def adam_step(slope, moments, j, powers, rate, epsilon):
    """Return the step down a slope along coordinate j; updates moments (2, d).

    powers: beta_1 and beta_2 to the power of the number of steps, this one included.
    """
    moments[0, j] = BETA1 * moments[0, j] + (1.0 - BETA1) * slope
    moments[1, j] = BETA2 * moments[1, j] + (1.0 - BETA2) * slope * slope
    step = rate * (moments[0, j] / (1.0 - powers[0]))
    return step / (np.sqrt(moments[1, j] / (1.0 - powers[1])) + epsilon)


@compiled
def descend(
    model, space, vectors, costs, iterations, rate, divisor, ends_on_poses, first, last, work
):
    """Move search vectors (S, d) from `first` to before `last` by some iterations of Adam.

    divisor: of gradients. ends_on_poses: makes rotations orthonormal again, and fills costs (S,).
    """
    dimension = vectors.shape[1]
    moments, gradient = np.empty((LANES, 2, dimension)), np.empty(dimension)
    for start in range(first, last, LANES):
        count = min(LANES, last - start)
        moments[:] = 0.0
        powers = 1.0, 1.0
        forget(work)
        for _ in range(iterations):
            for lane in range(count):
                put_pose(work.lanes, lane, decode(space, vectors[start + lane]))
            evaluate(model, work, 0, count, MOST_SLACK)
            powers = powers[0] * BETA1, powers[1] * BETA2
            for lane in range(count):
                vector = vectors[start + lane]
                pull_back(space, vector, gradient_of(work.lanes, lane), gradient)
                for j in range(dimension):
                    slope = gradient[j] / divisor
                    vector[j] -= adam_step(slope, moments[lane], j, powers, rate, EPSILON)
        if ends_on_poses:
            for lane in range(count):
                pose = decode(space, vectors[start + lane])
                for j in range(6):
                    vectors[start + lane, j] = pose[j]
                put_pose(work.lanes, lane, decode(space, vectors[start + lane]))
            evaluate(model, work, 0, count, 0.0)
            for lane in range(count):
                costs[start + lane] = work.lanes[SUMS + lane]


class Objective:
    """The relaxed cost, and its gradients, over the vectors of a search space."""

    def __init__(self, cost: CompiledCost, space: SearchSpace) -> None:
        self._cost = cost
        self.space = space
        self.model = cost.model
        self.space_arrays = space.arrays

    def work(self) -> Work:
        """Return scratch for one thread."""
        return work_of(self.model)

    def costs(self, vectors: FloatArray) -> FloatArray:
        """Return costs (B,) of vectors (B, d)."""
        return self._cost.costs(self.space.poses(vectors))

    def costs_and_gradients(self, vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return costs (B,) and the defined gradients (B, d) at vectors (B, d)."""
        costs = np.empty(len(vectors))
        gradients = np.empty(vectors.shape)
        space = self.space_arrays
        run = partial(costs_and_gradients, self.model, space, vectors, costs, gradients)
        parallel_for(run, len(vectors), scratch=self.work, multiple=LANES)
        return costs, gradients

    def descended(
        self, vectors: FloatArray, divisor: float, *, rate: float, iterations: int
    ) -> FloatArray:
        """Return vectors (B, d) after iterations of Adam; gradients are divided by `divisor`."""
        return self._descended(
            vectors, divisor, rate=rate, iterations=iterations, ends_on_poses=False
        )[0]

    def block(
        self, vectors: FloatArray, divisor: float, *, rate: float, iterations: int
    ) -> tuple[FloatArray, FloatArray]:
        """Return vectors (B, d) of poses after a block of iterations, and costs (B,)."""
        if not self.space_arrays.planar:
            return self._descended(
                vectors, divisor, rate=rate, iterations=iterations, ends_on_poses=True
            )
        moved = self.descended(vectors, divisor, rate=rate, iterations=iterations)
        moved = self.space.encode(self.space.poses(moved))
        return moved, self.costs(moved)

    def _descended(
        self,
        vectors: FloatArray,
        divisor: float,
        *,
        rate: float,
        iterations: int,
        ends_on_poses: bool,
    ) -> tuple[FloatArray, FloatArray]:
        moved = vectors.copy()
        costs = np.empty(len(vectors))
        run = partial(
            descend,
            self.model,
            self.space_arrays,
            moved,
            costs,
            iterations,
            float(rate),
            float(divisor),
            ends_on_poses,
        )
        parallel_for(run, len(vectors), scratch=self.work, multiple=LANES)
        return moved, costs
