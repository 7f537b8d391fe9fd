"""Registrations by this library, with the number of steps that the comparison prescribes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING
from unittest.mock import patch

from chsel.cost.cost_settings import CostSettings
from chsel.cost.objective import Objective
from chsel.errors import require_positive
from chsel.methods import build_method, preset_settings
from chsel.methods.method import Method
from chsel.numerics.arrays import FloatArray
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses, Observer
from chsel.problem.settings import in_preset

if TYPE_CHECKING:
    from runners.benchmarks.problems import PosedProblem

PRESETS = ("reference", "paper", "default")
EQUAL_STEPS = ("reference", "paper")
"""Presets that do as many steps as the package; all else is registered as it ships."""
SIZES = tuple(f"anchored, {size}" for size in ("small", "medium", "adaptive"))
OURS = (*PRESETS, *SIZES)
"""Registrations by this library: presets of CHSEL, and sizes of the method `anchored`."""


@dataclass(frozen=True)
class Steps:
    """How much EQUAL_STEPS and the package do, neither of which stops early."""

    restarts: int = 10  # of descent
    adam: int = 50  # Adam steps of a restart
    search: int = 100  # CMA-MEGA iterations
    long_search: int = 500  # the same, in the longer row

    def __post_init__(self) -> None:
        for name in ("restarts", "adam", "search", "long_search"):
            require_positive(name, getattr(self, name))

    def searching(self, *, long: bool) -> int:
        """Iterations of the search of one registration."""
        return self.long_search if long else self.search


def method(name: str, steps: Steps, search: int) -> Method:
    """One of OURS: with all steps done, or as it ships but for a search that is longer."""
    if name in SIZES:
        settings = replace(preset_settings("anchored"), size=name.removeprefix("anchored, "))
        return build_method("anchored", settings)
    settings = preset_settings("chsel", name)
    if name in EQUAL_STEPS or search != steps.search:
        settings = replace(settings, emitter=replace(settings.emitter, iterations=search))
    if name in EQUAL_STEPS:
        descent = replace(
            settings.descent, restarts=steps.restarts, iterations=steps.adam, stop_below=None
        )
        settings = replace(settings, descent=descent)
    return build_method("chsel", settings)


@contextmanager
def descents_counted() -> Iterator[list[int]]:
    """Collects how many poses each call of Adam evaluates with their gradients."""
    counts: list[int] = []
    block = Objective.block

    def counted(
        objective: Objective, vectors: FloatArray, divisor: float, rate: float, iterations: int
    ) -> tuple[FloatArray, FloatArray]:
        counts.append(len(vectors) * iterations)
        return block(objective, vectors, divisor, rate, iterations)

    with patch.object(Objective, "block", counted):
        yield counts


def register(
    posed: PosedProblem,
    name: str,
    steps: Steps,
    search: int,
    observer: Observer | None = None,
) -> tuple[float, Hypotheses]:
    """Seconds from arrays to hypotheses by one of OURS, and these; only the SDF grid is there."""
    begun = time.perf_counter()
    problem = posed.registration_problem()
    hypotheses = method(name, steps, search).register(problem, observer)
    return time.perf_counter() - begun, hypotheses


@dataclass(frozen=True)
class Scope:
    """How much is measured of this library alone."""

    steps: Steps
    repeats: int
    seed: int
    free_points: tuple[int, ...] = ()  # sizes that show how the time grows
    hypotheses: tuple[int, ...] = ()

    def timed(self, posed: PosedProblem, name: str) -> tuple[float, ...]:
        """Milliseconds of repeated registrations of a problem, after one that is not counted."""
        self.seconds(posed, name)
        return tuple(1000.0 * self.seconds(posed, name) for _ in range(self.repeats))

    def seconds(self, posed: PosedProblem, name: str) -> float:
        """Seconds of one registration by one of OURS."""
        return register(posed, name, self.steps, self.steps.search)[0]


def common_costs(posed: PosedProblem, poses: FloatArray) -> FloatArray:
    """Costs (B,) of poses (B, 4, 4) under the paper's equation: the same measure for everyone."""
    # A registration needs no torch, and a fresh process that is timed does not import it for this.
    from chsel.cost.torch_cost import RelaxedCost

    paper = in_preset(CostSettings(), "paper")
    return RelaxedCost.of(posed.registration_problem(), paper).evaluate(poses)


class StageTimer:
    """An observer that takes the time of the stages, and counts their iterations."""

    snapshot_interval = 0

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.seconds: dict[str, float] = {}
        self.iterations: dict[str, int] = {}
        self._clock = clock
        self._mark = clock()

    def progress(self, stage: str, iteration: int, total: int) -> None:
        """The time since the last report is the stage's."""
        now = self._clock()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._mark
        self.iterations[stage] = iteration
        self._mark = now

    def trace(self, stage: str, iteration: int, vectors: FloatArray, cost: FloatArray) -> None:
        """Ignore it."""

    def snapshot(self, archive: ArchiveSnapshot) -> None:
        """Ignore it."""
