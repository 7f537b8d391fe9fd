"""CMA-ES on the Medial Constraint cost, from every start or from one (CHSEL, Sec. V-D)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from chsel.errors import require_at_most, require_choice, require_positive
from chsel.methods.medial_constraint.cma_es_kernels import (
    BEST,
    GENERATIONS,
    STOPPED,
    Run,
    StopRules,
    draw_samples,
    evolve,
    run_from,
)
from chsel.methods.medial_constraint.medial_cost import MedialObjective
from chsel.numerics.arrays import FloatArray
from chsel.numerics.elementary import logs
from chsel.numerics.threads import spread
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import Observer
from chsel.problem.settings import Presets
from chsel.problem.streams import Purpose, StreamKey, normals

MOST_GENERATIONS = 20_000
MOST_SAMPLES = 100_000
MOST_SIGMA = 1e6
_BLOCK = 50  # generations that are drawn at a time, or fewer
_MOST_DRAWN = 1_000_000  # normal draws held at once by a run, 8 bytes each
_RUN, _FINAL = 0, 1  # of a single run: which stream its generations and its result come from


@dataclass(frozen=True)
class CmaEsSettings:
    """Settings of CMA-ES; the stop rules are those of pycma, by its names.

    starts: "per_start" a run from each of E_0, of which each gives the best pose that it met;
    "single" one run from the first of E_0, whose last distribution gives all poses.
    population: samples of a generation; by default 4 + floor(3 ln d) in d dimensions, for a
    single run at least as many as there are hypotheses. sigma0: first step size, metres and
    entries of the 6-D rotation alike. generations: most; by default
    100 + floor(150 (d + 3)^2 / sqrt(population)). tolfun: a run ends when the costs of a
    generation and the best ones of the last generations differ by less, m^2; tolfunhist: or
    those best ones alone. tolx: or when no coordinate has a larger step.
    """

    starts: str = "per_start"
    population: int | None = None
    sigma0: float = 0.1
    generations: int | None = None
    tolfun: float = 1e-8
    tolfunhist: float = 1e-9
    tolx: float = 1e-11

    presets: ClassVar[Presets] = {
        "paper": {"tolfun": 1e-5, "tolfunhist": 1e-6},
        "reference": {"starts": "single", "tolfun": 1e-5, "tolfunhist": 1e-6},
    }

    def __post_init__(self) -> None:
        require_choice("starts", self.starts, ("per_start", "single"))
        if self.population is not None:
            require_positive("population", self.population)
            require_at_most("population", self.population, MOST_SAMPLES)
        if self.generations is not None:
            require_positive("generations", self.generations, zero=True)
            require_at_most("generations", self.generations, MOST_GENERATIONS)
        require_positive("sigma0", self.sigma0)
        require_at_most("sigma0", self.sigma0, MOST_SIGMA)
        for name in ("tolfun", "tolfunhist", "tolx"):
            require_positive(name, getattr(self, name), zero=True)

    def size(self, dimension: int, count: int) -> int:
        """Samples of a generation in so many dimensions, for so many hypotheses."""
        if self.population is not None:
            return self.population
        usual = 4 + math.floor(3.0 * float(logs(float(dimension))))
        return max(usual, min(count, MOST_SAMPLES)) if self.starts == "single" else usual

    def rules(self, dimension: int, size: int) -> StopRules:
        """The stop rules of a run."""
        n = float(dimension)
        generations = self.generations
        if generations is None:
            generations = 100 + math.floor(150.0 * (n + 3.0) * (n + 3.0) / math.sqrt(size))
        return StopRules(
            generations=generations,
            recent=10 + math.floor(30.0 * n / size),
            tolfun=self.tolfun,
            tolfunhist=self.tolfunhist,
            tolx=self.tolx,
            tolfacupx=1e3,
            stagnation=math.floor(n * (5.0 + 100.0 / size)),
            stagnation_window=math.floor(100.0 + 100.0 * n * math.sqrt(n) / size) // 10,
        )


def evolved(
    objective: MedialObjective,
    initial_set: Poses,
    settings: CmaEsSettings,
    key: StreamKey,
    observer: Observer,
) -> FloatArray:
    """Search vectors (B, d) of the estimates that CMA-ES finds from E_0."""
    vectors = objective.space.encode(initial_set)
    count = len(vectors)
    starts = vectors[:1] if settings.starts == "single" else vectors
    runs = run_all(objective, starts, count, settings, key, observer)
    if settings.starts == "per_start":
        return np.stack([run.best for run in runs])
    drawn = normals(key.stream(Purpose.CMA_ES, _FINAL), vectors.shape)
    samples = np.empty(vectors.shape)
    draw_samples(runs[0].strategy, drawn, samples)
    return samples


def run_all(
    objective: MedialObjective,
    starts: FloatArray,
    count: int,
    settings: CmaEsSettings,
    key: StreamKey,
    observer: Observer,
) -> list[Run]:
    """A run from each of the starts (S, d), all to their ends, block by block."""
    dimension = starts.shape[1]
    size = settings.size(dimension, count)
    rules = settings.rules(dimension, size)
    costs, sigma0, total = objective.costs(starts), settings.sigma0, rules.generations
    runs = [
        run_from(start, float(cost), size, sigma0, total)
        for start, cost in zip(starts, costs, strict=True)
    ]
    streams = [key.stream(Purpose.CMA_ES, _RUN + index) for index in range(len(runs))]
    block = max(1, min(_BLOCK, _MOST_DRAWN // (size * dimension)))
    _tell(observer, runs)

    def go_on(first: int, last: int, work: Any) -> None:
        for run, stream in zip(runs[first:last], streams[first:last], strict=True):
            left = min(block, total - int(run.numbers[GENERATIONS]))
            if run.numbers[STOPPED] == 0.0 and left > 0:
                drawn = normals(stream, (left, size, dimension))
                evolve(objective.model, objective.space_arrays, work, run, rules, drawn)

    for done in range(0, total, block):
        spread(go_on, len(runs), objective.work)
        _tell(observer, runs)
        observer.progress("cma_es", min(done + block, total), total)
        if all(run.numbers[STOPPED] > 0.0 for run in runs):
            break
    return runs


def _tell(observer: Observer, runs: list[Run]) -> None:
    """Trace the best vector of each run so far."""
    generation = max(int(run.numbers[GENERATIONS]) for run in runs)
    vectors = np.stack([run.best for run in runs])
    costs = np.array([run.numbers[BEST] for run in runs])
    observer.trace("cma_es", generation, vectors, costs)
