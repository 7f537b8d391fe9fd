"""Contact-anchored search: our own method, for hypotheses that are close to the plausible set."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from chsel.errors import require_at_most, require_choice, require_positive
from chsel.methods.anchored.anchor_sampling import (
    AnchorSettings,
    anchored_poses,
    in_telling_order,
)
from chsel.methods.anchored.energy import Energy
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
from chsel.problem.subset import evenly_spaced, farthest_poses, representative_poses
from chsel.qd.emitters import update_cells
from chsel.qd.measures import measure_named
from chsel.qd.selection import ArchiveSettings, ranked_hypotheses, repeated, sized_archive

MOST_SAMPLES = 1_000_000_000
MOST_POSES = 1_000_000
MOST_MOVES = 100_000
MOST_WORK = 1_000_000_000  # of the two
_KEPT = 6  # states of a chain
_POOL = 400  # candidates to choose from
_MOST_POOL = 1200  # for many hypotheses; more of these are taken evenly
_MOST_CHOSEN = 300  # by facility location; more of them are taken evenly
_MOST_GIVEN = 60  # of E_0 and E_l that are fitted
_ARCHIVE = ArchiveSettings(bins=40, outliers="none")
_ONLINE = OnlineSettings(update="own")


@dataclass(frozen=True)
class Effort:
    """How much is done.

    samples: poses drawn; kept: of them, those fitted by first_steps steps; refined: the better of
    these, by steps more. descents, descent_moves: chains that come down to the limit, and their
    moves. polished, polish_moves: the lowest, which come down as far as they can. chains, moves:
    those that spread below the limit. evaluations: how many may be spent, in rounds of all but
    the last stage, while the lowest energy is above `enough` noise levels; 0: one round.
    """

    samples: int = 60_000
    kept: int = 200
    first_steps: int = 6
    refined: int = 100
    steps: int = 15
    descents: int = 96
    descent_moves: int = 266
    chains: int = 96
    moves: int = 300
    polished: int = 16
    polish_moves: int = 300
    evaluations: int = 0
    enough: float = 4.0

    def __post_init__(self) -> None:
        for name in ("samples", "kept", "refined", "descents", "chains", "enough"):
            require_positive(name, getattr(self, name))
        for name in ("first_steps", "steps", "descent_moves", "moves", "polished", "polish_moves"):
            require_positive(name, getattr(self, name), zero=True)
        require_positive("evaluations", self.evaluations, zero=True)
        require_at_most("samples", self.samples, MOST_SAMPLES)
        for name in ("kept", "refined", "descents", "chains", "polished"):
            require_at_most(name, getattr(self, name), MOST_POSES)
        for name in ("first_steps", "steps", "descent_moves", "moves", "polish_moves"):
            require_at_most(name, getattr(self, name), MOST_MOVES)
        require_at_most("evaluations", self.evaluations, MOST_SAMPLES)
        require_at_most("descents x descent_moves", self.descents * self.descent_moves, MOST_WORK)
        require_at_most("polished x polish_moves", self.polished * self.polish_moves, MOST_WORK)
        require_at_most("chains x moves", self.chains * self.moves, MOST_WORK)


EFFORTS = {
    "small": Effort(40_000, 64, 12, 40, 15, 24, 60, 24, 150, 8, 300),
    "medium": Effort(),
    "large": Effort(250_000, 504, 6, 150, 15, 120, 500, 120, 1000, 32, 1000),
    "adaptive": Effort(40_000, 64, 12, 40, 15, 24, 60, 24, 150, 8, 300, 2_000_000),
}


@dataclass(frozen=True)
class AnchoredSettings:
    """All settings of the contact-anchored search.

    size: an effort, of EFFORTS; effort: another one in its place. noise: the standard deviation of
    known points, metres. penetration_tolerance: tau, the depth that free points may have, metres.
    limit_noise, limit_ratio, limit_slack: most candidates have energies below the larger of
    limit_noise noise levels, and limit_ratio x lowest energy + limit_slack noise levels.
    outer_share, outer_noise: that share of the chains may be so many noise levels above it.
    plane: restricts the poses to SE(2).

    They are the same in all presets: the method is neither in the paper nor in its authors' code.
    """

    size: str = "medium"
    effort: Effort | None = None
    noise: float = 0.0005
    penetration_tolerance: float = 0.0
    limit_noise: float = 1.0
    limit_ratio: float = 1.3
    limit_slack: float = 0.5
    outer_share: float = 0.25
    outer_noise: float = 1.0
    anchors: AnchorSettings = field(default_factory=AnchorSettings)
    archive: ArchiveSettings = _ARCHIVE
    online: OnlineSettings = _ONLINE
    plane: PlaneSettings | None = None

    def __post_init__(self) -> None:
        require_choice("size", self.size, EFFORTS)
        require_positive("noise", self.noise)
        for name in (
            "penetration_tolerance",
            "limit_noise",
            "limit_ratio",
            "limit_slack",
            "outer_share",
            "outer_noise",
        ):
            require_positive(name, getattr(self, name), zero=True)
        require_at_most("outer_share", self.outer_share, 1.0)
        measure_named(self.archive.measure, planar=self.plane is not None)


class Anchored:
    """Samples anchored on contacts, fitted, spread below a limit, and a diverse choice of them."""

    def __init__(self, settings: AnchoredSettings | None = None) -> None:
        self.settings = settings or AnchoredSettings()

    @property
    def online(self) -> OnlineSettings:
        """How a session makes the next problem."""
        return self.settings.online

    def register(
        self, problem: RegistrationProblem, observer: Observer | None = None
    ) -> Hypotheses:
        """Hypotheses for the known points of a problem, best first; costs are energies."""
        search = _Search(problem, self.settings, observer or NullObserver())
        return search.chosen(*search.spread(*search.found()))


class _Search:
    """The stages of one registration."""

    def __init__(
        self, problem: RegistrationProblem, settings: AnchoredSettings, observer: Observer
    ) -> None:
        self._problem, self._settings, self._observer = problem, settings, observer
        self._effort = settings.effort or EFFORTS[settings.size]
        self._space = search_space(settings.plane, problem.sdf)
        self._known = in_telling_order(problem.points)
        bounds = origin_bounds(problem.workspace, self._space, settings.anchors.margin)
        tolerance = settings.penetration_tolerance
        self._energy = Energy(problem, self._known, self._space, tolerance, bounds)

    def found(self) -> tuple[Poses, FloatArray]:
        """Poses near minima with their energies, the lowest first, from as many rounds as it takes.

        The best of E_0 and E_l join the first round.
        """
        effort, problem = self._effort, self._problem
        given = Poses.of(np.concatenate([problem.initial_set, problem.low_cost_set]))
        if self._settings.plane is not None:  # moves keep to the plane, but do not lead onto it
            given = self._space.poses(self._space.encode(given))
        given = given[np.argsort(self._energy.of(given), kind="stable")[:_MOST_GIVEN]]
        poses, energies = given[:0], np.zeros(0)
        spent = index = 0
        while True:
            drawn = self._drawn(index)
            joined = drawn if index else Poses.joined([drawn, given])
            more, more_energies = self._descended(*self._fitted(joined), index)
            poses = Poses.joined([poses, more])
            energies = np.concatenate([energies, more_energies])
            spent += effort.samples + effort.kept * effort.first_steps
            spent += effort.refined * effort.steps + effort.descents * effort.descent_moves
            index += 1
            self._observer.progress("search", min(spent, effort.evaluations), effort.evaluations)
            good = float(energies.min()) <= effort.enough * self._settings.noise
            if good or spent >= effort.evaluations:
                break
        order = np.argsort(energies, kind="stable")
        return poses[order], energies[order]

    def _drawn(self, index: int) -> Poses:
        effort, settings = self._effort, self._settings
        poses = anchored_poses(
            self._problem,
            self._known,
            self._space,
            settings.anchors,
            samples=effort.samples,
            most=effort.kept,
            index=index,
        )
        self._observer.progress("sample", effort.samples, effort.samples)
        return poses

    def _fitted(self, poses: Poses) -> tuple[Poses, FloatArray]:
        """All fitted a little, and the better part of them some more; the lowest first."""
        effort = self._effort
        poses, _ = self._ordered(self._energy.fitted(poses, effort.first_steps))
        better = self._energy.fitted(poses[: effort.refined], effort.steps)
        poses, energies = self._ordered(Poses.joined([better, poses[effort.refined :]]))
        self._tell("fit", poses, energies)
        return poses, energies

    def _ordered(self, poses: Poses) -> tuple[Poses, FloatArray]:
        energies = self._energy.of(poses)
        order = np.argsort(energies, kind="stable")
        return poses[order], energies[order]

    def _descended(
        self, poses: Poses, energies: FloatArray, index: int
    ) -> tuple[Poses, FloatArray]:
        """The lowest walk down to the limit that holds so far, and the lowest of all further."""
        effort, limit = self._effort, self._limit(energies)
        amount = effort.descents, effort.descent_moves
        found = self._walked_down(poses, energies, limit, *amount, 2 + 2 * index)
        amount = effort.polished, effort.polish_moves
        found = self._walked_down(*found, 0.0, *amount, 3 + 2 * index)
        self._tell("descend", *found)
        return found

    def _walked_down(
        self,
        poses: Poses,
        energies: FloatArray,
        floor: float,
        count: int,
        moves: int,
        index: int,
    ) -> tuple[Poses, FloatArray]:
        """Poses in order of their energies before the `count` lowest walked down to a floor."""
        order = np.argsort(energies, kind="stable")
        poses, energies = poses[order], energies[order]
        first = poses[:count], energies[:count]
        chains = self._energy.walked(*first, floor, moves, kept=0, index=index)
        poses = Poses.joined([Poses(chains.poses), poses[count:]])
        return poses, np.concatenate([chains.energies, energies[count:]])

    def _limit(self, energies: FloatArray) -> float:
        """The energy below which poses are candidates."""
        settings, least = self._settings, float(energies.min())
        relative = settings.limit_ratio * least + settings.limit_slack * settings.noise
        return max(settings.limit_noise * settings.noise, relative, least)

    def spread(self, poses: Poses, energies: FloatArray) -> tuple[Poses, FloatArray]:
        """Candidates with their energies: poses below the limit, and walks there from these.

        And walks below a higher one: which energies the contacts allow is not known that well.
        """
        settings, limit = self._settings, self._limit(energies)
        outer_limit = limit + settings.outer_noise * settings.noise
        wanted = max(self._effort.chains, -(-2 * len(self._problem.initial_set) // _KEPT))
        outer = int(settings.outer_share * wanted)
        inner = self._wandered(poses, energies, limit, wanted - outer, 0)
        further = self._wandered(poses, energies, outer_limit, outer, 1)
        below = energies <= limit
        poses = Poses.joined([poses[below], inner[0], further[0]])
        energies = np.concatenate([energies[below], inner[1], further[1]])
        self._tell("spread", poses, energies)
        return poses, energies

    def _wandered(
        self, poses: Poses, energies: FloatArray, limit: float, chains: int, index: int
    ) -> tuple[Poses, FloatArray]:
        """States of chains below a limit, with their energies, from poses that are far apart."""
        below = energies <= limit
        poses, energies = poses[below], energies[below]
        starts = np.resize(farthest_poses(self._problem.sdf, poses, chains), chains)
        walked = self._energy.walked(
            poses[starts], energies[starts], limit, self._effort.moves, kept=_KEPT, index=index
        )
        kept = walked.kept_energies.reshape(-1) <= limit
        return Poses(walked.kept.reshape(-1, 12)[kept]), walked.kept_energies.reshape(-1)[kept]

    def chosen(self, poses: Poses, energies: FloatArray) -> Hypotheses:
        """As many hypotheses as E_0 has poses, of candidates; all of these go into the archive."""
        problem, space, settings = self._problem, self._space, self._settings
        count = len(problem.initial_set)
        pool = evenly_spaced(len(poses), max(_POOL, min(2 * count, _MOST_POOL)))
        chosen = pool[representative_poses(problem.sdf, poses[pool], min(count, _MOST_CHOSEN))]
        if len(chosen) < count:
            others = np.setdiff1d(np.arange(len(poses)), chosen)
            new = ~repeated(poses[np.concatenate([chosen, others])])
            others = others[new[len(chosen) :]]
            more = others[evenly_spaced(len(others), count - len(chosen))]
            chosen = np.resize(np.concatenate([chosen, more]), count)
        vectors, objective = space.encode(poses), self._energy.objective
        measure = measure_named(settings.archive.measure, planar=settings.plane is not None)
        measures = measure.values(space, vectors)
        archive = sized_archive(
            measure,
            measures,
            energies,
            settings.archive,
            len(problem.points.known),
            space.dimension,
        )
        update_cells(archive, objective, vectors, energies)
        self._observer.snapshot(archive.snapshot(0, 0))
        elites = space.poses(archive.solutions)
        cells = archive.cells_of(measures[chosen])
        hypotheses = space.poses(vectors[chosen])
        return ranked_hypotheses(objective, hypotheses, cells, elites, archive.snapshot(0, 0))

    def _tell(self, stage: str, poses: Poses, energies: FloatArray) -> None:
        vectors = self._space.encode(poses)
        self._observer.trace(stage, 0, vectors.copy(), energies.copy())
        self._observer.progress(stage, 1, 1)
