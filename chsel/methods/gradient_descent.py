"""Gradient descent alone: stage 1 of CHSEL as a method of its own (ablation of the paper)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Annotated, ClassVar

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_settings import CostSettings
from chsel.cost.objective import Objective
from chsel.errors import SettingError, require_at_most
from chsel.methods.method import ConfiguredMethod
from chsel.numerics.arrays import FloatArray
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import Hypotheses, Observer, RegistrationProblem
from chsel.problem.search_space import PlaneSettings, search_space
from chsel.problem.settings import CheckedSettings, Presets, at_most, not_negative, positive
from chsel.qd.selection import ranked_hypotheses

MOST_ITERATIONS = 1_000_000


@dataclass(frozen=True)
class DescentSettings(CheckedSettings):
    """Adam on all starts at once."""

    # Blocks; Adam restarts in each, and rotations are made orthonormal.
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
        require_at_most(
            "restarts x iterations", self.restarts * self.iterations, most=MOST_ITERATIONS
        )
        shares = self.race or (0.0,)
        falling = all(share <= before for before, share in pairwise((1.0, *shares)))
        if self.race is not None and not (falling and shares[-1] > 0.0):
            raise SettingError(
                f"race is {list(self.race)}; accepted: null, or shares above 0 and at most 1, none "
                "above the one before"
            )

    def runners(self, block: int, starts: int) -> int:
        """Return the number of starts that descend in a block."""
        if self.race is None:
            return starts
        return math.ceil(self.race[min(block, len(self.race) - 1)] * starts)


def descend(
    objective: Objective, starts: Poses, *, settings: DescentSettings, observer: Observer
) -> tuple[Poses, FloatArray]:
    """Return estimates E' with their costs (B,), from B starts, each of which descends on its own.

    Starts that drop out of the race stay where they are.
    """
    space = objective.space
    total = settings.restarts * settings.iterations
    vectors = space.encode(starts)
    costs = objective.costs(vectors)
    running = np.arange(len(starts))
    observer.trace("descent", 0, vectors.copy(), costs.copy())
    for block in range(settings.restarts):
        lowest = np.argsort(costs[running], kind="stable")
        running = np.sort(running[lowest[: settings.runners(block, len(starts))]])
        moved, after = objective.block(
            vectors[running], len(starts), rate=settings.rate, iterations=settings.iterations
        )
        before = costs[running]
        # By which fraction costs fell, on average over the starts; a cost of 0 gains nothing.
        gain = np.where(before > 0.0, (before - after) / np.where(before > 0.0, before, 1.0), 0.0)
        vectors[running], costs[running] = moved, after
        done = (block + 1) * settings.iterations
        observer.trace("descent", done, vectors.copy(), costs.copy())
        observer.progress("descent", done, total)
        if settings.stop_below is not None and float(gain.mean()) <= settings.stop_below:
            break
    return space.poses(vectors), costs


@dataclass(frozen=True)
class GradientDescentSettings:
    """Settings of gradient descent."""

    cost: CostSettings = field(default_factory=CostSettings)  # the relaxed cost
    descent: DescentSettings = field(default_factory=DescentSettings)  # of all starts
    # E_0 and E_l of the next problem.
    online: OnlineSettings = field(default_factory=OnlineSettings)
    plane: PlaneSettings | None = None  # restricts the poses to SE(2)

    presets: ClassVar[Presets] = {}  # those of its groups


class GradientDescent(ConfiguredMethod[GradientDescentSettings]):
    """Descends from every pose of E_0 and returns where each arrives; E_l is not used."""

    settings_class = GradientDescentSettings

    def _hypotheses(self, problem: RegistrationProblem, observer: Observer) -> Hypotheses:
        space = search_space(self.settings.plane, problem.sdf)
        objective = Objective(CompiledCost.of(problem, self.settings.cost), space)
        starts = Poses.of(problem.initial_set)
        estimates, _ = descend(objective, starts, settings=self.settings.descent, observer=observer)
        return ranked_hypotheses(objective, estimates, elites=estimates)
