"""CMA-ES from one start to the end that its stop rules set."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.methods.medial_constraint.medial_kernels import cost_of
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.compiler import compiled, inner, spliced
from chsel.qd.archive import all_finite, rank
from chsel.qd.evolution_kernels import Strategy, ask, strategy_around, tell

BEST, GENERATIONS, STOPPED, FLAT = range(4)

_MAX_CONDITION = 1e14
_MOST_FLAT = 1  # generations in which all costs may be equal
_SHORTEST_HISTORY = 9
_STAGNATION = 100
_NARROWEST = 10  # of the windows whose medians stagnation compares


class StopRules(NamedTuple):
    """When a run ends; those of pycma (Hansen et al.), by its names where it has any.

    generations: most. tolfun: of the costs of a generation, and of the best ones of the last
    `recent`. tolfunhist: of the latter alone. tolx: of the standard deviation and the path of
    every coordinate. tolfacupx: of the greatest standard deviation, in initial step sizes.
    stagnation, stagnation_window: generations before it is looked for, and least width of the
    windows that it compares.
    """

    generations: int
    recent: int
    tolfun: float
    tolfunhist: float
    tolx: float
    tolfacupx: float
    stagnation: int
    stagnation_window: int


class Run(NamedTuple):
    """State of one run, batch L in d dimensions.

    best (d,): the vector of lowest cost so far. numbers (4,): its cost, generations so far, 1 once
    stopped, and how many of the last generations were flat. samples (L, d), values (L,), minus
    their costs, status and order (L,). history (2, most): lowest and median cost of every
    generation. window (most,): scratch.
    """

    strategy: Strategy
    best: FloatArray
    numbers: FloatArray
    samples: FloatArray
    values: FloatArray
    status: IntArray
    order: IntArray
    history: FloatArray
    window: FloatArray


def run_from(start: FloatArray, cost: float, batch: int, sigma0: float, generations: int) -> Run:
    """A run from a vector (d,) of that cost, which is its best so far."""
    return Run(
        strategy=strategy_around(start, batch, sigma0),
        best=np.array(start, dtype=np.float64),
        numbers=np.array([cost, 0.0, 0.0, 0.0]),
        samples=np.zeros((batch, len(start))),
        values=np.zeros(batch),
        status=np.ones(batch, dtype=np.int64),
        order=np.arange(batch),
        history=np.zeros((2, generations)),
        window=np.zeros(generations),
    )


@compiled
def evolve(
    model: Any, space: Any, work: Any, run: Run, rules: StopRules, normals: FloatArray
) -> None:
    """Generations of CMA-ES (Hansen, 2016), as many as normals (G, L, d), or to the end.

    The better half of a generation are parents, weighted by rank, all weights positive.
    """
    strategy, samples, numbers = run.strategy, run.samples, run.numbers
    parents = max(len(samples) // 2, 1)
    for generation in range(len(normals)):
        if numbers[STOPPED] > 0.0:
            break
        ask(strategy, normals[generation], samples)
        _evaluate(model, space, work, samples, run.values)
        rank(run.status, run.values, run.order)
        _note(run)
        tell(strategy, samples, run.order, parents)
        if _ended(run, rules):
            numbers[STOPPED] = 1.0


@compiled
def draw_samples(strategy: Strategy, normals: FloatArray, samples: FloatArray) -> None:
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
def _note(run: Run) -> None:
    """Keep the best, and what the stop rules ask of a generation."""
    numbers, order, values = run.numbers, run.order, run.values
    first, middle, last = order[0], order[len(order) // 2], order[len(order) - 1]
    if -values[first] < numbers[BEST]:
        numbers[BEST] = -values[first]
        for j in range(len(run.best)):
            run.best[j] = run.samples[first, j]
    generation = int(numbers[GENERATIONS])
    run.history[0, generation] = -values[first]
    run.history[1, generation] = -values[middle]
    numbers[GENERATIONS] += 1.0
    numbers[FLAT] = numbers[FLAT] + 1.0 if values[first] == values[last] else 0.0


@inner
def _ended(run: Run, rules: StopRules) -> bool:
    """Whether any of the rules holds."""
    strategy, numbers = run.strategy, run.numbers
    values, count = strategy.eigenvalues, int(numbers[GENERATIONS])
    if count >= rules.generations or numbers[FLAT] > _MOST_FLAT:
        return True
    if not values[len(values) - 1] <= _MAX_CONDITION * values[0]:
        return True
    spread = run.values[run.order[0]] - run.values[run.order[len(run.order) - 1]]
    recent = _spread(run.history[0], max(count - rules.recent, 0), count)
    if spread < rules.tolfun and recent < rules.tolfun:
        return True
    if count > _SHORTEST_HISTORY and recent < rules.tolfunhist:
        return True
    return _step_ends(strategy, rules) or _stagnates(run, rules, count)


@inner
def _spread(costs: FloatArray, first: int, last: int) -> float:
    """Highest less lowest of costs from `first` to before `last`."""
    lowest = highest = costs[first]
    for i in range(first, last):
        lowest, highest = min(lowest, costs[i]), max(highest, costs[i])
    return highest - lowest


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
