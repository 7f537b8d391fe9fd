"""Gradient descent alone: stage 1 of CHSEL as a method of its own (ablation of the paper)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise, takewhile
from typing import Annotated, ClassVar

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_settings import CostSettings
from chsel.cost.descent import Course, blocks_done, course_from
from chsel.cost.objective import Objective
from chsel.errors import SettingError, require_at_most
from chsel.methods.method import ConfiguredMethod
from chsel.numerics.arrays import FloatArray
from chsel.numerics.threads import team_size
from chsel.problem.online_registration import OnlineSettings
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import (
    Hypotheses,
    NullObserver,
    Observer,
    RegistrationProblem,
)
from chsel.problem.search_space import PlaneSettings, search_space
from chsel.problem.settings import CheckedSettings, Presets, at_most, not_negative, positive
from chsel.qd.selection import ranked_hypotheses

MOST_ITERATIONS = 1_000_000
_AT_ONCE = 1_000  # iterations after which an observer hears of them


@dataclass(frozen=True)
class DescentSettings(CheckedSettings):
    """Adam on all starts at once."""

    # Blocks; Adam starts anew in each, rotations are made orthonormal again.
    restarts: Annotated[int, not_negative, at_most(MOST_ITERATIONS)] = 10
    iterations: Annotated[int, positive, at_most(MOST_ITERATIONS)] = 50  # of a block
    rate: Annotated[float, positive] = 0.01  # Adam's step size
    # End when a block lowers the costs by no more than this fraction on average over the starts
    # that descend in it; None: never end early.
    stop_below: float | None = 1e-6
    # Share of the starts that descend in each block, those of the lowest costs; the last holds for
    # all further blocks. None: all descend to the end.
    race: tuple[float, ...] | None = None

    presets: ClassVar[Presets] = {"paper": {"stop_below": None}, "reference": {}}

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_most("restarts x iterations", self.restarts * self.iterations, MOST_ITERATIONS)
        if self.stop_below is not None and not np.isfinite(self.stop_below):
            raise SettingError(f"stop_below is {self.stop_below}; accepted: a number, or null")
        if self.race is not None and not _falls_from_1(self.race):
            raise SettingError(
                f"race is {list(self.race)}; accepted: null, or shares above 0 and at most 1, none "
                "above the one before"
            )

    def runners(self, block: int, starts: int) -> int:
        """How many of the starts descend in a block."""
        if self.race is None:
            return starts
        return math.ceil(self.race[min(block, len(self.race) - 1)] * starts)

    def blocks_alike(self, block: int, starts: int) -> int:
        """How many blocks, from one on, the same starts descend in; only some at once."""
        most = max(1, _AT_ONCE // self.iterations)
        following = range(block, min(self.restarts, block + most))
        runners = self.runners(block, starts)
        return sum(1 for _ in takewhile(lambda n: self.runners(n, starts) == runners, following))

    def ends_after(self, gain: float) -> bool:
        """Whether no block follows one of such a mean gain."""
        return self.stop_below is not None and gain <= self.stop_below


def _falls_from_1(shares: tuple[float, ...]) -> bool:
    falling = all(share <= before for before, share in pairwise((1.0, *shares)))
    return bool(shares) and falling and shares[-1] > 0.0


def _course(
    objective: Objective,
    vectors: FloatArray,
    costs: FloatArray,
    settings: DescentSettings,
    block: int,
    starts: int,
) -> Course:
    """As many of the next blocks as are for the same of so many starts, vectors (S, d)."""
    is_planar = objective.space.arrays.planar
    return course_from(
        vectors,
        costs,
        1 if is_planar else settings.blocks_alike(block, starts),
        threads=team_size(),
        iterations=settings.iterations,
        rate=settings.rate,
        divisor=starts,
        ends_on_poses=not is_planar,
        stop_below=settings.stop_below,
    )


def _costs(vectors: FloatArray, run: Callable[[Course], None]) -> FloatArray:
    """Costs (S,) of vectors (S, d), by those who descend."""
    count, threads = len(vectors), team_size()
    course = course_from(vectors, np.zeros(count), 1, threads=threads, ends_on_poses=True)
    run(course)
    return course.costs[1]


def _blocks(
    objective: Objective, course: Course, run: Callable[[Course], None]
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Vectors (S, d) and costs (S,) after each block of a course, at least one."""
    space = objective.space
    run(course)
    for block in range(1, blocks_done(course) + 1):
        vectors, costs = course.vectors[block], course.costs[block]
        if not course.ends_on_poses:
            vectors = space.encode(space.poses(vectors))
            costs = objective.costs(vectors)
        yield vectors, costs


def descend(
    objective: Objective, starts: Poses, settings: DescentSettings, observer: Observer
) -> tuple[Poses, FloatArray]:
    """Estimates E' with their costs (B,), from B starts, each of which descends on its own.

    Starts that drop out of the race stay where they are.
    """
    space, total = objective.space, settings.restarts * settings.iterations
    vectors = space.encode(starts)
    running, block, gain = np.arange(len(starts)), 0, np.inf
    with objective.descents(len(starts)) as run:
        costs = _costs(vectors, run)
        _show(observer, 0, vectors, costs)
        while block < settings.restarts and not settings.ends_after(gain):
            lowest = np.argsort(costs[running], kind="stable")
            running = np.sort(running[lowest[: settings.runners(block, len(starts))]])
            course = _course(
                objective, vectors[running], costs[running], settings, block, len(starts)
            )
            for after in _blocks(objective, course, run):
                if settings.stop_below is not None:
                    gain = _mean_gain(costs[running], after[1])
                vectors[running], costs[running] = after
                block += 1
                done = block * settings.iterations
                _show(observer, done, vectors, costs)
                observer.progress("descent", done, total)
                if settings.ends_after(gain):
                    break
    return space.poses(vectors), costs


def _show(observer: Observer, iteration: int, vectors: FloatArray, costs: FloatArray) -> None:
    if type(observer) is not NullObserver:
        observer.trace("descent", iteration, vectors.copy(), costs.copy())


def _mean_gain(before: FloatArray, after: FloatArray) -> float:
    """Mean over the starts of the fraction by which the cost fell; a cost of 0 gains nothing."""
    gain = np.where(before > 0.0, (before - after) / np.where(before > 0.0, before, 1.0), 0.0)
    return float(gain.mean())


@dataclass(frozen=True)
class GradientDescentSettings:
    """All settings of gradient descent."""

    cost: CostSettings = field(default_factory=CostSettings)
    descent: DescentSettings = field(default_factory=DescentSettings)
    online: OnlineSettings = field(default_factory=OnlineSettings)
    plane: PlaneSettings | None = None  # restricts the poses to SE(2)

    presets: ClassVar[Presets] = {}  # those of its groups


class GradientDescent(ConfiguredMethod[GradientDescentSettings]):
    """Descends from every pose of E_0 and returns where each arrives; E_l is not used."""

    settings_class = GradientDescentSettings

    def register(
        self, problem: RegistrationProblem, observer: Observer | None = None
    ) -> Hypotheses:
        """Hypotheses for the known points of a problem, best first."""
        space = search_space(self.settings.plane, problem.sdf)
        objective = Objective(CompiledCost.of(problem, self.settings.cost), space)
        starts = Poses.of(problem.initial_set)
        estimates, _ = descend(objective, starts, self.settings.descent, observer or NullObserver())
        return ranked_hypotheses(objective, estimates, elites=estimates)
