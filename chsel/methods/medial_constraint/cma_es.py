"""CMA-ES on the Medial Constraint cost, from every start or from one (CHSEL, Sec. V-D)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np

from chsel.cost.objective import cost_of
from chsel.methods.medial_constraint.medial_cost import MedialCost
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.numerics.compiler import compiled, inner, spliced
from chsel.numerics.elementary import logs
from chsel.numerics.pose_tuples import all_finite
from chsel.numerics.threads import spread
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import Observer
from chsel.problem.settings import CheckedSettings, Presets, at_most, not_negative, one_of, positive
from chsel.problem.streams import Purpose, StreamKey, normals
from chsel.qd.archive import rank
from chsel.qd.evolution_kernels import Strategy, ask, strategy_around, tell

MOST_GENERATIONS = 20_000
MOST_SAMPLES = 100_000
MOST_SIGMA = 1e6
_BLOCK = 50  # generations that are drawn at a time, or fewer
_MOST_DRAWN = 1_000_000  # normal draws held at once by a run, 8 bytes each
_RUN, _FINAL = 0, 1  # of a single run: which stream its generations and its result come from
_MAX_CONDITION = 1e14
_MOST_FLAT = 1  # generations in which all costs may be equal
_SHORTEST_HISTORY = 9
_STAGNATION = 100
_NARROWEST = 10  # of the windows whose medians stagnation compares


class StopRules(NamedTuple):
    """When a run ends; the rules of pycma (Hansen et al.), by its names where it has any."""

    generations: int  # at most
    recent: int  # generations whose best costs tolfun and tolfunhist compare
    tolfun: float  # of the costs of a generation, and of the recent best ones, m^2
    tolfunhist: float  # of the recent best ones alone, m^2
    tolx: float  # of the standard deviation and the path of every coordinate
    tolfacupx: float  # of the greatest standard deviation, in initial step sizes
    stagnation: int  # generations before stagnation is looked for
    stagnation_window: int  # least width of the windows that it compares


@dataclass(frozen=True)
class CmaEsSettings(CheckedSettings):
    """Settings of CMA-ES; the stop rules are those of pycma, by its names."""

    # "per_start" a run from each of E_0, of which each gives the best pose that it met; "single"
    # one run from the first of E_0, whose last distribution gives all poses.
    starts: Annotated[str, one_of("per_start", "single")] = "per_start"
    # Samples of a generation; by default 4 + floor(3 ln d) in d dimensions, for a single run at
    # least as many as there are hypotheses.
    population: Annotated[int | None, positive, at_most(MOST_SAMPLES)] = None
    # First step size, metres and entries of the 6-D rotation alike.
    sigma0: Annotated[float, positive, at_most(MOST_SIGMA)] = 0.1
    # At most; by default 100 + floor(150 (d + 3)^2 / sqrt(population)).
    generations: Annotated[int | None, not_negative, at_most(MOST_GENERATIONS)] = None
    # A run ends when the costs of a generation and the best ones of the last generations differ by
    # less than tolfun, m^2; or those best ones alone by less than tolfunhist; or when no coordinate
    # has a step larger than tolx.
    tolfun: Annotated[float, not_negative] = 1e-8
    tolfunhist: Annotated[float, not_negative] = 1e-9
    tolx: Annotated[float, not_negative] = 1e-11

    presets: ClassVar[Presets] = {
        "paper": {"tolfun": 1e-5, "tolfunhist": 1e-6},
        "reference": {"starts": "single", "tolfun": 1e-5, "tolfunhist": 1e-6},
    }

    def size(self, dimension: int, count: int) -> int:
        """Samples of a generation in `dimension` dimensions, for `count` hypotheses."""
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


class Run(NamedTuple):
    """State of one run, batch L in d dimensions."""

    strategy: Strategy
    best: FloatArray  # (d,), the vector of lowest cost so far
    cost: FloatArray  # (1,), its cost
    generations: IntArray  # (1,), so far
    flat: IntArray  # (1,), how many of the last generations had equal costs
    stopped: BoolArray  # (1,), whether a stop rule holds
    samples: FloatArray  # (L, d)
    values: FloatArray  # (L,), minus their costs
    status: IntArray  # (L,), ones: all count alike in `rank`
    order: IntArray  # (L,), best first
    history: FloatArray  # (2, most generations), lowest and median cost of every generation
    window: FloatArray  # (most generations,), scratch


def run_from(start: FloatArray, cost: float, batch: int, sigma0: float, generations: int) -> Run:
    """A run from a vector (d,) of that cost, which is its best so far."""
    return Run(
        strategy=strategy_around(start, batch, sigma0),
        best=np.array(start, dtype=np.float64),
        cost=np.array([cost]),
        generations=np.zeros(1, dtype=np.int64),
        flat=np.zeros(1, dtype=np.int64),
        stopped=np.zeros(1, dtype=np.bool_),
        samples=np.zeros((batch, len(start))),
        values=np.zeros(batch),
        status=np.ones(batch, dtype=np.int64),
        order=np.arange(batch),
        history=np.zeros((2, generations)),
        window=np.zeros(generations),
    )


def evolved(
    objective: MedialCost,
    initial_set: Poses,
    settings: CmaEsSettings,
    key: StreamKey,
    observer: Observer,
) -> FloatArray:
    """Search vectors (B, d) of the estimates that CMA-ES finds from E_0."""
    vectors = objective.space.encode(initial_set)
    starts = vectors[:1] if settings.starts == "single" else vectors
    runs = run_all(objective, starts, len(vectors), settings, key, observer)
    if settings.starts == "per_start":
        return np.stack([run.best for run in runs])
    drawn = normals(key.stream(Purpose.CMA_ES, _FINAL), vectors.shape)
    samples = np.empty(vectors.shape)
    _draw_samples(runs[0].strategy, drawn, samples)
    return samples


def run_all(
    objective: MedialCost,
    starts: FloatArray,
    count: int,
    settings: CmaEsSettings,
    key: StreamKey,
    observer: Observer,
) -> list[Run]:
    """A run from each of the starts (S, d), all to their ends, block by block.

    count: how many hypotheses are wanted.
    """
    dimension = starts.shape[1]
    size = settings.size(dimension, count)
    rules = settings.rules(dimension, size)
    total = rules.generations
    runs = [
        run_from(start, cost, size, settings.sigma0, total)
        for start, cost in zip(starts, objective.costs(starts).tolist(), strict=True)
    ]
    streams = [key.stream(Purpose.CMA_ES, _RUN + index) for index in range(len(runs))]
    block = max(1, min(_BLOCK, _MOST_DRAWN // (size * dimension)))
    _trace(observer, runs)

    def advance(first: int, last: int, work: Any) -> None:
        for run, stream in zip(runs[first:last], streams[first:last], strict=True):
            left = min(block, total - int(run.generations[0]))
            if not run.stopped[0] and left > 0:
                drawn = normals(stream, (left, size, dimension))
                evolve(objective.model, objective.space_arrays, work, run, rules, drawn)

    for done in range(0, total, block):
        spread(advance, len(runs), objective.work)
        _trace(observer, runs)
        observer.progress("cma_es", min(done + block, total), total)
        if all(run.stopped[0] for run in runs):
            break
    return runs


def _trace(observer: Observer, runs: list[Run]) -> None:
    """Show the observer the best vector of each run so far."""
    generation = max(int(run.generations[0]) for run in runs)
    vectors, costs = np.stack([run.best for run in runs]), np.array([run.cost[0] for run in runs])
    observer.trace("cma_es", generation, vectors, costs)


@compiled
def evolve(
    model: Any, space: Any, work: Any, run: Run, rules: StopRules, normals: FloatArray
) -> None:
    """Generations of CMA-ES (Hansen, 2016), as many as normals (G, L, d), or to the end.

    The better half of a generation are parents, weighted by rank, all weights positive.
    """
    samples = run.samples
    parents = max(len(samples) // 2, 1)
    for generation in range(len(normals)):
        if run.stopped[0]:
            break
        ask(run.strategy, normals[generation], samples)
        _evaluate(model, space, work, samples, run.values)
        rank(run.status, run.values, run.order)
        _record(run)
        tell(run.strategy, samples, run.order, parents)
        run.stopped[0] = _ended(run, rules)


@compiled
def _draw_samples(strategy: Strategy, normals: FloatArray, samples: FloatArray) -> None:
    """Fill samples (S, d) of a strategy's distribution from normals (S, d)."""
    ask(strategy, normals, samples)


@spliced
def _evaluate(model: Any, space: Any, work: Any, samples: FloatArray, values: FloatArray) -> None:
    """Fill minus the costs (L,); a vector that is not finite is not looked up anywhere."""
    for i in range(len(samples)):
        vector = samples[i]
        values[i] = -np.inf
        if all_finite(vector):
            values[i] = -cost_of(model, space, vector, work)


@inner
def _record(run: Run) -> None:
    """Keep the best, and what the stop rules need of a generation."""
    order, values, generation = run.order, run.values, run.generations[0]
    first, middle, last = order[0], order[len(order) // 2], order[len(order) - 1]
    if -values[first] < run.cost[0]:
        run.cost[0] = -values[first]
        for j in range(len(run.best)):
            run.best[j] = run.samples[first, j]
    run.history[0, generation] = -values[first]
    run.history[1, generation] = -values[middle]
    run.generations[0] += 1
    run.flat[0] = run.flat[0] + 1 if values[first] == values[last] else 0


@inner
def _ended(run: Run, rules: StopRules) -> bool:
    """Whether any of the rules holds."""
    values, count = run.strategy.eigenvalues, run.generations[0]
    if count >= rules.generations or run.flat[0] > _MOST_FLAT:
        return True
    if not values[len(values) - 1] <= _MAX_CONDITION * values[0]:
        return True
    latest = run.values[run.order[0]] - run.values[run.order[len(run.order) - 1]]
    costs = run.history[0]
    lowest = highest = costs[count - 1]
    for i in range(max(count - rules.recent, 0), count):
        lowest, highest = min(lowest, costs[i]), max(highest, costs[i])
    recent = highest - lowest
    if latest < rules.tolfun and recent < rules.tolfun:
        return True
    if count > _SHORTEST_HISTORY and recent < rules.tolfunhist:
        return True
    return _step_ends(run.strategy, rules) or _stagnates(run, rules, count)


@inner
def _step_ends(strategy: Strategy, rules: StopRules) -> bool:
    """Whether every coordinate's step is below tolx, or any above tolfacupx."""
    sigma, smallest = strategy.sigma[0], True
    for j in range(len(strategy.mean)):
        deviation = sigma * np.sqrt(strategy.covariance[j, j])
        if not deviation <= rules.tolfacupx * strategy.sigma0:
            return True
        smallest &= max(deviation, abs(sigma * strategy.path_c[j])) < rules.tolx
    return smallest


@inner
def _stagnates(run: Run, rules: StopRules, count: int) -> bool:
    """Whether the medians of neither lowest nor median costs fell from one window to the next."""
    width = max(rules.stagnation_window, count // _NARROWEST)
    if count <= max(rules.stagnation, _STAGNATION) or 2 * width >= count:
        return False
    for kind in range(2):
        costs = run.history[kind]
        before = _median(costs, count - 2 * width, count - width, run.window)
        if _median(costs, count - width, count, run.window) < before:
            return False
    return True


@inner
def _median(values: FloatArray, first: int, last: int, work: FloatArray) -> float:
    """Median of values from `first` to before `last`, by Shell's sort in work."""
    count = last - first
    for i in range(count):
        work[i] = values[first + i]
    gap = count // 2
    while gap > 0:
        for i in range(gap, count):
            item, place = work[i], i
            while place >= gap and work[place - gap] > item:
                work[place] = work[place - gap]
                place -= gap
            work[place] = item
        gap //= 2
    return 0.5 * (work[(count - 1) // 2] + work[count // 2])
