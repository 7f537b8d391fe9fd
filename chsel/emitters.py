"""The two searches that fill the archive: CMA-MEGA and CMA-ME (CHSEL, Alg. 1, line 6)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from chsel.adam import Adam
from chsel.archive import GridArchive
from chsel.arrays import FloatArray, IntArray
from chsel.errors import require_choice, require_positive
from chsel.evolution import EvolutionStrategy, rank_by_improvement, recombination_weights
from chsel.objective import Objective
from chsel.observer import Observer
from chsel.streams import Purpose, StreamKey

_EPSILON = 1e-8  # keeps the normalisation of a zero gradient finite


@dataclass(frozen=True)
class EmitterSettings:
    """Settings of a search.

    iterations: n_o. sigma0: first step size, of the gradient coefficients for CMA-MEGA, of the
    search vector for CMA-ME. rate: of the Adam ascent of CMA-MEGA. start: the first solution,
    "best" of E' and E_l, or "initial", the first element of E_0. ribs_parity: see
    EvolutionStrategy.
    """

    iterations: int = 100
    sigma0: float = 1.0
    rate: float = 0.05
    start: str = "best"
    ribs_parity: bool = False

    def __post_init__(self) -> None:
        require_positive("iterations", self.iterations, zero=True)
        require_positive("sigma0", self.sigma0)
        require_positive("rate", self.rate)
        require_choice("start", self.start, ("best", "initial"))


@dataclass(frozen=True)
class Draws:
    """The random numbers of one search, drawn before its first iteration."""

    key: StreamKey
    refinement: int = 0

    def normals(self, iterations: int, batch: int, dimension: int) -> FloatArray:
        """Standard normal draws (iterations, batch, dimension) for the evolution strategy."""
        stream = self.key.stream(Purpose.EMITTER, self.refinement)
        return stream.standard_normal((iterations, batch, dimension))

    def elites(self, iterations: int) -> FloatArray:
        """Uniform draws (iterations,) that choose an elite for a restart."""
        return self.key.stream(Purpose.RESTART, self.refinement).random(iterations)


def update_cells(
    archive: GridArchive,
    objective: Objective,
    vectors: FloatArray,
    costs: FloatArray | None = None,
) -> tuple[IntArray, FloatArray]:
    """Offer search vectors (B, d) to the archive; status and value (B,) as GridArchive.add gives.

    costs (B,): theirs, where they are known already.
    """
    costs = objective.costs(vectors) if costs is None else costs
    return archive.add(vectors, -costs, objective.measures(archive.measure, vectors))


def _rank(
    archive: GridArchive, objective: Objective, vectors: FloatArray
) -> tuple[IntArray, FloatArray, int]:
    """Offer vectors (B, d): order (B,), best first; ranking values (B, 2); how many improved."""
    status, value = update_cells(archive, objective, vectors)
    order = rank_by_improvement(status, value)
    return order, np.stack([status, value], axis=1)[order], int((status > 0).sum())


def cma_mega(
    objective: Objective,
    archive: GridArchive,
    start: FloatArray,
    count: int,
    settings: EmitterSettings,
    draws: Draws,
    watch: ArchiveWatch,
) -> None:
    """Fill the archive along gradients of cost and measures (Fontaine and Nikolaidis, 2021).

    start (d,): the first theta. An iteration evaluates theta with its gradients, and count - 1
    branches around it.
    """
    batch, coefficients = max(count - 1, 1), archive.measure.count + 1
    normals = draws.normals(settings.iterations, batch, coefficients)
    elites = draws.elites(settings.iterations)
    strategy = EvolutionStrategy(
        coefficients, batch, settings.sigma0, ribs_parity=settings.ribs_parity
    )
    theta, ascent = start, Adam(settings.rate)
    for iteration in range(settings.iterations):
        cost, gradient = objective.costs_and_gradients(theta[None])
        update_cells(archive, objective, theta[None], cost)
        rows = np.vstack([-gradient, objective.measure_gradients(archive.measure, theta)])
        directions = rows / (np.sqrt((rows**2).sum(axis=1, keepdims=True)) + _EPSILON)
        chosen = strategy.ask(normals[iteration])
        branches = theta + (chosen[:, :, None] * directions).sum(axis=1)
        order, ranking, parents = _rank(archive, objective, branches)
        strategy.tell(chosen[order], parents)
        if parents == 0 or strategy.stopped(ranking):
            theta, ascent = archive.sample_elite(elites[iteration]), Adam(settings.rate)
            strategy.reset(np.zeros(coefficients))
        else:
            weights = recombination_weights(parents)[:, None]
            towards = (weights * branches[order[:parents]]).sum(axis=0) - theta
            theta = theta - ascent.step(-towards)
        watch.after("cma_mega", iteration + 1, settings.iterations, archive)


def cma_me(
    objective: Objective,
    archive: GridArchive,
    start: FloatArray,
    count: int,
    settings: EmitterSettings,
    draws: Draws,
    watch: ArchiveWatch,
) -> None:
    """Fill the archive by an evolution strategy on the search vectors (Fontaine et al., 2020).

    start (d,): the first mean. An iteration evaluates count samples.
    """
    dimension = len(start)
    normals = draws.normals(settings.iterations, count, dimension)
    elites = draws.elites(settings.iterations)
    strategy = EvolutionStrategy(
        dimension, count, settings.sigma0, ribs_parity=settings.ribs_parity
    )
    strategy.reset(start)
    for iteration in range(settings.iterations):
        samples = strategy.ask(normals[iteration])
        order, ranking, parents = _rank(archive, objective, samples)
        strategy.tell(samples[order], parents)
        if parents == 0 or strategy.stopped(ranking):
            strategy.reset(archive.sample_elite(elites[iteration]))
        watch.after("cma_me", iteration + 1, settings.iterations, archive)


class ArchiveWatch:
    """Tells an observer of the archive: traces every 10 iterations, snapshots at its interval."""

    trace_interval = 10

    def __init__(self, observer: Observer, refinement: int) -> None:
        self._observer = observer
        self._refinement = refinement

    def start(self, archive: GridArchive) -> None:
        """The archive is seeded."""
        self._observer.snapshot(archive.snapshot(0, self._refinement))

    def after(self, stage: str, iteration: int, total: int, archive: GridArchive) -> None:
        """An iteration has ended."""
        interval = self._observer.snapshot_interval
        if iteration % self.trace_interval == 0 or iteration == total:
            self._observer.trace(stage, iteration, archive.solutions, archive.costs)
            self._observer.progress(stage, iteration, total)
        if iteration == total or (interval and iteration % interval == 0):
            self._observer.snapshot(archive.snapshot(iteration, self._refinement))


Search = Callable[
    [Objective, GridArchive, FloatArray, int, EmitterSettings, Draws, ArchiveWatch], None
]
SEARCHES: dict[str, Search] = {"cma_mega": cma_mega, "cma_me": cma_me}
