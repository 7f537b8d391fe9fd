"""Registrations by this library, with the number of steps that the comparison prescribes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from chsel.cost.cost_settings import CostSettings
from chsel.cost.torch_cost import RelaxedCost
from chsel.errors import require_positive
from chsel.methods import build_method, preset_settings
from chsel.methods.method import Method
from chsel.numerics.arrays import FloatArray
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses, Observer
from chsel.problem.settings import in_preset
from runners.benchmarks.problems import PosedProblem, Problem, pose

PRESETS = ("reference", "paper", "default")


@dataclass(frozen=True)
class Steps:
    """How much every registration does, by either package; none stops early."""

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


def method(preset: str, steps: Steps, search: int) -> Method:
    """CHSEL in a preset, with all steps done."""
    settings = preset_settings("chsel", preset)
    descent = replace(
        settings.descent, restarts=steps.restarts, iterations=steps.adam, stop_below=None
    )
    emitter = replace(settings.emitter, iterations=search)
    return build_method("chsel", replace(settings, descent=descent, emitter=emitter))


def register(
    posed: PosedProblem,
    preset: str,
    steps: Steps,
    search: int,
    observer: Observer | None = None,
) -> tuple[float, Hypotheses]:
    """Seconds from arrays to hypotheses, and these; only the SDF grid is there already."""
    begun = time.perf_counter()
    problem = posed.registration_problem()
    hypotheses = method(preset, steps, search).register(problem, observer)
    return time.perf_counter() - begun, hypotheses


@dataclass(frozen=True)
class Scope:
    """How much is measured of this library alone."""

    steps: Steps
    repeats: int
    seed: int
    free_points: tuple[int, ...] = ()  # sizes that show how the time grows
    hypotheses: tuple[int, ...] = ()
    gpu: bool = False  # whether evaluation is measured there, too

    def timed(self, problem: Problem, preset: str) -> tuple[float, ...]:
        """Milliseconds of repeated registrations of a problem, after one that is not counted."""
        posed = pose(problem, self.seed)
        self.seconds(posed, preset)
        return tuple(1000.0 * self.seconds(posed, preset) for _ in range(self.repeats))

    def seconds(self, posed: PosedProblem, preset: str) -> float:
        """Seconds of one registration."""
        return register(posed, preset, self.steps, self.steps.search)[0]


def common_costs(posed: PosedProblem, poses: FloatArray) -> FloatArray:
    """Costs (B,) of poses (B, 4, 4) under the paper's equation: the same measure for everyone."""
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
