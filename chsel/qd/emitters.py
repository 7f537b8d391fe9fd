"""The two searches that fill the archive: CMA-MEGA and CMA-ME (CHSEL, Alg. 1, line 6)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np

from chsel.cost.objective import (
    BETA1,
    BETA2,
    EPSILON,
    adam_step,
    cost_and_gradient_of,
    costs_of,
)
from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import compiled, inner, spliced
from chsel.numerics.pose_tuples import all_finite
from chsel.problem.registration_problem import Observer
from chsel.problem.settings import CheckedSettings, Presets, at_most, not_negative, one_of, positive
from chsel.problem.streams import Purpose, StreamKey, normals
from chsel.qd.archive import (
    Batch,
    Cells,
    GridArchive,
    SearchObjective,
    batch_of,
    cell_for,
    insert,
    keep_better,
    rank,
    sampled_cell,
)
from chsel.qd.evolution_kernels import Strategy, ask, reset, stopped, strategy_around, tell
from chsel.qd.measures import measure_gradients_of, measures_of

SEARCHES = "cma_mega", "cma_me"  # Fontaine and Nikolaidis, 2021; Fontaine et al., 2020
MOST_ITERATIONS = 1_000_000
_TRACED = 10  # iterations between two traces; even, so that no pair of normal numbers is split
_EPSILON = 1e-8  # keeps the normalisation of a zero gradient finite


@dataclass(frozen=True)
class EmitterSettings(CheckedSettings):
    """Settings of a search."""

    iterations: Annotated[int, not_negative, at_most(MOST_ITERATIONS)] = 100  # n_o
    sigma0: Annotated[float, positive] = 0.005  # first step of gradient coefficients or vectors
    rate: Annotated[float, positive] = 0.01  # of the Adam ascent of CMA-MEGA
    # The first solution: the best of E' and E_l, or the first of E_0.
    start: Annotated[str, one_of("best", "initial")] = "best"
    ribs_parity: bool = False  # see chsel.qd.evolution_kernels.Strategy

    presets: ClassVar[Presets] = {
        "paper": {"sigma0": 1.0, "rate": 0.05, "start": "initial"},
        "reference": {"sigma0": 1.0, "rate": 0.05, "start": "initial", "ribs_parity": True},
    }


class Landscape(NamedTuple):
    """Data that search vectors are evaluated by, see SearchObjective."""

    model: Any  # of the cost
    space: Any  # of the vectors
    measure: Any  # MeasureCode
    work: Any  # scratch


class Adam(NamedTuple):
    """State of Adam, see adam_step."""

    rate: float  # step size
    epsilon: float  # added to the root of the second moment
    moments: FloatArray  # (2, d)
    powers: FloatArray  # (2,), of the two betas


class MegaSearch(NamedTuple):
    """State of CMA-MEGA: theta, and the branches around it."""

    theta: FloatArray  # (d,)
    measures: FloatArray  # (k,), at theta
    gradient: FloatArray  # (d,), of the cost at theta
    measure_gradients: FloatArray  # (k, d), at theta
    directions: FloatArray  # (k + 1, d), normalised gradients, that of the objective first
    coefficients: FloatArray  # (L, k + 1), of the directions, which the strategy adapts
    branches: Batch  # of an iteration
    strategy: Strategy  # of the coefficients
    adam: Adam  # moves theta


class MeSearch(NamedTuple):
    """State of CMA-ME: the strategy adapts the search vectors themselves."""

    samples: Batch  # of an iteration
    strategy: Strategy  # of the samples


@compiled
def mega_iterations(landscape, archive, search, normals, elites, first, last):
    """Run iterations of CMA-MEGA (Fontaine and Nikolaidis, 2021) from `first` to before `last`.

    normals: (iterations, L, n) for the strategy. elites: (iterations,) in [0, 1), each of which
    chooses an elite for a restart.
    """
    model, space, measure, work = landscape
    theta = search.theta
    measures = search.measures
    gradient = search.gradient
    measure_gradients, directions = search.measure_gradients, search.directions
    coefficients = search.coefficients
    branches = search.branches
    strategy = search.strategy
    for iteration in range(first, last):
        objective = -cost_and_gradient_of(model, space, theta, gradient, work)
        measures_of(space, measure, theta, measures)
        measure_gradients_of(space, measure, theta, measure_gradients)
        cell = cell_for(archive, objective, theta, measures)
        keep_better(archive, cell, objective, theta, measures)
        _normalise(gradient, -1.0, directions[0])
        for i in range(len(measures)):
            _normalise(measure_gradients[i], 1.0, directions[i + 1])
        ask(strategy, normals[iteration], coefficients)
        _branch(theta, directions, coefficients, branches.vectors)
        _evaluate(landscape, branches)
        insert(archive, branches)
        parents = rank(branches.status, branches.value, branches.order)
        tell(strategy, coefficients, branches.order, parents)
        if parents == 0 or stopped(strategy, branches.order, branches.status, branches.value):
            _move_to_elite(archive, elites[iteration], theta)
            search.adam.moments[:] = 0.0
            search.adam.powers[:] = 1.0
            reset(strategy)
            strategy.mean[:] = 0.0
        else:
            _move_towards(theta, branches, strategy.weights, parents, search.adam)


@compiled
def me_iterations(landscape, archive, search, normals, elites, first, last):
    """Run iterations of CMA-ME (Fontaine et al., 2020) from `first` to before `last`."""
    samples, strategy = search.samples, search.strategy
    for iteration in range(first, last):
        ask(strategy, normals[iteration], samples.vectors)
        _evaluate(landscape, samples)
        insert(archive, samples)
        parents = rank(samples.status, samples.value, samples.order)
        tell(strategy, samples.vectors, samples.order, parents)
        if parents == 0 or stopped(strategy, samples.order, samples.status, samples.value):
            _move_to_elite(archive, elites[iteration], strategy.mean)
            reset(strategy)


@spliced
def _evaluate(landscape: Landscape, batch: Batch) -> None:
    """Fill objectives and measures; a vector that is not finite is looked up nowhere."""
    model, space, measure, work = landscape
    costs_of(model, space, batch.vectors, batch.objectives, work)
    for n in range(len(batch.vectors)):
        if all_finite(batch.vectors[n]):
            batch.objectives[n] = -batch.objectives[n]
            measures_of(space, measure, batch.vectors[n], batch.measures[n])
        else:
            batch.objectives[n] = -np.inf


@inner
def _normalise(gradient: FloatArray, sign: float, out: FloatArray) -> None:
    """Fill out (d,) with the direction of a gradient (d,); zero if its length is not finite."""
    squares = 0.0
    for x in gradient:
        squares += x * x
    length = sign * (np.sqrt(squares) + _EPSILON)
    for j in range(len(gradient)):
        out[j] = gradient[j] / length if np.isfinite(length) else 0.0


@inner
def _branch(theta, directions, coefficients, out):
    """Fill out (L, d) with theta + sum_i c_i g_i: coefficients c (L, n), directions g (n, d)."""
    for b in range(len(out)):
        for j in range(len(theta)):
            total = 0.0
            for i in range(len(directions)):
                total += coefficients[b, i] * directions[i, j]
            out[b, j] = theta[j] + total


@inner
def _move_to_elite(archive: Cells, uniform: float, vector: FloatArray) -> None:
    """Make a vector (d,) that of an elite, chosen by a number from [0, 1), if there is any."""
    cell = sampled_cell(archive.objectives, uniform)
    if cell >= 0:
        for j in range(len(vector)):
            vector[j] = archive.solutions[cell, j]


@inner
def _move_towards(theta, branches, weights, parents, adam):
    """Move theta by a step of Adam to the weighted mean of the best branches, its parents."""
    vectors, order = branches.vectors, branches.order
    moments, powers = adam.moments, adam.powers
    powers[0] *= BETA1
    powers[1] *= BETA2
    for j in range(len(theta)):
        towards = 0.0
        for i in range(parents):
            towards += weights[i] * (vectors[order[i], j] - theta[j])
        theta[j] += adam_step(towards, moments, j, powers, adam.rate, adam.epsilon)


def mega_search(
    start: FloatArray,
    measures: int,
    *,
    batch: int,
    settings: EmitterSettings,
    epsilon: float = EPSILON,
) -> MegaSearch:
    """Return CMA-MEGA at theta = start (d,), of so many measures and branches; Adam's epsilon."""
    d = len(start)
    n = measures + 1
    parity = settings.ribs_parity
    return MegaSearch(
        theta=np.array(start, dtype=np.float64),
        measures=np.zeros(measures),
        gradient=np.zeros(d),
        measure_gradients=np.zeros((measures, d)),
        directions=np.zeros((n, d)),
        coefficients=np.zeros((batch, n)),
        branches=batch_of(batch, d, measures=measures),
        strategy=strategy_around(np.zeros(n), batch, sigma0=settings.sigma0, ribs_parity=parity),
        adam=Adam(
            float(settings.rate), float(epsilon), moments=np.zeros((2, d)), powers=np.ones(2)
        ),
    )


def me_search(
    start: FloatArray, measures: int, *, batch: int, settings: EmitterSettings
) -> MeSearch:
    """Return CMA-ME around start (d,), with so many measures and samples."""
    parity = settings.ribs_parity
    strategy = strategy_around(start, batch, sigma0=settings.sigma0, ribs_parity=parity)
    return MeSearch(batch_of(batch, len(start), measures=measures), strategy)


def fill_archive(
    name: str,
    objective: SearchObjective,
    *,
    archive: GridArchive,
    start: FloatArray,
    count: int,
    settings: EmitterSettings,
    key: StreamKey,
    observer: Observer,
    refinement: int = 0,
) -> None:
    """Fill the archive by one of SEARCHES, of which an iteration evaluates `count` vectors.

    CMA-MEGA: theta, at first `start` (d,), with its gradients, and branches around it. CMA-ME:
    samples of an evolution strategy, whose first mean is `start`. refinement: index of the pass.
    """
    measures = archive.measure.count
    total = settings.iterations
    search: Any = me_search(start, measures, batch=count, settings=settings)
    run = me_iterations
    if name == "cma_mega":
        run = mega_iterations
        search = mega_search(start, measures, batch=max(count - 1, 1), settings=settings)
    batch = search.strategy.batch
    dimension = len(search.strategy.mean)
    model, space = objective.model, objective.space_arrays
    landscape = Landscape(model, space, measure=archive.measure.code, work=objective.work())
    stream = key.stream(Purpose.EMITTER, refinement)
    elites = key.stream(Purpose.RESTART, refinement).random(total)
    interval = observer.snapshot_interval or total
    observer.trace(name, 0, archive.solutions, archive.costs)
    observer.snapshot(archive.snapshot(0, refinement))
    for begin in range(0, total, _TRACED):
        end = min(begin + _TRACED, total)
        draws = normals(stream, (end - begin, batch, dimension))
        parents = elites[begin:end]
        stops = [n for n in range(begin + 1, end) if n % interval == 0]
        for first, last in pairwise([begin, *stops, end]):
            run(landscape, archive.cells, search, draws, parents, first - begin, last - begin)
            if last == end:
                observer.trace(name, last, archive.solutions, archive.costs)
                observer.progress(name, last, total)
            if last == total or last % interval == 0:
                observer.snapshot(archive.snapshot(last, refinement))
