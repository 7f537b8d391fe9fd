"""The two searches that fill the archive: CMA-MEGA and CMA-ME (CHSEL, Alg. 1, line 6)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from chsel.cost.objective import EPSILON, Objective
from chsel.numerics.arrays import FloatArray
from chsel.problem.registration_problem import NullObserver, Observer
from chsel.problem.settings import CheckedSettings, Presets, at_most, not_negative, one_of, positive
from chsel.problem.streams import Purpose, StreamKey, normals
from chsel.qd import emitter_kernels as kernels
from chsel.qd.archive import GridArchive, SearchObjective, batch_of
from chsel.qd.emitter_kernels import Adam, Landscape, MegaSearch, MeSearch, SearchDraws
from chsel.qd.evolution_kernels import strategy_around

MOST_ITERATIONS = 1_000_000
_MOST_DRAWN = 4_000_000  # normal draws held at once, 8 bytes each


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


@dataclass(frozen=True)
class Draws:
    """The random numbers of one search; none depends on how others are used."""

    key: StreamKey
    refinement: int = 0  # index of the pass

    def blocks(self, iterations: int, batch: int, dimension: int) -> Iterator[FloatArray]:
        """Standard normal draws for the strategy, `block` iterations at a time.

        Each has shape (iterations, batch, dimension).
        """
        stream = self.key.stream(Purpose.EMITTER, self.refinement)
        size = self.block(batch, dimension)
        for first in range(0, iterations, size):
            yield normals(stream, (min(size, iterations - first), batch, dimension))

    @staticmethod
    def block(batch: int, dimension: int) -> int:
        """Iterations that are drawn at a time: a multiple of 10, so that no pair is split."""
        step = ArchiveWatch.trace_interval
        return max(1, min(100, _MOST_DRAWN // (step * batch * dimension))) * step

    def elites(self, iterations: int) -> FloatArray:
        """Uniform draws (iterations,) that choose an elite for a restart."""
        return self.key.stream(Purpose.RESTART, self.refinement).random(iterations)


def mega_search(
    start: FloatArray,
    measures: int,
    batch: int,
    settings: EmitterSettings,
    epsilon: float = EPSILON,
) -> MegaSearch:
    """CMA-MEGA at theta = start (d,), with so many measures and branches; epsilon is Adam's."""
    d, n = len(start), measures + 1
    parity = settings.ribs_parity
    return MegaSearch(
        theta=np.array(start, dtype=np.float64),
        measures=np.zeros(measures),
        gradient=np.zeros(d),
        measure_gradients=np.zeros((measures, d)),
        directions=np.zeros((n, d)),
        coefficients=np.zeros((batch, n)),
        branches=batch_of(batch, d, measures),
        strategy=strategy_around(np.zeros(n), batch, settings.sigma0, ribs_parity=parity),
        adam=Adam(float(settings.rate), float(epsilon), np.zeros((2, d)), np.ones(2)),
    )


def me_search(start: FloatArray, measures: int, batch: int, settings: EmitterSettings) -> MeSearch:
    """CMA-ME around start (d,), with so many measures and samples."""
    parity = settings.ribs_parity
    strategy = strategy_around(start, batch, settings.sigma0, ribs_parity=parity)
    return MeSearch(batch_of(batch, len(start), measures), strategy)


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
    search = mega_search(start, archive.measure.count, max(count - 1, 1), settings)
    _iterate(kernels.cma_mega, objective, archive, search, settings.iterations, draws, watch)


def cma_me(
    objective: SearchObjective,
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
    search = me_search(start, archive.measure.count, count, settings)
    _iterate(kernels.cma_me, objective, archive, search, settings.iterations, draws, watch)


def _iterate(
    kernel: Callable[..., None],
    objective: SearchObjective,
    archive: GridArchive,
    search: MegaSearch | MeSearch,
    iterations: int,
    draws: Draws,
    watch: ArchiveWatch,
) -> None:
    """Run the iterations of a kernel, segment by segment."""
    batch, dimension = search.strategy.batch, len(search.strategy.mean)
    model, space = objective.model, objective.space_arrays
    landscape = Landscape(model, space, archive.measure.code, objective.work())
    normals, elites = draws.blocks(iterations, batch, dimension), draws.elites(iterations)
    drawn = draws.block(batch, dimension)
    watch.start(archive)
    for first, last in watch.segments(iterations, drawn):
        if first % drawn == 0:
            block = SearchDraws(next(normals), elites[first : first + drawn])
        before = first - first % drawn
        kernel(landscape, archive.cells, search, block, first - before, last - before)
        watch.after(last, iterations, archive)


class ArchiveWatch:
    """Shows an observer the archive: traces every 10 iterations, snapshots at its interval."""

    trace_interval = 10

    def __init__(self, observer: Observer, refinement: int, stage: str) -> None:
        self._observer = observer
        self._refinement = refinement
        self._stage = stage
        self._nobody_watches = type(observer) is NullObserver

    def start(self, archive: GridArchive) -> None:
        """Show the archive before the first iteration."""
        if self._nobody_watches:
            return
        self._observer.trace(self._stage, 0, archive.solutions, archive.costs)
        self._observer.snapshot(archive.snapshot(0, self._refinement))

    def segments(self, total: int, most: int = trace_interval) -> Iterator[tuple[int, int]]:
        """The iterations (first, last), of `total`, between two calls of the observer.

        most: of a segment if nobody watches.
        """
        first, interval = 0, most if self._nobody_watches else self.trace_interval
        while first < total:
            last = min(self._next(first, interval), total)
            if self._observer.snapshot_interval:
                last = min(last, self._next(first, self._observer.snapshot_interval))
            yield first, last
            first = last

    @staticmethod
    def _next(iteration: int, interval: int) -> int:
        """The first multiple of the interval after an iteration."""
        return (iteration // interval + 1) * interval

    def after(self, iteration: int, total: int, archive: GridArchive) -> None:
        """Show the archive after an iteration, where it is due."""
        if self._nobody_watches:
            return
        interval = self._observer.snapshot_interval
        if iteration % self.trace_interval == 0 or iteration == total:
            self._observer.trace(self._stage, iteration, archive.solutions, archive.costs)
            self._observer.progress(self._stage, iteration, total)
        if iteration == total or (interval and iteration % interval == 0):
            self._observer.snapshot(archive.snapshot(iteration, self._refinement))


Search = Callable[
    [Objective, GridArchive, FloatArray, int, EmitterSettings, Draws, ArchiveWatch], None
]
SEARCHES: dict[str, Search] = {"cma_mega": cma_mega, "cma_me": cma_me}
