"""How far to trust hypotheses: whether they explain the points, and whether they are alike.

The set is judged by the object's signed distances, whatever the method and its cost are.
docs/trust.md has the model, and what its limits were chosen on.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from chsel.errors import PointsWarning, PoseError, require_positive
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.numerics.threads import spread
from chsel.problem.freedom import can_be_moved
from chsel.problem.noise import FOREIGN, FREEDOMS, estimate_noise
from chsel.problem.outline import (
    in_order,
    outline_distances,
    signed_distances,
    surface_spread,
)
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import VERDICTS, Hypotheses, RegistrationProblem, Trust
from chsel.problem.sdf_grid import FARTHEST, SdfGrid
from chsel.problem.sdf_lookup import add_depths, distance_field
from chsel.problem.subset import evenly_spaced, poses_per_thread

SENSOR_NOISE = 0.0005  # metres, of known points, where nothing is known about the sensor
DETERMINED, SEVERAL, WIDE, NOTHING = VERDICTS

# In diameters of the object:
MOST_OFF = 0.04  # average error of points
MOST_SYSTEMATIC = 0.012  # the same, if errors of neighbours are alike
MOST_WIDTH = 0.03  # spread of a mode, and distance from a pose to the next one of its mode

MOST_OUTLIERS = 0.3  # share
MOST_MODES = 8  # sets of more are wide
MOST_LEVELS = 10.0  # sensor noise levels that errors may have without a warning
LEAST_LEVELS = 3.0  # sensor noise levels that errors and widths may have on small objects
LEAST_GAP = 2.0  # noise levels, as estimated, between modes
SYSTEMATIC = 0.5  # correlation of the errors of neighbours
ALIKE = 2.0  # times the error of the best hypothesis: those of more do not count as explanations
_GRID_ERROR = 0.3  # of interpolated distances, in spacings of nodes
_NEIGHBOURS = 3
_LEAST_CORRELATED = 8  # points

_MOST_HYPOTHESES = 100  # that are compared, the best ones
_MOST_KNOWN, _MOST_FREE = 1000, 5000  # points that they are compared by
_MOST_CORRELATED = 300


def trust_in(
    problem: RegistrationProblem, hypotheses: Hypotheses, sensor_noise: float = SENSOR_NOISE
) -> Trust:
    """How far to trust the hypotheses of a problem; a pure function, the same bits everywhere.

    sensor_noise: standard deviation of known points by the sensor's datasheet, metres.
    Raises PoseError if there is no hypothesis or the best is not finite, and SettingError for noise
    that is not above 0.
    """
    require_positive("sensor_noise", sensor_noise)
    (poses, indices), sdf = _compared(hypotheses), problem.sdf
    off = signed_distances(sdf, poses[:1], problem.points.known)[0] - problem.points.sdf
    noise = estimate_noise(off, sensor_noise)
    most = FOREIGN * noise.sigma
    error = float(_mean_errors(problem, poses[:1], sensor_noise, most)[0])
    alike = correlation(problem.points.known, np.clip(off, -most, most)) > SYSTEMATIC
    share = MOST_SYSTEMATIC if alike else MOST_OFF
    limit = max(share * sdf.diameter, _GRID_ERROR * sdf.resolution, LEAST_LEVELS * sensor_noise)

    errors = _mean_errors(problem, poses, sensor_noise, most, thinned=True)
    least = max(float(errors[0]), sensor_noise, _GRID_ERROR * sdf.resolution / ALIKE)
    explaining = errors <= ALIKE * least
    poses, indices = poses[explaining], indices[explaining]
    apart = outline_distances(sdf, poses)
    width = max(MOST_WIDTH * sdf.diameter, LEAST_LEVELS * sensor_noise)
    gap = max(width, LEAST_GAP * noise.sigma)
    count, mode = _components(apart <= gap)
    parts = [np.flatnonzero(mode == one) for one in range(count)]
    redundancy = max(len(off) - FREEDOMS, 0)
    if error > limit or noise.outliers > MOST_OUTLIERS:
        count, verdict = 0, NOTHING
    elif (
        redundancy + len(problem.points.free) + len(problem.points.occupied) == 0
        or count > MOST_MODES
        or max(surface_spread(apart[np.ix_(part, part)]) for part in parts) > width
        or any(can_be_moved(problem, poses[part[:1]], noise.sigma, width) for part in parts)
    ):
        count, verdict = 0, WIDE
    else:
        verdict = DETERMINED if count == 1 else SEVERAL
    misfit, spread = error / sensor_noise, surface_spread(apart)
    best = tuple(int(indices[part[0]]) for part in parts[: max(count, 1)])
    return Trust(noise.sigma, noise.outliers, misfit, count, spread, verdict, redundancy, best)


def check_trust(trust: Trust, sensor_noise: float = SENSOR_NOISE) -> list[PointsWarning]:
    """A warning if no hypothesis explains the points, or not with the sensor's noise, metres.

    The texts have no measured numbers, so that Python shows repeated ones once.
    """
    if trust.verdict == NOTHING:
        text = (
            "no hypothesis explains the points, see the trust in the result; check units, frames, "
            "the object and its scale, and whether it moved"
        )
        return [PointsWarning("no_fit", text)]
    if trust.misfit <= MOST_LEVELS:
        return []
    text = (
        f"points are more than {MOST_LEVELS:g} noise levels off the best hypothesis on average, "
        f"see the trust in the result: the sensor is less exact than {sensor_noise:g} m, the "
        "object is not quite this one, or a better pose was not found"
    )
    return [PointsWarning("above_noise", text)]


def correlation(points: FloatArray, errors: FloatArray) -> float:
    """How alike the errors (N,) of points (N, 3) are to those of their nearest neighbours.

    Moran's I about 0, at most 1: near 0 for noise, and near 1 for a wrong shape, whose errors are
    those of whole sides. 0 for few points.
    """
    chosen = evenly_spaced(len(points), _MOST_CORRELATED)
    points, errors = points[chosen], errors[chosen]
    if len(points) < _LEAST_CORRELATED:
        return 0.0
    away = points[:, None] - points
    squared = away[..., 0] ** 2 + away[..., 1] ** 2 + away[..., 2] ** 2
    np.fill_diagonal(squared, np.inf)
    near = np.argsort(squared, axis=1, kind="stable")[:, :_NEIGHBOURS]
    own = math.fsum((errors**2).tolist())
    shared = math.fsum((errors[:, None] * errors[near]).ravel().tolist())
    return shared / (_NEIGHBOURS * own) if own > 0.0 else 0.0


def has_pose(hypotheses: Hypotheses) -> bool:
    """Whether the best hypothesis is a pose that can be judged: there, and within FARTHEST."""
    poses = Poses.of(hypotheses.object_from_world[:1])
    return len(poses) > 0 and bool(_within(poses).all())


def _within(poses: Poses) -> BoolArray:
    """Which poses (B,) have no number that is NaN or larger than kernels can read."""
    return np.asarray((np.abs(poses.numbers) <= FARTHEST).all(axis=1))


def _compared(hypotheses: Hypotheses) -> tuple[Poses, IntArray]:
    """The best hypotheses that repeat no other, and their indices."""
    if not has_pose(hypotheses):
        raise PoseError(
            "there is no hypothesis, or the best is not finite; accepted: at least one pose, "
            f"within {FARTHEST:g} m"
        )
    poses = Poses.of(hypotheses.object_from_world)
    chosen = _within(poses) & ~hypotheses.duplicate
    chosen[0] = True
    indices = np.flatnonzero(chosen)[:_MOST_HYPOTHESES]
    return poses[indices], indices


def _mean_errors(
    problem: RegistrationProblem,
    poses: Poses,
    sensor_noise: float,
    most: float,
    *,
    thinned: bool = False,
) -> FloatArray:
    """Average error (B,), metres, of known points, and of all others that contradict a pose.

    most: that a known point counts for. A free point contradicts a pose if it is deeper in the
    object than a voxel and noise explain, an occupied one if it is as far outside; it counts with
    its depth. thinned: by some of the points of each class, which count for all.
    """
    points, sdf = problem.points, problem.sdf
    known = evenly_spaced(len(points.known), _MOST_KNOWN if thinned else len(points.known))
    off = np.abs(signed_distances(sdf, poses, points.known[known]) - points.sdf[known])
    total, count = in_order(np.minimum(off, most)), np.full(len(poses), float(len(known)))
    tolerance = problem.free_resolution + LEAST_LEVELS * sensor_noise
    known_share = len(known) / max(len(points.known), 1)
    for sign, group in ((-1.0, points.free), (1.0, points.occupied)):
        some = evenly_spaced(len(group), _MOST_FREE if thinned else len(group))
        depth, wrong = _contradictions(sdf, poses, group[some], sign, tolerance)
        each = (known_share or 1.0) * len(group) / max(len(some), 1)
        total += each * depth
        count += each * wrong
    return total / np.maximum(count, 1.0)


def _contradictions(
    sdf: SdfGrid, poses: Poses, points: FloatArray, sign: float, tolerance: float
) -> tuple[FloatArray, FloatArray]:
    """The sum of the depths (B,), metres, of points deeper than a tolerance, and their number (B,).

    sign: 1 for depths outside of the object, -1 for those inside.
    """
    field, numbers = distance_field(sdf, "trilinear", "surface_point"), np.array(poses.numbers)
    places, (depths, counts) = np.array(points), np.empty((2, len(poses)))
    limits = sign, tolerance, FARTHEST

    def run(first: int, last: int, _: Any) -> None:
        add_depths(field, numbers, places, limits, depths, counts, first, last)

    spread(run, len(poses), lambda: None, least=poses_per_thread(len(points)))
    return depths, counts


def _components(adjacent: BoolArray) -> tuple[int, IntArray]:
    """How many parts a symmetric graph (K, K) has, and the part of each of its nodes (K,)."""
    count, part = 0, np.full(len(adjacent), -1)
    for first in range(len(adjacent)):
        if part[first] >= 0:
            continue
        reached = np.zeros(len(adjacent), dtype=np.bool_)
        newest = np.arange(len(adjacent)) == first
        while newest.any():
            reached |= newest
            newest = adjacent[newest].any(axis=0) & ~reached
        part[reached], count = count, count + 1
    return count, part
