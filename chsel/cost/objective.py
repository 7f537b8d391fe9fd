"""The relaxed cost as a function of search vectors, and its gradient."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_kernels import Model, Work, evaluate, gradient_of, put_pose, work_of
from chsel.cost.descent import Course, abandon, course_from, descend, groups_for
from chsel.cost.free_kernels import SEARCH_SLACK
from chsel.cost.pose_lanes import LANES, SUMS
from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import compiled, implements, spliced
from chsel.numerics.pose_tuples import all_finite, decode, pull_back
from chsel.numerics.threads import helped, spread, team_size
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
        course = course_from(
            vectors,
            np.zeros(len(vectors)),
            1,
            threads=team_size(),
            iterations=iterations,
            rate=rate,
            divisor=divisor,
        )
        with self.descents(len(vectors)) as run:
            run(course)
        return course.vectors[1]

    @contextmanager
    def descents(self, starts: int) -> Iterator[Callable[[Course], None]]:
        """Within this context, what takes one course after the other to its end, on all threads.

        starts: of the largest course.
        """
        current: list[Course] = []

        def assist(work: Work) -> None:
            descend(self.model, self.space_arrays, current[-1], work, False)

        def run(course: Course) -> None:
            current.append(course)
            descend(self.model, self.space_arrays, course, work, True)

        def end() -> None:
            abandon(current[-1])

        current.append(course_from(np.zeros((0, self.space.dimension)), np.zeros(0), 0))
        work = self.work()
        groups = len(groups_for(starts, team_size())) - 1
        with helped(assist, self.work, groups - 1, end):
            yield run
