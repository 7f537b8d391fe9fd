"""The iterations of CMA-MEGA and CMA-ME."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.cost.objective import (
    BETA1,
    BETA2,
    EPSILON,
    adam_step,
    cost_and_gradient_of,
    cost_of,
)
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.compiler import compiled, inner, spliced
from chsel.qd.archive import (
    Batch,
    Cells,
    all_finite,
    batch_of,
    cell_for,
    insert,
    keep_better,
    rank,
    sampled_cell,
)
from chsel.qd.evolution_kernels import Strategy, ask, reset, stopped, strategy_around, tell
from chsel.qd.measures import measure_gradients_of, measures_of

_EPSILON = 1e-8  # keeps the normalisation of a zero gradient finite


class Adam(NamedTuple):
    """State of Adam (see adam_step): moments (2, d); powers (2,) of the two betas."""

    rate: float
    epsilon: float
    moments: FloatArray
    powers: FloatArray


class MegaSearch(NamedTuple):
    """State of CMA-MEGA: theta (d,) with its measures (k,), and the branches around it.

    gradient (d,) of the cost at theta and measure_gradients (k, d) give directions (k + 1, d), of
    the objective first, whose coefficients (L, k + 1) the strategy adapts. adam moves theta.
    """

    theta: FloatArray
    measures: FloatArray
    gradient: FloatArray
    measure_gradients: FloatArray
    directions: FloatArray
    coefficients: FloatArray
    branches: Batch
    strategy: Strategy
    adam: Adam


class MeSearch(NamedTuple):
    """State of CMA-ME: the strategy adapts the search vectors themselves."""

    samples: Batch
    strategy: Strategy


def mega_search(
    start: FloatArray,
    measures: int,
    batch: int,
    *,
    sigma0: float,
    rate: float,
    ribs_parity: bool = False,
    epsilon: float = EPSILON,
) -> MegaSearch:
    """CMA-MEGA at theta = start (d,), with so many measures and branches; epsilon is Adam's."""
    d, n = len(start), measures + 1
    return MegaSearch(
        theta=np.array(start, dtype=np.float64),
        measures=np.zeros(measures),
        gradient=np.zeros(d),
        measure_gradients=np.zeros((measures, d)),
        directions=np.zeros((n, d)),
        coefficients=np.zeros((batch, n)),
        branches=batch_of(batch, d, measures),
        strategy=strategy_around(np.zeros(n), batch, sigma0, ribs_parity=ribs_parity),
        adam=Adam(float(rate), float(epsilon), np.zeros((2, d)), np.ones(2)),
    )


def me_search(
    start: FloatArray, measures: int, batch: int, *, sigma0: float, ribs_parity: bool = False
) -> MeSearch:
    """CMA-ME around start (d,), with so many measures and samples."""
    strategy = strategy_around(start, batch, sigma0, ribs_parity=ribs_parity)
    return MeSearch(batch_of(batch, len(start), measures), strategy)


@compiled
def cma_mega(
    model: Any,
    space: Any,
    measure: Any,
    work: Any,
    archive: Cells,
    search: MegaSearch,
    normals: FloatArray,
    elites: FloatArray,
    first: int,
    last: int,
) -> None:
    """Iterations of CMA-MEGA (Fontaine and Nikolaidis, 2021) from `first` to before `last`.

    normals (iterations, L, k + 1); elites (iterations,): uniform numbers that choose one.
    """
    theta, measures, gradient = search.theta, search.measures, search.gradient
    measure_gradients, directions = search.measure_gradients, search.directions
    coefficients, branches, strategy = search.coefficients, search.branches, search.strategy
    for iteration in range(first, last):
        objective = -cost_and_gradient_of(model, space, theta, gradient, work)
        measures_of(space, measure, theta, measures)
        measure_gradients_of(space, measure, theta, measure_gradients)
        keep_better(
            archive, cell_for(archive, objective, theta, measures), objective, theta, measures
        )
        _normalise(gradient, -1.0, directions[0])
        for i in range(len(measures)):
            _normalise(measure_gradients[i], 1.0, directions[i + 1])
        ask(strategy, normals[iteration], coefficients)
        _branch(theta, directions, coefficients, branches.vectors)
        _evaluate(model, space, measure, branches, work)
        insert(archive, branches)
        parents = rank(branches.status, branches.value, branches.order)
        tell(strategy, coefficients, branches.order, parents)
        if parents == 0 or stopped(strategy, branches.order, branches.status, branches.value):
            move_to_elite(archive, elites[iteration], theta)
            _forget(search.adam)
            reset(strategy)
            strategy.mean[:] = 0.0
        else:
            weights = strategy.weights
            _move_towards(theta, branches.vectors, branches.order, weights, parents, search.adam)


@compiled
def cma_me(
    model: Any,
    space: Any,
    measure: Any,
    work: Any,
    archive: Cells,
    search: MeSearch,
    normals: FloatArray,
    elites: FloatArray,
    first: int,
    last: int,
) -> None:
    """Iterations of CMA-ME (Fontaine et al., 2020) from `first` to before `last`.

    normals (iterations, L, d); elites (iterations,): uniform numbers that choose one.
    """
    samples, strategy = search.samples, search.strategy
    for iteration in range(first, last):
        ask(strategy, normals[iteration], samples.vectors)
        _evaluate(model, space, measure, samples, work)
        insert(archive, samples)
        parents = rank(samples.status, samples.value, samples.order)
        tell(strategy, samples.vectors, samples.order, parents)
        if parents == 0 or stopped(strategy, samples.order, samples.status, samples.value):
            move_to_elite(archive, elites[iteration], strategy.mean)
            reset(strategy)


@spliced
def _evaluate(model: Any, space: Any, measure: Any, batch: Batch, work: Any) -> None:
    """Fill objectives and measures; a vector that is not finite is not looked up anywhere."""
    vectors, objectives, measures = batch.vectors, batch.objectives, batch.measures
    for i in range(len(objectives)):
        vector = vectors[i]
        if all_finite(vector):
            objectives[i] = -cost_of(model, space, vector, work)
            measures_of(space, measure, vector, measures[i])
        else:
            objectives[i] = -np.inf


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
def _branch(
    theta: FloatArray, directions: FloatArray, coefficients: FloatArray, out: FloatArray
) -> None:
    """Fill out (L, d) with theta + sum_i c_i g_i: coefficients c (L, n), directions g (n, d)."""
    for b in range(len(out)):
        for j in range(len(theta)):
            total = 0.0
            for i in range(len(directions)):
                total += coefficients[b, i] * directions[i, j]
            out[b, j] = theta[j] + total


@inner
def move_to_elite(archive: Cells, uniform: float, vector: FloatArray) -> None:
    """Make a vector (d,) that of an elite, chosen by a number from [0, 1), if there is any."""
    cell = sampled_cell(archive.objectives, uniform)
    if cell >= 0:
        for j in range(len(vector)):
            vector[j] = archive.solutions[cell, j]


@inner
def _move_towards(
    theta: FloatArray,
    vectors: FloatArray,
    order: IntArray,
    weights: FloatArray,
    parents: int,
    adam: Adam,
) -> None:
    """One step of Adam from theta to the weighted mean of the parents."""
    moments, powers = adam.moments, adam.powers
    powers[0] *= BETA1
    powers[1] *= BETA2
    for j in range(len(theta)):
        towards = 0.0
        for i in range(parents):
            towards += weights[i] * (vectors[order[i], j] - theta[j])
        theta[j] += adam_step(towards, moments, j, powers, adam.rate, adam.epsilon)


@inner
def _forget(adam: Adam) -> None:
    """Start Adam again."""
    for j in range(adam.moments.shape[1]):
        adam.moments[0, j] = adam.moments[1, j] = 0.0
    adam.powers[0] = adam.powers[1] = 1.0
