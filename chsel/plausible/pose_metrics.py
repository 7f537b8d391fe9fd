"""Errors of hypotheses to the true pose, and distances to the plausible set."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from chsel.errors import EvaluationError, SettingError
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.plausible.surface_distance import SurfaceDistance
from chsel.plausible.symmetry import grid_symmetry
from chsel.problem.object_symmetry import ObjectSymmetry
from chsel.problem.pose_distances import distances_apart_from
from chsel.problem.poses import Poses, inverse, product, rotated
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem, Trust
from chsel.problem.sdf_grid import FARTHEST, SdfGrid

_NEAR = 10.0  # mm, between surfaces: as near as makes a pose of a set the same as another


def pose_errors(
    object_from_world: FloatArray, world_from_object: FloatArray, *, symmetry: ObjectSymmetry
) -> tuple[FloatArray, FloatArray]:
    """Return position errors (B,) in metres and rotation errors (B,) in radians, modulo symmetries.

    Of hypotheses object_from_world (B, 4, 4) to the true world_from_object (4, 4): the distance
    between the places of the object's centre, and the smallest angle of a rotation between the two
    poses if a symmetry of the object is applied first.
    """
    estimated = inverse(object_from_world)
    centres = rotated(estimated[:, :3, :3], symmetry.centre) + estimated[:, :3, 3]
    centre = rotated(world_from_object[:3, :3], symmetry.centre) + world_from_object[:3, 3]
    relative = product(object_from_world[:, :3, :3], world_from_object[:3, :3])
    distance = np.sqrt(((centres - centre) ** 2).sum(axis=1))
    return distance, symmetry.rotation_errors(relative)


def closest_pose(
    object_from_world: FloatArray, world_from_object: FloatArray, *, sdf: SdfGrid
) -> int:
    """Return the index of the hypothesis (B, 4, 4), B > 0, closest to the true pose (4, 4).

    It is by `outline_distances_to`, so that poses that look the same are as close. Those that no
    kernel can read are left out; the first of equal ones.
    """
    poses = Poses.of(object_from_world)
    truth = Poses.of(inverse(world_from_object)[None])
    readable = (np.abs(poses.numbers) <= FARTHEST).all(axis=1)
    readable &= (np.abs(truth.numbers) <= FARTHEST).all()
    distances = np.full(len(poses), np.inf)
    distances[readable] = distances_apart_from(sdf, poses[readable], other=truth)
    return int(np.argmin(distances))


def result_numbers(
    hypotheses: Hypotheses,
    problem: RegistrationProblem,
    *,
    world_from_object: FloatArray | None,
    symmetry: ObjectSymmetry | None,
    trust: Trust | None = None,
) -> dict[str, float]:
    """Return counts, archive measures, trust, and errors to the true pose (4, 4) if known.

    Errors are those of the best hypothesis and of the closest, see `closest_pose`, in metres and
    radians, as `pose_errors` defines them. symmetry: of the object; None if its mesh is not
    available: the identity alone, about the centre of the problem's grid.
    """
    values = {
        "distinct_hypotheses": float(hypotheses.distinct),
        "known_points": float(problem.points.count),
    }
    if hypotheses.archive is not None:
        values["archive_coverage"] = hypotheses.archive.coverage
        values["archive_qd_score"] = hypotheses.archive.qd_score
    if trust is not None:
        values |= trust.numbers
    if world_from_object is not None and len(hypotheses.object_from_world) > 0:
        symmetry = symmetry or grid_symmetry(problem.sdf)
        position, rotation = pose_errors(
            hypotheses.object_from_world, world_from_object, symmetry=symmetry
        )
        closest = closest_pose(hypotheses.object_from_world, world_from_object, sdf=problem.sdf)
        for name, index in (("best", 0), ("closest", closest)):
            values[f"{name}_position_error"] = float(position[index])
            values[f"{name}_rotation_error"] = float(rotation[index])
    return values


def cheapest(costs: FloatArray, quantile: float) -> BoolArray:
    """Return flags (B,) of hypotheses whose cost is at most this quantile of costs (B,); 1: all."""
    if not 0.0 < quantile <= 1.0:
        raise SettingError(f"quantile is {quantile}; accepted: above 0, at most 1")
    return np.asarray(costs <= np.quantile(costs, quantile, method="higher"))


@dataclass(frozen=True)
class PlausibleDiversity:
    """Distances of hypotheses from the plausible set (CHSEL, Sec. V), mm^2; 0 is best."""

    coverage: float  # mean over plausible poses of the distance to the nearest hypothesis
    plausibility: float  # mean over hypotheses of the distance to the nearest plausible pose
    precision: float  # share of hypotheses near a plausible pose
    recall: float  # share of plausible poses near a hypothesis

    @property
    def diversity(self) -> float:
        """PD = coverage + plausibility, mm^2."""
        return self.coverage + self.plausibility

    @property
    def root(self) -> float:
        """The square root of PD, mm, which compares with lengths."""
        return math.sqrt(self.diversity)


def plausible_diversity(distances: FloatArray) -> PlausibleDiversity:
    """Return the metrics of distances d (B, P) in mm^2, of hypotheses and plausible poses.

    Poses are near each other up to a root mean square distance of 10 mm. Precision and recall of
    pose sets are those of BOP-Distrib (Meden et al., 2024), with this distance in place of theirs.
    Raises EvaluationError if there is none of either.
    """
    if distances.ndim != 2 or 0 in distances.shape:
        raise EvaluationError(
            f"distances have shape {distances.shape}; accepted: (B, P), at least one hypothesis "
            "and one plausible pose"
        )
    nearest_hypothesis, nearest_member = distances.min(axis=0), distances.min(axis=1)
    return PlausibleDiversity(
        coverage=float(nearest_hypothesis.mean()),
        plausibility=float(nearest_member.mean()),
        precision=float((nearest_member <= _NEAR**2).mean()),
        recall=float((nearest_hypothesis <= _NEAR**2).mean()),
    )


def true_pose_rank(
    distance: SurfaceDistance, object_from_world: FloatArray, *, world_from_object: FloatArray
) -> float:
    """Return the share of true pose (4, 4) and hypotheses (B, 4, 4) at least as far out as it.

    Uniform over many registrations if these are calibrated, small if the set is too narrow, or off.
    Raises EvaluationError for fewer than 2 hypotheses.
    """
    count = len(object_from_world)
    if count < 2:
        raise EvaluationError(f"the rank among {count} hypotheses; accepted: at least 2")
    poses = np.concatenate([object_from_world, inverse(world_from_object[None])])
    distances = distance.between(poses, inverse(poses))
    distances = (distances + distances.T) / 2.0
    np.fill_diagonal(distances, 0.0)
    outwards = np.sqrt(distances).sum(axis=1)
    # Rounding must not rank equal poses.
    return float((outwards >= outwards[-1] * (1.0 - 1e-9)).mean())
