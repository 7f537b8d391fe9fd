"""CHSEL: gradient descent, then quality-diversity search over an archive (Alg. 1)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_settings import CostSettings
from chsel.cost.objective import Objective
from chsel.methods.anchor_sampling import AnchoredStarts, anchored_starts
from chsel.methods.gradient_descent import DescentSettings, descend
from chsel.methods.method import ConfiguredMethod
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import Hypotheses, Observer, RegistrationProblem
from chsel.problem.search_space import PlaneSettings, search_space
from chsel.problem.settings import CheckedSettings, Presets, at_most, one_of, positive
from chsel.problem.streams import Purpose, normals
from chsel.qd.archive import GridArchive, evaluated
from chsel.qd.emitters import SEARCHES, EmitterSettings, fill_archive
from chsel.qd.measures import measure_named
from chsel.qd.selection import (
    ArchiveSettings,
    OutputSettings,
    ranked_hypotheses,
    select_elites,
    sized_archive,
    within_workspace,
)

MOST_PASSES = 10_000
_BEST = 0.2  # of the estimates: those that the next pass starts around
# Most starts end in minima that nobody asks for: many, of which few go on.
_DESCENT = DescentSettings(restarts=5, stop_below=None, race=(1.0, 0.5, 0.25))
_EMITTER = EmitterSettings(iterations=30)


@dataclass(frozen=True)
class ChselSettings(CheckedSettings):
    """Settings of CHSEL."""

    search: Annotated[str, one_of(*SEARCHES)] = "cma_mega"  # emitter of lines 5 and 6
    passes: Annotated[int, positive, at_most(MOST_PASSES)] = 1  # each around the best of the last
    cost: CostSettings = field(default_factory=CostSettings)  # the relaxed cost
    descent: DescentSettings = _DESCENT  # of line 1
    archive: ArchiveSettings = field(default_factory=ArchiveSettings)  # of lines 2 and 3
    emitter: EmitterSettings = _EMITTER  # of lines 4 to 6
    output: OutputSettings = field(default_factory=OutputSettings)  # of line 7
    # E_0 and E_l of the next problem.
    online: OnlineSettings = field(default_factory=OnlineSettings)
    starts: AnchoredStarts | None = field(default_factory=AnchoredStarts)  # beside E_0
    plane: PlaneSettings | None = None  # restricts the poses to SE(2)

    presets: ClassVar[Presets] = {
        "paper": {
            "starts": None,
            "descent": {"restarts": 10, "race": None},
            "emitter": {"iterations": 100},
        },
        "reference": {
            "starts": None,
            "descent": {"restarts": 10, "race": None, "stop_below": 1e-6},
            "emitter": {"iterations": 100},
        },
    }


class Chsel(ConfiguredMethod[ChselSettings]):
    """Registers by Algorithm 1 of the paper."""

    settings_class = ChselSettings

    def _hypotheses(self, problem: RegistrationProblem, observer: Observer) -> Hypotheses:
        algorithm = _Algorithm1(problem, self.settings, observer=observer)
        initial_set, low_cost_set = Poses.of(problem.initial_set), Poses.of(problem.low_cost_set)
        hypotheses = algorithm.run(initial_set, low_cost_set, index=0)
        for index in range(1, self.settings.passes):
            initial_set = algorithm.resampled_around_best(hypotheses, index)
            hypotheses = algorithm.run(initial_set, Poses.of(hypotheses.elites), index=index)
        return hypotheses


class _Algorithm1:
    """Algorithm 1 of the paper on one problem. index: of the pass."""

    def __init__(
        self, problem: RegistrationProblem, settings: ChselSettings, *, observer: Observer
    ) -> None:
        self.problem = problem
        self.settings = settings
        self.observer = observer
        self.space = search_space(settings.plane, problem.sdf)
        self.objective = Objective(CompiledCost.of(problem, settings.cost), self.space)
        self.measure = measure_named(settings.archive.measure, planar=settings.plane is not None)

    def run(self, initial_set: Poses, low_cost_set: Poses, *, index: int) -> Hypotheses:
        """Return hypotheses from E_0 and E_l, line by line."""
        objective = self.objective
        space = self.space
        measure = self.measure
        settings = self.settings.archive
        known_count = len(self.problem.points.known)
        # 1: E' <- SGD on E_0 with C^
        vectors, costs = self.sgd(initial_set, index)
        # 2: P <- m(E')
        estimates = evaluated(objective, measure, vectors=vectors, costs=costs)
        # 3: mu, sigma <- mean and standard deviation of P
        # 4: M <- grid with dimensions mu +- b_sigma sigma
        archive = sized_archive(
            estimates,
            measure,
            settings=settings,
            known_count=known_count,
            dimension=space.dimension,
        )
        # 5: M <- UpdateCells(M, E' and E_l)
        archive.update_cells(
            estimates, evaluated(objective, measure, vectors=space.encode(low_cost_set))
        )
        # 6: M <- CMA-MEGA(M, C^, n_o)
        self.cma_mega(archive, initial_set, index=index)
        # 7: E <- |E_0| of the cells of M with the lowest costs
        return self.lowest_cost_cells(archive, index)

    def sgd(self, initial_set: Poses, index: int) -> tuple[FloatArray, FloatArray]:
        """Return line 1, on further starts too if there are any: vectors (B, d) and costs (B,)."""
        settings, starts = self.settings, initial_set
        if settings.starts is not None:
            anchored = anchored_starts(
                self.problem, self.space, settings=settings.starts, index=index
            )
            starts = Poses.joined([initial_set, anchored])
        estimates, costs = descend(
            self.objective, starts, settings=settings.descent, observer=self.observer
        )
        inside = self.within_workspace(estimates)
        return self.space.encode(estimates[inside]), costs[inside]

    def cma_mega(self, archive: GridArchive, initial_set: Poses, *, index: int) -> None:
        """Run line 6, or CMA-ME in its place."""
        settings = self.settings.emitter
        start = archive.best_solution
        if settings.start == "initial":
            start = self.space.encode(initial_set[:1])[0]
        key = self.problem.key
        count = len(initial_set)
        fill_archive(
            self.settings.search,
            self.objective,
            archive=archive,
            start=start,
            count=count,
            settings=settings,
            key=key,
            observer=self.observer,
            refinement=index,
        )

    def lowest_cost_cells(self, archive: GridArchive, index: int) -> Hypotheses:
        """Return line 7."""
        problem = self.problem
        space = self.space
        output = self.settings.output
        last = archive.snapshot(self.settings.emitter.iterations, index)
        elites = space.poses(last.solutions)
        stream = problem.key.stream(Purpose.RESAMPLE, index)
        chosen = select_elites(
            -last.objectives, elites, problem=problem, space=space, settings=output, stream=stream
        )
        kept = elites[self.within_workspace(elites)]
        return ranked_hypotheses(
            self.objective, elites[chosen], cells=last.cells[chosen], elites=kept, archive=last
        )

    def within_workspace(self, poses: Poses) -> BoolArray:
        """Return True (B,) for the poses to keep."""
        return within_workspace(
            poses, self.problem, space=self.space, margin=self.settings.output.margin
        )

    def resampled_around_best(self, estimates: Hypotheses, index: int) -> Poses:
        """Return E_0 of a further pass, drawn around the best fifth of B estimates.

        By mean and deviation (ddof 1) of each coordinate of the search vectors; the best fifth
        itself comes first, unchanged.
        """
        count = len(estimates.cost)
        space = self.space
        best = np.argsort(estimates.cost, kind="stable")[: max(1, int(_BEST * count))]
        vectors = space.encode(Poses.of(estimates.object_from_world[best]))
        deviation = vectors.std(axis=0, ddof=1) if len(best) > 1 else np.zeros(space.dimension)
        stream = self.problem.key.stream(Purpose.REFINEMENT, index)
        drawn = vectors.mean(axis=0) + deviation * normals(stream, (count, space.dimension))
        drawn[: len(best)] = vectors
        return space.poses(drawn)
