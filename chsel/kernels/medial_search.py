"""The iterations of CMA-ME on the Medial Constraint cost."""

from __future__ import annotations

from typing import Any

import numpy as np

from chsel.arrays import FloatArray
from chsel.kernels.archive import Batch, Cells, all_finite, insert, rank
from chsel.kernels.compiler import compiled, spliced
from chsel.kernels.emitters import MeSearch, move_to_elite
from chsel.kernels.evolution import ask, reset, stopped, tell
from chsel.kernels.measures import measures_of
from chsel.kernels.medial import cost_of


@compiled
def medial_cma_me(
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
    """Iterations of CMA-ME, as chsel.kernels.emitters.cma_me has them, on another objective.

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
