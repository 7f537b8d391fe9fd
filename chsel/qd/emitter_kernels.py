"""The iterations of CMA-MEGA and CMA-ME."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.cost.objective import BETA1, BETA2, adam_step, cost_and_gradient_of, costs_of
from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import compiled, inner, spliced
from chsel.numerics.pose_tuples import all_finite
from chsel.qd.archive import (
    Batch,
    Cells,
    cell_for,
    insert,
    keep_better,
    rank,
    sampled_cell,
)
from chsel.qd.evolution_kernels import Strategy, ask, reset, stopped, tell
from chsel.qd.measures import measure_gradients_of, measures_of

_EPSILON = 1e-8  # keeps the normalisation of a zero gradient finite


class Landscape(NamedTuple):
    """What search vectors are evaluated by, see SearchObjective."""

    model: Any
    space: Any
    measure: Any  # MeasureCode
    work: Any  # scratch


class SearchDraws(NamedTuple):
    """Random numbers of some iterations."""

    normals: FloatArray  # (iterations, L, n), standard normal, for the strategy
    elites: FloatArray  # (iterations,), uniform, each chooses an elite for a restart


class Adam(NamedTuple):
    """State of Adam, see adam_step."""

    rate: float
    epsilon: float
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
    branches: Batch
    strategy: Strategy
    adam: Adam  # moves theta


class MeSearch(NamedTuple):
    """State of CMA-ME: the strategy adapts the search vectors themselves."""

    samples: Batch
    strategy: Strategy


@compiled
def cma_mega(
    landscape: Landscape,
    archive: Cells,
    search: MegaSearch,
    draws: SearchDraws,
    first: int,
    last: int,
) -> None:
    """Iterations of CMA-MEGA (Fontaine and Nikolaidis, 2021) from `first` to before `last`."""
    model, space, measure, work = landscape
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
        ask(strategy, draws.normals[iteration], coefficients)
        _branch(theta, directions, coefficients, branches.vectors)
        _evaluate(landscape, branches)
        insert(archive, branches)
        parents = rank(branches.status, branches.value, branches.order)
        tell(strategy, coefficients, branches.order, parents)
        if parents == 0 or stopped(strategy, branches.order, branches.status, branches.value):
            _move_to_elite(archive, draws.elites[iteration], theta)
            _forget(search.adam)
            reset(strategy)
            strategy.mean[:] = 0.0
        else:
            _move_towards(theta, branches, strategy.weights, parents, search.adam)


@compiled
def cma_me(
    landscape: Landscape,
    archive: Cells,
    search: MeSearch,
    draws: SearchDraws,
    first: int,
    last: int,
) -> None:
    """Iterations of CMA-ME (Fontaine et al., 2020) from `first` to before `last`."""
    samples, strategy = search.samples, search.strategy
    for iteration in range(first, last):
        ask(strategy, draws.normals[iteration], samples.vectors)
        _evaluate(landscape, samples)
        insert(archive, samples)
        parents = rank(samples.status, samples.value, samples.order)
        tell(strategy, samples.vectors, samples.order, parents)
        if parents == 0 or stopped(strategy, samples.order, samples.status, samples.value):
            _move_to_elite(archive, draws.elites[iteration], strategy.mean)
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
def _move_to_elite(archive: Cells, uniform: float, vector: FloatArray) -> None:
    """Make a vector (d,) that of an elite, chosen by a number from [0, 1), if there is any."""
    cell = sampled_cell(archive.objectives, uniform)
    if cell >= 0:
        for j in range(len(vector)):
            vector[j] = archive.solutions[cell, j]


@inner
def _move_towards(
    theta: FloatArray, branches: Batch, weights: FloatArray, parents: int, adam: Adam
) -> None:
    """One step of Adam from theta to the weighted mean of the best branches, its parents."""
    vectors, order = branches.vectors, branches.order
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
