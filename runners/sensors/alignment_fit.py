"""How well a pose fits what is known, in numbers that a person can judge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.plausible.plausible_settings import EvaluationCostSettings
from chsel.problem.poses import apply, inverse
from chsel.problem.registration_problem import RegistrationProblem


@dataclass(frozen=True, eq=False)
class Fit:
    """Of world_from_object (4, 4): evaluation cost; mean and greatest distance in metres of known
    points from where their SDF has their values; free points inside of the object."""

    world_from_object: FloatArray
    cost: float
    mean_distance: float
    most_distance: float
    violations: int


def fit_of(
    problem: RegistrationProblem,
    world_from_object: FloatArray,
    cost: float,
    settings: EvaluationCostSettings,
) -> Fit:
    """The fit of a pose (4, 4); free points count that are deeper inside than the tolerance."""
    points, object_from_world = problem.points, inverse(world_from_object)
    off = np.abs(_distances(problem, object_from_world, points.known) - points.sdf)
    free = _distances(problem, object_from_world, points.free)
    return Fit(
        world_from_object,
        cost,
        float(off.mean()) if len(off) else 0.0,
        float(off.max(initial=0.0)),
        int((free <= -settings.tolerance).sum()),
    )


def _distances(
    problem: RegistrationProblem, object_from_world: FloatArray, points: FloatArray
) -> FloatArray:
    """Signed distances (N,) of points (N, 3) in the world, between the nodes of the grid."""
    return problem.sdf.at(apply(object_from_world, points), lookup="trilinear")[0]
