"""Numbers about the result of a registration."""

from __future__ import annotations

import numpy as np

from chsel.arrays import FloatArray
from chsel.evaluation.pose_error import pose_errors
from chsel.evaluation.symmetry import ObjectSymmetry, grid_symmetry
from chsel.problem import Hypotheses, RegistrationProblem


def result_numbers(
    hypotheses: Hypotheses,
    problem: RegistrationProblem,
    world_from_object: FloatArray | None,
    symmetry: ObjectSymmetry | None,
) -> dict[str, float]:
    """Counts and archive measures, and the errors to the true pose (4, 4) where it is known.

    Errors are those of the best hypothesis and of the one closest in position, in metres and
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
    if world_from_object is not None and len(hypotheses.object_from_world) > 0:
        symmetry = symmetry or grid_symmetry(problem.sdf)
        position, rotation = pose_errors(hypotheses.object_from_world, world_from_object, symmetry)
        closest = int(np.argmin(position))
        for name, index in (("best", 0), ("closest", closest)):
            values[f"{name}_position_error"] = float(position[index])
            values[f"{name}_rotation_error"] = float(rotation[index])
    return values
