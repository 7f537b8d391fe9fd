"""The estimates that size the archive, and the elites that become hypotheses (Alg. 1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from chsel.errors import ChselError, require_at_most
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray, evenly_spaced
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses, RegistrationProblem
from chsel.problem.search_space import SearchSpace, origin_bounds
from chsel.problem.settings import CheckedSettings, Presets, at_most, not_negative, one_of, positive
from chsel.problem.subset import representative_poses
from chsel.problem.surface import has_surface
from chsel.qd.archive import Evaluated, GridArchive, SearchObjective
from chsel.qd.measures import MEASURES, Measure

MOST_CELLS = 10_000_000
_POOL = 400  # poses to choose representatives from
_MOST_POOL = 1200  # for many hypotheses; more of these are taken evenly
_MOST_REPRESENTATIVE = 300  # by facility location; more of them are taken evenly


@dataclass(frozen=True)
class ArchiveSettings(CheckedSettings):
    """The grid of the archive: mean +- range_sigmas standard deviations of the measures of E'."""

    measure: Annotated[str, one_of(*MEASURES)] = "object_xy"  # of chsel.qd.measures
    bins: Annotated[int, positive, at_most(MOST_CELLS)] = 56  # cells per measure
    range_sigmas: Annotated[float, positive] = 3.0  # b_sigma of the paper
    least_deviation: Annotated[float, positive] = 0.005  # floor of the deviation, metres or radians
    # Which of E' are left out of mean and deviation: "ratio" those above
    # ratio x lowest cost + tolerance, "quantile" those above the 80 % quantile, "none".
    outliers: Annotated[str, one_of("ratio", "quantile", "none")] = "ratio"
    ratio: Annotated[float, positive] = 5.0  # of the lowest cost
    tolerance_per_point: Annotated[float, not_negative] = 1e-3  # tolerance per known point
    tolerance: Annotated[float, not_negative] = 1e-6  # its floor

    _OTHERS: ClassVar = {"measure": "position_2", "bins": 40, "least_deviation": 1e-4}
    presets: ClassVar[Presets] = {
        "paper": _OTHERS | {"outliers": "none"},
        "reference": _OTHERS | {"tolerance_per_point": 0.0, "tolerance": 0.1},
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        count = MEASURES[self.measure].count
        require_at_most(f"bins ** {count}, the number of cells,", self.bins**count, most=MOST_CELLS)


@dataclass(frozen=True)
class OutputSettings(CheckedSettings):
    """The choice of hypotheses from the archive."""

    # "lowest" for the lowest costs, "representative" for those below the limit that all others
    # below it are near to; it is "lowest" where no more than wanted are below.
    choice: Annotated[str, one_of("lowest", "representative")] = "representative"
    # "none" for the cells of lowest cost whatever it is, "ratio" for those below
    # ratio x lowest cost + tolerance, "noise" for those below the larger of ratio x lowest cost
    # and lowest cost + tolerance_per_point x known points + free_tolerance.
    limit: Annotated[str, one_of("none", "ratio", "noise")] = "noise"
    ratio: Annotated[float, positive] = 1.3  # of the lowest cost
    tolerance: Annotated[float, not_negative] = 1e-6  # of "ratio"
    tolerance_per_point: Annotated[float, not_negative] = 5e-4  # of "noise"
    free_tolerance: Annotated[float, not_negative] = 0.01  # of "noise"
    # What fills a set of too few: "next_best" the next cells, then copies; "resample" copies drawn
    # with replacement; "fewer" nothing.
    shortage: Annotated[str, one_of("next_best", "resample", "fewer")] = "next_best"
    # Metres by which the object's origin may be beside the workspace, as long as any pose is
    # within; None: it may be anywhere.
    margin: Annotated[float | None, not_negative] = 0.15

    _OTHERS: ClassVar = {  # of both other presets
        "choice": "lowest",
        "ratio": 5.0,
        "tolerance_per_point": 2e-3,
        "free_tolerance": 0.2,
        "margin": None,
    }
    presets: ClassVar[Presets] = {
        "paper": _OTHERS | {"limit": "none", "shortage": "fewer"},
        "reference": _OTHERS | {"limit": "ratio", "shortage": "resample"},
    }


def sized_archive(
    estimates: Evaluated,
    measure: Measure,
    *,
    settings: ArchiveSettings,
    known_count: int,
    dimension: int,
) -> GridArchive:
    """Return an empty archive of vectors (d,), mean +- b_sigma standard deviations (k,) wide.

    Mean and deviations are those of the measures of estimates E' that are no outliers.
    """
    kept = estimates.measures[_inliers(estimates.costs, settings, known_count=known_count)]
    mean, deviation = measure.moments(kept if len(kept) >= 2 else estimates.measures)
    half = settings.range_sigmas * np.maximum(deviation, settings.least_deviation)
    if measure.circular:
        half = np.minimum(half, np.pi)
    return GridArchive(
        measure, mean - half, upper=mean + half, bins=settings.bins, dimension=dimension
    )


def _inliers(costs: FloatArray, settings: ArchiveSettings, *, known_count: int) -> BoolArray:
    if settings.outliers == "none":
        return np.ones(len(costs), dtype=bool)
    if settings.outliers == "quantile":
        return costs < np.quantile(costs, 0.8)
    tolerance = max(settings.tolerance_per_point * known_count, settings.tolerance)
    return costs < settings.ratio * costs.min() + tolerance


def select_elites(
    costs: FloatArray,
    elites: Poses,
    *,
    problem: RegistrationProblem,
    space: SearchSpace,
    settings: OutputSettings,
    stream: np.random.Generator,
) -> IntArray:
    """Return indices of as many of C elites with costs (C,) as E_0 has, or as set; best first."""
    count = len(problem.initial_set)
    known_count = len(problem.points.known)
    order = np.argsort(costs, kind="stable")
    order = order[within_workspace(elites, problem, space=space, margin=settings.margin)[order]]
    good = order[costs[order] <= _limit(costs[order], settings, known_count=known_count)]
    if settings.choice == "representative" and len(good) > count and has_surface(problem.sdf):
        poses = elites[good]
        pool = evenly_spaced(len(poses), max(_POOL, min(2 * count, _MOST_POOL)))
        most = min(count, _MOST_REPRESENTATIVE)
        chosen = pool[representative_poses(problem.sdf, poses[pool], count=most)]
        others = np.setdiff1d(np.arange(len(poses)), chosen)
        others = others[evenly_spaced(len(others), count - len(chosen))]
        return good[np.sort(np.concatenate([chosen, others]))]
    if len(good) >= count or settings.shortage == "fewer":
        return good[:count]
    if settings.shortage == "resample":
        return good[np.sort((stream.random(count) * len(good)).astype(np.int64))]
    return order[np.sort(np.resize(np.arange(len(order)), count))]


def within_workspace(
    poses: Poses, problem: RegistrationProblem, *, space: SearchSpace, margin: float | None
) -> BoolArray:
    """Return True (B,) where the object's origin is in the workspace, widened by a margin (m).

    All True without a margin, or if there is no such pose.
    """
    everywhere = np.ones(len(poses), dtype=bool)
    if margin is None:
        return everywhere
    lower, upper = origin_bounds(problem.workspace, space, margin=margin)
    inside: BoolArray = np.all((poses.origins >= lower) & (poses.origins <= upper), axis=1)
    return inside if inside.any() else everywhere


def _limit(costs: FloatArray, settings: OutputSettings, *, known_count: int) -> float:
    best = float(costs.min())
    if settings.limit == "none":
        return float("inf")
    if settings.limit == "ratio":
        return settings.ratio * best + settings.tolerance
    tolerance = settings.tolerance_per_point * known_count + settings.free_tolerance
    return max(settings.ratio * best, best + tolerance)


def repeated(poses: Poses) -> BoolArray:
    """Return True (B,) for each pose that equals an earlier one."""
    first: dict[tuple[float, ...], int] = {}
    rows = enumerate(map(tuple, poses.numbers.tolist()))
    return np.array([first.setdefault(row, n) < n for n, row in rows], dtype=bool)


def ranked_hypotheses(
    objective: SearchObjective,
    poses: Poses,
    *,
    cells: IntArray | None = None,
    elites: Poses | None = None,
    archive: ArchiveSnapshot | None = None,
) -> Hypotheses:
    """Return poses in order of their costs, which are computed; otherwise as `ranked`."""
    cost = objective.costs(objective.space.encode(poses))
    kept = None if elites is None else elites.matrices
    return ranked(poses.matrices, cost, cells=cells, elites=kept, archive=archive)


def ranked(
    object_from_world: FloatArray,
    cost: FloatArray,
    *,
    cells: IntArray | None = None,
    elites: FloatArray | None = None,
    archive: ArchiveSnapshot | None = None,
) -> Hypotheses:
    """Return poses (B, 4, 4) in order of their costs (B,).

    cells (B,): of the archive that they come from, by default none. elites (L, 4, 4): all
    solutions kept, by default the poses in their order. Raises ChselError if no cost is finite.
    """
    if not np.isfinite(cost).any():
        raise ChselError(
            "no hypothesis has a finite cost; accepted: points, SDF and scales by which the cost "
            "of some pose is finite"
        )
    order = np.argsort(cost, kind="stable")
    poses = object_from_world[order]
    cells = np.full(len(poses), -1, dtype=np.int64) if cells is None else cells[order]
    elites = poses if elites is None else elites
    return Hypotheses(
        poses,
        cost[order],
        duplicate=repeated(Poses.of(poses)),
        cell=cells,
        elites=elites,
        archive=archive,
    )
