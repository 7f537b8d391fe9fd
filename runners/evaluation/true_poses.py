"""True poses of sessions from sensors, which nobody knows: sought near a guess."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from chsel.errors import SessionError
from chsel.numerics.arrays import FloatArray
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import object_symmetry
from chsel.plausible.true_pose import TruePoseSettings, find_true_pose
from chsel.problem.poses import apply, inverse
from chsel.problem.registration_problem import RegistrationProblem


def sought_pose(
    problem: RegistrationProblem,
    mesh: trimesh.Trimesh,
    guess: FloatArray,
    settings: TruePoseSettings,
    truth: FloatArray | None = None,
) -> tuple[FloatArray, dict[str, Any]]:
    """The pose of least evaluation cost near a guess, both world_from_object (4, 4), and numbers.

    problem: of a session's last step. mesh: of the object, m. truth: (4, 4), where it is known. The
    numbers are plain values, for files: metres and radians, modulo the object's symmetries, at its
    centre. Raises SessionError if there is no contact.
    """
    if len(problem.points.known) == 0:
        raise SessionError("there is no contact; accepted: a session that touched the object")
    found, symmetry = find_true_pose(problem, guess, settings), object_symmetry(mesh)
    pose = found.world_from_object

    def apart(other: FloatArray) -> dict[str, float]:
        position, rotation = pose_errors(inverse(pose)[None], other, symmetry)
        return {"position": float(position[0]), "rotation": float(rotation[0])}

    numbers: dict[str, Any] = {
        "cost": found.cost,
        **fit(problem, pose, settings),
        "guess": guess.tolist(),
        "guess_cost": found.guess_cost,
        "from_guess": apart(guess),
    }
    if truth is not None:
        numbers |= {"known": truth.tolist(), "from_known": apart(truth)}
    return pose, numbers


def fit(
    problem: RegistrationProblem, world_from_object: FloatArray, settings: TruePoseSettings
) -> dict[str, Any]:
    """How well a pose (4, 4) fits what is known.

    Mean and greatest distance in metres of known points from where their SDF has their values, and
    how many free points are deeper inside than the tolerance of the evaluation cost.
    """

    def distances(points: FloatArray) -> FloatArray:
        """Signed distances (N,) of points (N, 3) in the world, between the nodes of the grid."""
        return problem.sdf.at(apply(inverse(world_from_object), points), lookup="trilinear")[0]

    points = problem.points
    off = np.abs(distances(points.known) - points.sdf)
    inside = distances(points.free) <= -settings.cost.tolerance
    return {
        "mean_distance": float(off.mean()),
        "most_distance": float(off.max()),
        "violations": int(inside.sum()),
    }


def true_poses(folder: Path, experiment: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What was found in all trials of an evaluation that are there, of sessions from sensors.

    moved, turned: from the guess. position_error, rotation_error: from the truth, where a
    simulation knows it, else None.
    """
    found = []
    for configuration in experiment.get("configurations") or ():
        for seed in experiment.get("seeds") or ():
            path = folder / "trials" / str(configuration) / f"seed_{seed}" / "session.json"
            with suppress(OSError, ValueError, KeyError, TypeError):  # not there, or half there
                numbers = json.loads(path.read_text())["truth"]
                guess, truth = numbers["from_guess"], numbers.get("from_known") or {}
                found.append(
                    {
                        "configuration": configuration,
                        "seed": seed,
                        "mean_distance": numbers["mean_distance"],
                        "violations": numbers["violations"],
                        "moved": guess["position"],
                        "turned": guess["rotation"],
                        "position_error": truth.get("position"),
                        "rotation_error": truth.get("rotation"),
                    }
                )
    return found
