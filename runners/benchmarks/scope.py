"""How much a benchmark measures of this library alone."""

from __future__ import annotations

from dataclasses import dataclass

from runners.benchmarks.ours import Steps, register
from runners.benchmarks.problems import PosedProblem, Problem, pose


@dataclass(frozen=True)
class Scope:
    """How much is measured, and where evaluation is."""

    steps: Steps
    repeats: int
    seed: int
    free_points: tuple[int, ...]
    hypotheses: tuple[int, ...]
    gpu: bool = False

    def timed(self, problem: Problem, preset: str) -> tuple[float, ...]:
        """Milliseconds of repeated registrations of a problem, after one that is not counted."""
        posed = pose(problem, self.seed)
        self.seconds(posed, preset)
        return tuple(1000.0 * self.seconds(posed, preset) for _ in range(self.repeats))

    def seconds(self, posed: PosedProblem, preset: str) -> float:
        """Seconds of one registration."""
        return register(posed, preset, self.steps, self.steps.search)[0]
