"""One registration: the problem that determines it, its result, and who may observe it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from chsel.errors import (
    PointsWarning,
    PoseError,
    SettingError,
    require_between,
    require_positive,
)
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray, ShapesShown, digest, frozen
from chsel.problem.noise import FREEDOMS, PRIOR_CONTACTS, PRIOR_OUTLIERS
from chsel.problem.points import KnownPoints, Workspace, require_parts
from chsel.problem.pose_prior import PosePrior, require_prior
from chsel.problem.poses import Poses, check_rigid, inverse
from chsel.problem.pushes import Pushes
from chsel.problem.sdf_grid import COARSEST, FINEST, SdfGrid
from chsel.problem.streams import StreamKey


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class RegistrationProblem(ShapesShown):
    """Everything that determines the outcome of one registration, and nothing else."""

    sdf: SdfGrid  # signed distances of the object, in its frame
    points: KnownPoints  # in the world
    initial_set: FloatArray  # E_0 (B, 4, 4), object_from_world
    workspace: Workspace  # where the object can be
    free_resolution: float  # side of the voxels into which free points were merged, metres
    key: StreamKey  # of the random streams
    low_cost_set: FloatArray = field(  # E_l (L, 4, 4), object_from_world; may be empty
        default_factory=lambda: np.zeros((0, 4, 4))
    )
    pushes: Pushes | None = None  # that may have moved the object; None: it stands still
    prior: PosePrior | None = None  # on the pose before any push; None: nothing is known of it

    def __post_init__(self) -> None:
        require_parts(sdf=self.sdf, points=self.points, workspace=self.workspace)
        require_positive("free_resolution", self.free_resolution)
        require_between("free_resolution", self.free_resolution, low=FINEST, high=COARSEST)
        for name in ("initial_set", "low_cost_set"):
            poses = frozen(name, getattr(self, name), shape=(None, 4, 4), error=PoseError)
            check_rigid(name, poses)
            object.__setattr__(self, name, poses)
        if len(self.initial_set) == 0:
            raise PoseError("initial_set is empty; accepted: at least one pose")
        if self.points.count == 0:
            raise SettingError("there is no known point; accepted: at least one of any class")
        if self.pushes is not None:
            self.pushes.require_points(self.points)
        if self.prior is not None:
            require_prior(self.prior)

    @cached_property
    def digest(self) -> str:
        """Digest of the problem."""
        parts = [self.sdf.digest, self.points.digest, digest(self.initial_set, self.low_cost_set)]
        parts += [] if self.pushes is None else [self.pushes.digest]
        parts += [] if self.prior is None else [self.prior.digest]
        numbers = np.array([*self.workspace.lower, *self.workspace.upper, self.free_resolution])
        key = np.array([self.key.seed, self.key.step], dtype=np.uint64)
        text = np.frombuffer("".join(parts).encode(), dtype=np.uint8)
        return digest(text, numbers, key)

    def carried(self, distance: float) -> RegistrationProblem:
        """Return the problem of an object that stands still where pushes have moved it to.

        distance: of one push, metres. Its points and its prior have moved with it, and there are no
        pushes left.
        """
        if self.pushes is None:
            return self
        points = self.pushes.carried(self.points, distance, resolution=self.free_resolution)
        prior = self.prior
        if prior is not None:
            prior = prior.shifted(distance * self.pushes.directions.sum(axis=0))
        return replace(self, points=points, pushes=None, prior=prior)


@dataclass(frozen=True, eq=False)
class ArchiveSnapshot:
    """The occupied cells of a quality-diversity archive at one moment."""

    iteration: int  # quality-diversity iterations done
    refinement: int  # passes of the method before this search
    measure_names: tuple[str, ...]  # (k,): names of the axes, with units
    shape: tuple[int, ...]  # (k,): cells per measure
    lower: FloatArray  # (k,): range of each measure
    upper: FloatArray  # (k,)
    cells: IntArray  # (C,): index of each occupied cell, row-major, last measure fastest
    solutions: FloatArray  # (C, d): raw search vectors
    objectives: FloatArray  # (C,): minus the cost
    measures: FloatArray  # (C, k)

    @property
    def coverage(self) -> float:
        """Fraction of the cells that are occupied."""
        return len(self.cells) / int(np.prod(self.shape))

    @property
    def qd_score(self) -> float:
        """Sum over occupied cells of (objective + 100), per cell of the archive."""
        return float((self.objectives + 100.0).sum() / np.prod(self.shape))

    @cached_property
    def digest(self) -> str:
        """Digest of the snapshot."""
        return digest(self.cells, self.solutions, self.objectives, self.measures)


VERDICTS = ("determined", "several modes", "wide", "nothing fits")
"""What `chsel.problem.trust` says of a result; in recordings 0 to 3, so this order stays."""


@dataclass(frozen=True, kw_only=True)
class Trust:
    """A verdict on a result: how well it explains the points, and how far it is unique."""

    noise: float  # standard deviation of the known points on the object, estimated, metres
    outliers: float  # share of known points that are not on the object, estimated
    misfit: float  # how far points are off the best hypothesis on average, in sensor noise levels
    modes: int  # places of the object that explain the points; 0 if it is wide, or nothing fits
    spread: float  # root mean square distance of two surfaces of these hypotheses, metres
    verdict: str  # one of VERDICTS
    redundancy: int  # known points beyond the six that a pose can fit; at 0, misfit is no evidence
    best_of_modes: tuple[int, ...] = (0,)  # indices of hypotheses, one a mode, the best first
    # Largest angle (radians) between modes whose surfaces are as near as those of one mode, and
    # the distance of these surfaces (m); None for other modes.
    twins: tuple[float, float] | None = None
    limit: float | None = None  # of the spread, above which a result is wide, metres
    # The farthest of the hypotheses that explain the points is so far off the best: the object's
    # centre, metres, and turned, radians, but for symmetries. See `chsel.methods.trust_by`.
    centre_within: float | None = None
    turn_within: float | None = None  # radians
    reason: str = ""  # why the verdict is wide, or nearly so, where the spread does not show it

    def __str__(self) -> str:
        """Return one line for people."""
        verdict = self.verdict
        if self.twins is not None:
            angle = math.degrees(self.twins[0])
            apart = 1000.0 * self.twins[1]
            verdict = f"determined up to a turn of {angle:.0f} degrees, {apart:.1f} mm apart"
        return f"{verdict} ({', '.join(self._details)}){self._bound}"

    @property
    def _details(self) -> list[str]:
        """Texts of the numbers behind the verdict, without those that few contacts cannot show."""
        texts = [f"{self.modes} mode{'s' if self.modes > 1 else ''}"] if self.modes else []
        most = "" if self.limit is None else f" of {1000.0 * self.limit:.1f}"
        texts.append(f"spread {1000.0 * self.spread:.1f}{most} mm")
        texts += [self.reason] if self.reason else []
        misfit = f"misfit {self.misfit:.1f} noise levels"
        if not self.redundancy and self.verdict != "nothing fits":
            return [*texts, f"{misfit}: no evidence, a pose can fit so few contacts exactly"]
        texts.append(f"noise {1000.0 * self.noise:.1f} mm")
        total = PRIOR_CONTACTS + FREEDOMS + self.redundancy
        outliers = round(self.outliers * total - PRIOR_CONTACTS * PRIOR_OUTLIERS)
        texts += [f"{outliers} outlier{'s' if outliers > 1 else ''}"] if outliers > 0 else []
        return [*texts, misfit]

    @property
    def _bound(self) -> str:
        """Text of the pose's error, rounded up; "" if it is not known."""
        if self.centre_within is None or self.turn_within is None or self.verdict == "nothing fits":
            return ""
        off = math.ceil(10_000.0 * self.centre_within) / 10.0
        angle = math.ceil(math.degrees(self.turn_within))
        if self.verdict == "wide":
            return f", centre off by up to {off:.1f} mm and {angle}° or more"
        return f", centre within {off:.1f} mm, {angle}°"

    @property
    def numbers(self) -> dict[str, float]:
        """Values by the names of recordings, the verdict as its index in VERDICTS."""
        later = {
            "spread_limit": self.limit,
            "centre_within": self.centre_within,
            "turn_within": self.turn_within,
        }
        return {
            "estimated_noise": self.noise,
            "outlier_share": self.outliers,
            "misfit": self.misfit,
            "modes": float(self.modes),
            "set_spread": self.spread,
            "verdict": float(VERDICTS.index(self.verdict)),
        } | {name: value for name, value in later.items() if value is not None}


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """The result of one registration: B poses, best first."""

    object_from_world: FloatArray  # (B, 4, 4)
    cost: FloatArray  # (B,): the relaxed cost of exactly these poses, ascending
    duplicate: BoolArray  # (B,): whether a pose repeats an earlier one
    cell: IntArray  # (B,): the archive cell that a pose came from, -1 for none
    elites: FloatArray  # (L, 4, 4): object_from_world of all solutions, from which E_l follows
    archive: ArchiveSnapshot | None = None  # the last one, if the method keeps an archive
    # (C, 4, 4): poses that the points allow, before B of them were chosen; none if the method does
    # not say. Decisions on the next probe weigh them up; they are not part of the digest.
    candidates: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    trust: Trust | None = None  # methods leave it out; who calls them adds it, see `chsel.trust_in`
    push_distance: float = 0.0  # metres that each push of the problem moved the object, estimated

    def __repr__(self) -> str:
        best = f", best cost {self.cost[0]:.4g}" if len(self.cost) else ""
        judged = "" if self.trust is None else f", {self.trust}"
        return f"<Hypotheses: {len(self.cost)}, {self.distinct} distinct{best}{judged}>"

    @cached_property
    def world_from_object(self) -> FloatArray:
        """The poses (B, 4, 4) the other way round: where the object is in the world."""
        return inverse(self.object_from_world)

    @property
    def distinct(self) -> int:
        """Number of poses that are not duplicates."""
        return int((~self.duplicate).sum())

    @cached_property
    def digest(self) -> str:
        """Digest of poses, costs, flags and elites."""
        return digest(
            self.object_from_world,
            self.cost,
            self.duplicate,
            self.cell,
            self.elites,
            *([np.array([self.push_distance])] if self.push_distance else []),
        )


def check_prior(problem: RegistrationProblem, hypotheses: Hypotheses) -> list[PointsWarning]:
    """Return a warning if the best hypothesis, which has to be finite, contradicts the prior."""
    problem = problem.carried(hypotheses.push_distance)
    prior, pose = problem.prior, Poses.of(hypotheses.object_from_world[:1])
    if prior is None or not prior.is_contradicted(pose, problem.sdf):
        return []
    metres, radians = prior.offset(pose, problem.sdf)
    parts = [] if metres is None else [f"{100.0 * metres:.1f} cm"]
    parts += [] if radians is None else [f"{math.degrees(radians):.0f} degrees"]
    text = f"the points contradict the prior: the best pose is {' and '.join(parts)} off it"
    return [PointsWarning("prior", text)]


class Observer(Protocol):
    """Is called during a registration, without changing any bit of its result.

    An observer must not modify the arrays that it receives.
    """

    # Quality-diversity iterations between archive snapshots; 0: only the first and the last.
    snapshot_interval: int

    def progress(self, stage: str, iteration: int, total: int) -> None:  # noqa: PLR0917
        """Take note that a stage has finished `iteration` of `total` iterations."""
        return

    def trace(self, stage: str, iteration: int, vectors: FloatArray, cost: FloatArray) -> None:  # noqa: PLR0917
        """Take the state of a stage at its start and after blocks of iterations.

        vectors (B, d): of the search; in quality-diversity search, of all elites. cost (B,).
        """
        return

    def snapshot(self, archive: ArchiveSnapshot) -> None:
        """Take the archive at this moment."""
        return


class NullObserver(Observer):
    """Ignores everything."""

    snapshot_interval = 0
