"""The two searches that fill the archive: CMA-MEGA and CMA-ME (CHSEL, Alg. 1, line 6)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np

from chsel.cost.objective import Objective
from chsel.errors import require_at_most, require_choice, require_positive
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.problem.registration_problem import Observer
from chsel.problem.search_space import SearchSpace
from chsel.problem.settings import Presets
from chsel.problem.streams import Purpose, StreamKey, normals
from chsel.qd import emitter_kernels as kernels
from chsel.qd.archive import GridArchive
from chsel.qd.emitter_kernels import me_search, mega_search

MOST_ITERATIONS = 1_000_000
_MOST_DRAWN = 4_000_000  # normal draws held at once, 8 bytes each


@dataclass(frozen=True)
class EmitterSettings:
    """Settings of a search.

    iterations: n_o. sigma0: first step size, of the gradient coefficients for CMA-MEGA, of the
    search vector for CMA-ME. rate: of the Adam ascent of CMA-MEGA. start: the first solution,
    "best" of E' and E_l, or "initial", the first element of E_0. ribs_parity: see
    chsel.qd.evolution_kernels.Strategy.
    """

    iterations: int = 100
    sigma0: float = 0.005
    rate: float = 0.01
    start: str = "best"
    ribs_parity: bool = False

    presets: ClassVar[Presets] = {
        "paper": {"sigma0": 1.0, "rate": 0.05, "start": "initial"},
        "reference": {"sigma0": 1.0, "rate": 0.05, "start": "initial", "ribs_parity": True},
    }

    def __post_init__(self) -> None:
        require_positive("iterations", self.iterations, zero=True)
        require_at_most("iterations", self.iterations, MOST_ITERATIONS)
        require_positive("sigma0", self.sigma0)
        require_positive("rate", self.rate)
        require_choice("start", self.start, ("best", "initial"))


@dataclass(frozen=True)
class Draws:
    """The random numbers of one search; none depends on what the search does with others."""

    key: StreamKey
    refinement: int = 0

    def normals(self, iterations: int, batch: int, dimension: int) -> FloatArray:
        """Standard normal draws (iterations, batch, dimension) for the evolution strategy."""
        none = np.zeros((0, batch, dimension))
        return np.concatenate([none, *self.blocks(iterations, batch, dimension)])

    def blocks(self, iterations: int, batch: int, dimension: int) -> Iterator[FloatArray]:
        """The same draws, as many iterations at a time as `block` says."""
        stream = self.key.stream(Purpose.EMITTER, self.refinement)
        size = self.block(batch, dimension)
        for first in range(0, iterations, size):
            yield normals(stream, (min(size, iterations - first), batch, dimension))

    @staticmethod
    def block(batch: int, dimension: int) -> int:
        """Iterations that are drawn at a time: 10 or a multiple, so that no pair is torn."""
        step = ArchiveWatch.trace_interval
        return max(1, min(100, _MOST_DRAWN // (step * batch * dimension))) * step

    def elites(self, iterations: int) -> FloatArray:
        """Uniform draws (iterations,) that choose an elite for a restart."""
        return self.key.stream(Purpose.RESTART, self.refinement).random(iterations)


class Searched(Protocol):
    """What a search minimises: the cost of the vectors of a search space."""

    space: SearchSpace
    model: Any
    space_arrays: Any

    def work(self) -> Any:
        """Scratch for one thread."""

    def costs(self, vectors: FloatArray) -> FloatArray:
        """Costs (B,) of vectors (B, d)."""


def update_cells(
    archive: GridArchive,
    objective: Searched,
    vectors: FloatArray,
    costs: FloatArray | None = None,
) -> tuple[IntArray, FloatArray]:
    """Offer search vectors (B, d) to the archive; status and value (B,) as GridArchive.add gives.

    costs (B,): theirs, where they are known already.
    """
    costs = objective.costs(vectors) if costs is None else costs
    return archive.add(vectors, -costs, archive.measure.values(objective.space, vectors))


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
    batch, measures = max(count - 1, 1), archive.measure.count
    search = mega_search(
        start,
        measures,
        batch,
        sigma0=settings.sigma0,
        rate=settings.rate,
        ribs_parity=settings.ribs_parity,
    )
    shape = settings.iterations, batch, measures + 1
    _iterate(kernels.cma_mega, objective, archive, search, shape, draws, watch)


def cma_me(
    objective: Searched,
    archive: GridArchive,
    start: FloatArray,
    count: int,
    settings: EmitterSettings,
    draws: Draws,
    watch: ArchiveWatch,
    iterations: Callable[..., None] | None = None,
) -> None:
    """Fill the archive by an evolution strategy on the search vectors (Fontaine et al., 2020).

    start (d,): the first mean. An iteration evaluates count samples. iterations: the kernel, of
    an objective that is not the relaxed cost.
    """
    search = me_search(
        start,
        archive.measure.count,
        count,
        sigma0=settings.sigma0,
        ribs_parity=settings.ribs_parity,
    )
    shape = settings.iterations, count, len(start)
    _iterate(iterations or kernels.cma_me, objective, archive, search, shape, draws, watch)


def _iterate(
    iterations: Callable[..., None],
    objective: Searched,
    archive: GridArchive,
    search: Any,
    shape: tuple[int, int, int],
    draws: Draws,
    watch: ArchiveWatch,
) -> None:
    """Run the iterations of a kernel with normal draws of a shape, segment by segment."""
    total, batch, dimension = shape
    problem = objective.model, objective.space_arrays, archive.measure.code, objective.work()
    normals, elites = draws.blocks(total, batch, dimension), draws.elites(total)
    size = draws.block(batch, dimension)
    for first, last in watch.segments(total):
        if first % size == 0:
            drawn, uniform = next(normals), elites[first : first + size]
        place = first % size, last - first // size * size
        iterations(*problem, archive.cells, search, drawn, uniform, *place)
        watch.after(last, total, archive)


class ArchiveWatch:
    """Tells an observer of the archive: traces every 10 iterations, snapshots at its interval."""

    trace_interval = 10

    def __init__(self, observer: Observer, refinement: int, stage: str) -> None:
        self._observer = observer
        self._refinement = refinement
        self._stage = stage

    def start(self, archive: GridArchive) -> None:
        """The archive is seeded."""
        self._observer.trace(self._stage, 0, archive.solutions, archive.costs)
        self._observer.snapshot(archive.snapshot(0, self._refinement))

    def segments(self, total: int) -> Iterator[tuple[int, int]]:
        """The iterations (first, last) to be run before each word to the observer, of `total`."""
        first = 0
        while first < total:
            last = min(self._next(first, self.trace_interval), total)
            if self._observer.snapshot_interval:
                last = min(last, self._next(first, self._observer.snapshot_interval))
            yield first, last
            first = last

    @staticmethod
    def _next(iteration: int, interval: int) -> int:
        """The first multiple of the interval after an iteration."""
        return (iteration // interval + 1) * interval

    def after(self, iteration: int, total: int, archive: GridArchive) -> None:
        """An iteration has ended."""
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
