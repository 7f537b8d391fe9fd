"""Contact-anchored search: our own method, for hypotheses that are close to the plausible set."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, NamedTuple

import numpy as np

from chsel.errors import require_at_most
from chsel.methods.anchored.anchor_sampling import (
    AnchorSettings,
    anchored_poses,
    most_informative_first,
)
from chsel.methods.anchored.energy import Energy
from chsel.methods.method import ConfiguredMethod
from chsel.numerics.arrays import FloatArray
from chsel.problem.online_registration import OnlineSettings
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import (
    Hypotheses,
    NullObserver,
    Observer,
    RegistrationProblem,
)
from chsel.problem.search_space import PlaneSettings, origin_bounds, search_space
from chsel.problem.settings import CheckedSettings, at_most, not_negative, one_of, positive
from chsel.problem.subset import evenly_spaced, farthest_poses
from chsel.qd.archive import evaluated
from chsel.qd.measures import measure_named
from chsel.qd.selection import (
    ArchiveSettings,
    measure_range,
    ranked_hypotheses,
    repeated,
    representatives,
    sized_archive,
)

MOST_SAMPLES = 1_000_000_000
MOST_POSES = 1_000_000
MOST_MOVES = 100_000
MOST_WORK = 1_000_000_000  # of the two
_KEPT = 6  # states of a chain
_MOST_GIVEN = 60  # of E_0 and E_l that are fitted
_ARCHIVE = ArchiveSettings(bins=40, outliers="none")
_ONLINE = OnlineSettings(update="own")


@dataclass(frozen=True)
class Effort(CheckedSettings):
    """How much is computed."""

    samples: Annotated[int, positive, at_most(MOST_SAMPLES)] = 60_000  # poses drawn
    kept: Annotated[int, positive, at_most(MOST_POSES)] = 200  # the best of them, which are fitted
    first_steps: Annotated[int, not_negative, at_most(MOST_MOVES)] = 6  # of these fits
    refined: Annotated[int, positive, at_most(MOST_POSES)] = 100  # of these, fitted further
    steps: Annotated[int, not_negative, at_most(MOST_MOVES)] = 15  # of these fits
    descents: Annotated[int, positive, at_most(MOST_POSES)] = 96  # chains that descend to the limit
    descent_moves: Annotated[int, not_negative, at_most(MOST_MOVES)] = 266
    chains: Annotated[int, positive, at_most(MOST_POSES)] = 96  # chains that spread below it
    moves: Annotated[int, not_negative, at_most(MOST_MOVES)] = 300
    polished: Annotated[int, not_negative, at_most(MOST_POSES)] = 16  # the lowest, to their minima
    polish_moves: Annotated[int, not_negative, at_most(MOST_MOVES)] = 300
    # How many evaluations may be spent, in rounds of all but the last stage, while the lowest
    # energy is above `enough` noise levels; 0: one round.
    evaluations: Annotated[int, not_negative, at_most(MOST_SAMPLES)] = 0
    enough: Annotated[float, positive] = 4.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_most("descents x descent_moves", self.descents * self.descent_moves, MOST_WORK)
        require_at_most("polished x polish_moves", self.polished * self.polish_moves, MOST_WORK)
        require_at_most("chains x moves", self.chains * self.moves, MOST_WORK)


_SMALL = Effort(
    samples=40_000,
    kept=64,
    first_steps=12,
    refined=40,
    descents=24,
    descent_moves=60,
    chains=24,
    moves=150,
    polished=8,
)
_LARGE = Effort(
    samples=250_000,
    kept=504,
    refined=150,
    descents=120,
    descent_moves=500,
    chains=120,
    moves=1000,
    polished=32,
    polish_moves=1000,
)
EFFORTS = {
    "small": _SMALL,
    "medium": Effort(),
    "large": _LARGE,
    "adaptive": replace(_SMALL, evaluations=2_000_000),
}


@dataclass(frozen=True)
class AnchoredSettings(CheckedSettings):
    """All settings of the contact-anchored search, the same in all presets.

    The method is neither in the paper nor in its authors' code.
    """

    size: Annotated[str, one_of(*EFFORTS)] = "medium"
    effort: Effort | None = None  # in place of the one that `size` names
    noise: Annotated[float, positive] = 0.0005  # "noise level", sigma of known points, metres
    penetration_tolerance: Annotated[float, not_negative] = 0.0  # tau, of free points, metres
    # Most candidates have energies below the larger of limit_noise noise levels, and
    # limit_ratio x lowest energy + limit_slack noise levels.
    limit_noise: Annotated[float, not_negative] = 1.0
    limit_ratio: Annotated[float, not_negative] = 1.3
    limit_slack: Annotated[float, not_negative] = 0.5
    # Share of the chains whose limit is outer_noise noise levels higher.
    outer_share: Annotated[float, not_negative, at_most(1.0)] = 0.25
    outer_noise: Annotated[float, not_negative] = 1.0
    anchors: AnchorSettings = field(default_factory=AnchorSettings)
    archive: ArchiveSettings = _ARCHIVE
    online: OnlineSettings = _ONLINE
    plane: PlaneSettings | None = None  # restricts the poses to SE(2)

    def __post_init__(self) -> None:
        super().__post_init__()
        measure_named(self.archive.measure, planar=self.plane is not None)


class RatedPoses(NamedTuple):
    """Poses with their energies."""

    poses: Poses
    energies: FloatArray  # (B,), metres

    @classmethod
    def joined(cls, *parts: RatedPoses) -> RatedPoses:
        """Those of all parts, in their order."""
        energies = np.concatenate([part.energies for part in parts])
        return cls(Poses.joined([part.poses for part in parts]), energies)

    def chosen(self, which: Any) -> RatedPoses:
        """Some of them: a slice, flags (B,) or indices."""
        return RatedPoses(self.poses[which], self.energies[which])

    def ordered(self) -> RatedPoses:
        """The lowest first."""
        return self.chosen(np.argsort(self.energies, kind="stable"))


class Anchored(ConfiguredMethod[AnchoredSettings]):
    """Samples anchored on contacts, fitted, spread below a limit, and a diverse choice of them."""

    settings_class = AnchoredSettings

    def register(
        self, problem: RegistrationProblem, observer: Observer | None = None
    ) -> Hypotheses:
        """Hypotheses for the known points of a problem, best first; costs are energies."""
        search = _Search(problem, self.settings, observer or NullObserver())
        return search.hypotheses(search.spread(search.minima()))


class _Search:
    """The stages of one registration."""

    def __init__(
        self, problem: RegistrationProblem, settings: AnchoredSettings, observer: Observer
    ) -> None:
        self._problem, self._settings, self._observer = problem, settings, observer
        self._effort = settings.effort or EFFORTS[settings.size]
        self._space = search_space(settings.plane, problem.sdf)
        self._known = most_informative_first(problem.points)
        bounds = origin_bounds(problem.workspace, self._space, settings.anchors.margin)
        tolerance = settings.penetration_tolerance
        self._energy = Energy(problem, self._known, self._space, tolerance, bounds)

    def minima(self) -> RatedPoses:
        """Poses near minima, the lowest first, from as many rounds as needed.

        The best of E_0 and E_l join the first round.
        """
        effort, problem = self._effort, self._problem
        given = Poses.of(np.concatenate([problem.initial_set, problem.low_cost_set]))
        if self._settings.plane is not None:  # moves keep to the plane, but do not lead onto it
            given = self._space.poses(self._space.encode(given))
        given = self._costed(given).ordered().poses[:_MOST_GIVEN]
        rounds: list[RatedPoses] = []
        spent = 0
        while True:
            index = len(rounds)
            starts = anchored_poses(
                problem,
                self._known,
                self._space,
                self._settings.anchors,
                samples=effort.samples,
                most=effort.kept,
                index=index,
            )
            self._observer.progress("sample", effort.samples, effort.samples)
            starts = starts if index else Poses.joined([starts, given])
            rounds.append(self._descended(self._fitted(starts), index))
            spent += effort.samples + effort.kept * effort.first_steps
            spent += effort.refined * effort.steps + effort.descents * effort.descent_moves
            self._observer.progress("search", min(spent, effort.evaluations), effort.evaluations)
            lowest = min(float(part.energies.min()) for part in rounds)
            if lowest <= effort.enough * self._settings.noise or spent >= effort.evaluations:
                return RatedPoses.joined(*rounds).ordered()

    def _costed(self, poses: Poses) -> RatedPoses:
        return RatedPoses(poses, self._energy.of(poses))

    def _fitted(self, poses: Poses) -> RatedPoses:
        """All fitted by a few steps, and the better part of them by more; the lowest first."""
        effort = self._effort
        poses = self._costed(self._energy.fitted(poses, effort.first_steps)).ordered().poses
        better = self._energy.fitted(poses[: effort.refined], effort.steps)
        fitted = self._costed(Poses.joined([better, poses[effort.refined :]])).ordered()
        self._show("fit", fitted)
        return fitted

    def _descended(self, fitted: RatedPoses, index: int) -> RatedPoses:
        """The lowest walk down to the limit that holds so far, and the lowest of all further."""
        effort, limit = self._effort, self._limit(fitted.energies)
        lower = self._walked_down(
            fitted, limit, effort.descents, effort.descent_moves, index=2 + 2 * index
        )
        lowest = self._walked_down(
            lower, 0.0, effort.polished, effort.polish_moves, index=3 + 2 * index
        )
        self._show("descend", lowest)
        return lowest

    def _walked_down(
        self, candidates: RatedPoses, floor: float, count: int, moves: int, *, index: int
    ) -> RatedPoses:
        """RatedPoses of which the `count` lowest walked down to a floor, these first."""
        candidates = candidates.ordered()
        first = candidates.chosen(slice(count))
        chains = self._energy.walked(*first, floor, moves, kept=0, index=index)
        walked = RatedPoses(Poses(chains.poses), chains.energies)
        return RatedPoses.joined(walked, candidates.chosen(slice(count, None)))

    def _limit(self, energies: FloatArray) -> float:
        """The energy below which poses are candidates."""
        settings, least = self._settings, float(energies.min())
        relative = settings.limit_ratio * least + settings.limit_slack * settings.noise
        return max(settings.limit_noise * settings.noise, relative, least)

    def spread(self, minima: RatedPoses) -> RatedPoses:
        """Minima below the limit, walks from there below it, and others below a higher limit.

        The latter as it is not known that well which energies the contacts allow.
        """
        settings, limit = self._settings, self._limit(minima.energies)
        outer_limit = limit + settings.outer_noise * settings.noise
        chains = max(self._effort.chains, -(-2 * len(self._problem.initial_set) // _KEPT))
        outer = int(settings.outer_share * chains)
        candidates = RatedPoses.joined(
            minima.chosen(minima.energies <= limit),
            self._walked_below(minima, limit, chains - outer, index=0),
            self._walked_below(minima, outer_limit, outer, index=1),
        )
        self._show("spread", candidates)
        return candidates

    def _walked_below(
        self, minima: RatedPoses, limit: float, chains: int, *, index: int
    ) -> RatedPoses:
        """States below a limit of chains that start at minima far apart."""
        minima = minima.chosen(minima.energies <= limit)
        starts = np.resize(farthest_poses(self._problem.sdf, minima.poses, chains), chains)
        walked = self._energy.walked(
            *minima.chosen(starts), limit, self._effort.moves, kept=_KEPT, index=index
        )
        states = RatedPoses(Poses(walked.kept.reshape(-1, 12)), walked.kept_energies.reshape(-1))
        return states.chosen(states.energies <= limit)

    def hypotheses(self, candidates: RatedPoses) -> Hypotheses:
        """As many hypotheses as E_0 has poses, and all candidates offered to the archive."""
        problem, space, settings = self._problem, self._space, self._settings.archive
        poses, count = candidates.poses, len(problem.initial_set)
        chosen = representatives(problem.sdf, poses, count)
        if len(chosen) < count:
            others = np.setdiff1d(np.arange(len(poses)), chosen)
            new = ~repeated(poses[np.concatenate([chosen, others])])
            others = others[new[len(chosen) :]]
            others = others[evenly_spaced(len(others), count - len(chosen))]
            chosen = np.resize(np.concatenate([chosen, others]), count)
        measure = measure_named(settings.measure, planar=self._settings.plane is not None)
        vectors, objective = space.encode(poses), self._energy.objective
        offered = evaluated(objective, measure, vectors, candidates.energies)
        mean, deviation = measure_range(offered, measure, settings, len(problem.points.known))
        archive = sized_archive(measure, mean, deviation, settings, space.dimension)
        archive.update_cells(offered)
        self._observer.snapshot(archive.snapshot(0, 0))
        elites = space.poses(archive.solutions)
        cells = archive.cells_of(offered.measures[chosen])
        hypotheses = space.poses(vectors[chosen])
        return ranked_hypotheses(objective, hypotheses, cells, elites, archive.snapshot(0, 0))

    def _show(self, stage: str, candidates: RatedPoses) -> None:
        vectors = self._space.encode(candidates.poses)
        self._observer.trace(stage, 0, vectors.copy(), candidates.energies.copy())
        self._observer.progress(stage, 1, 1)
