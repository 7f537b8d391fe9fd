"""CHSEL: gradient descent, then quality-diversity search over an archive (Alg. 1)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_settings import CostSettings
from chsel.cost.objective import Objective
from chsel.errors import require_at_most, require_choice, require_positive
from chsel.methods.anchored.anchor_sampling import AnchoredStarts, anchored_starts
from chsel.methods.gradient_descent import DescentSettings, descend
from chsel.numerics.arrays import FloatArray
from chsel.problem.online_registration import OnlineSettings
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import (
    Hypotheses,
    NullObserver,
    Observer,
    RegistrationProblem,
)
from chsel.problem.search_space import PlaneSettings, SearchSpace, search_space
from chsel.problem.settings import Presets
from chsel.problem.streams import Purpose, normals
from chsel.qd.emitters import SEARCHES, ArchiveWatch, Draws, EmitterSettings, update_cells
from chsel.qd.measures import measure_named
from chsel.qd.selection import (
    ArchiveSettings,
    OutputSettings,
    ranked_hypotheses,
    select_elites,
    sized_archive,
    within_workspace,
)

_BEST = 0.2


def resampled_around_best(
    estimates: Poses, costs: FloatArray, space: SearchSpace, stream: np.random.Generator
) -> Poses:
    """Poses drawn around the best fifth of B estimates with costs (B,).

    Mean and deviation (ddof 1) of each coordinate of the search vectors; the best fifth itself
    comes first, unchanged.
    """
    count = len(estimates)
    best = np.argsort(costs, kind="stable")[: max(1, int(_BEST * count))]
    vectors = space.encode(estimates[best])
    deviation = vectors.std(axis=0, ddof=1) if len(best) > 1 else np.zeros(space.dimension)
    drawn = vectors.mean(axis=0) + deviation * normals(stream, (count, space.dimension))
    drawn[: len(best)] = vectors
    return space.poses(drawn)


MOST_PASSES = 10_000


@dataclass(frozen=True)
class ChselSettings:
    """All settings of CHSEL.

    search: "cma_mega" or "cma_me". passes: repetitions of the whole, each from a Gaussian around
    the best members of the one before. starts: those beside E_0. plane: restricts the poses to
    SE(2).
    """

    search: str = "cma_mega"
    passes: int = 1
    cost: CostSettings = field(default_factory=CostSettings)
    descent: DescentSettings = field(default_factory=DescentSettings)
    archive: ArchiveSettings = field(default_factory=ArchiveSettings)
    emitter: EmitterSettings = field(default_factory=EmitterSettings)
    output: OutputSettings = field(default_factory=OutputSettings)
    online: OnlineSettings = field(default_factory=OnlineSettings)
    starts: AnchoredStarts | None = field(default_factory=AnchoredStarts)
    plane: PlaneSettings | None = None

    presets: ClassVar[Presets] = {"paper": {"starts": None}, "reference": {"starts": None}}

    def __post_init__(self) -> None:
        require_choice("search", self.search, SEARCHES)
        require_positive("passes", self.passes)
        require_at_most("passes", self.passes, MOST_PASSES)
        measure_named(self.archive.measure, planar=self.plane is not None)


class Chsel:
    """Registers by Algorithm 1 of the paper."""

    def __init__(self, settings: ChselSettings | None = None) -> None:
        self.settings = settings or ChselSettings()
        planar = self.settings.plane is not None
        self._measure = measure_named(self.settings.archive.measure, planar=planar)
        self._search = SEARCHES[self.settings.search]

    @property
    def online(self) -> OnlineSettings:
        """How a session makes the next problem."""
        return self.settings.online

    def register(
        self, problem: RegistrationProblem, observer: Observer | None = None
    ) -> Hypotheses:
        """Hypotheses for the known points of a problem, best first."""
        observer = observer or NullObserver()
        space = search_space(self.settings.plane, problem.sdf)
        objective = Objective(CompiledCost.of(problem, self.settings.cost), space)
        estimates = self._algorithm_1(
            problem,
            objective,
            Poses.of(problem.initial_set),
            Poses.of(problem.low_cost_set),
            0,
            observer,
        )
        for index in range(1, self.settings.passes):
            stream = problem.key.stream(Purpose.REFINEMENT, index)
            poses = Poses.of(estimates.object_from_world)
            initial_set = resampled_around_best(poses, estimates.cost, space, stream)
            low_cost_set = Poses.of(estimates.elites)
            estimates = self._algorithm_1(
                problem, objective, initial_set, low_cost_set, index, observer
            )
        return estimates

    def _algorithm_1(
        self,
        problem: RegistrationProblem,
        objective: Objective,
        initial_set: Poses,
        low_cost_set: Poses,
        index: int,
        observer: Observer,
    ) -> Hypotheses:
        """Algorithm 1, line by line."""
        settings, space, measure = self.settings, objective.space, self._measure
        known_count, count = len(problem.points.known), len(initial_set)
        starts = initial_set
        if settings.starts is not None:
            more = anchored_starts(problem, space, settings.starts, index)
            starts = Poses.joined([initial_set, more])
        # 1: E' <- SGD on E_0, and on further starts if there are any, with C^
        estimates, costs = descend(objective, starts, settings.descent, observer)
        inside = within_workspace(estimates, problem, space, settings.output.margin)
        estimates, costs = estimates[inside], costs[inside]
        # 2: P <- m(E')
        vectors = space.encode(estimates)
        measures = measure.values(space, vectors)
        # 3, 4: M <- grid with dimensions mean(P) +- b_sigma std(P)
        archive = sized_archive(
            measure, measures, costs, settings.archive, known_count, space.dimension
        )
        # 5: M <- UpdateCells(M, E' and E_l)
        update_cells(archive, objective, vectors, costs)
        update_cells(archive, objective, space.encode(low_cost_set))
        # 6: M <- CMA-MEGA(M, C^, n_o)
        first = space.encode(initial_set[:1])[0]
        best = archive.best_solution
        start = first if settings.emitter.start == "initial" else best
        draws, watch = Draws(problem.key, index), ArchiveWatch(observer, index, settings.search)
        watch.start(archive)
        self._search(objective, archive, start, count, settings.emitter, draws, watch)
        # 7: E <- |E_0| of the cells of M with the lowest costs
        stream = problem.key.stream(Purpose.RESAMPLE, index)
        elites = space.poses(archive.solutions)
        chosen = select_elites(archive.costs, elites, problem, space, settings.output, stream)
        snapshot = archive.snapshot(settings.emitter.iterations, index)
        cells = archive.occupied[chosen]
        kept = elites[within_workspace(elites, problem, space, settings.output.margin)]
        return ranked_hypotheses(objective, elites[chosen], cells, kept, snapshot)
