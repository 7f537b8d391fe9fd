"""True poses of recorded sensors: logs, a rough guess beside each, the best pose near it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from chsel.errors import SessionError, SettingError
from chsel.numerics.arrays import FloatArray
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.pose_scan import TruePoseSettings, find_true_pose
from chsel.plausible.symmetry import object_symmetry
from chsel.problem.poses import apply, compose, inverse, roll_pitch_yaw
from chsel.problem.registration_problem import RegistrationProblem
from runners.evaluation.plan import Plan, Trial
from runners.objects.loader import load_object
from runners.sensors.pose_file import SUFFIX, beside, read_pose, write_pose
from runners.simulated_robot.cabinet import CABINET_CONFIGURATIONS
from runners.simulated_robot.settings import RobotSettings

TRUTH = ".truth.yaml"
_POSITION_STEP = 0.01  # metres: about as well as a person sets a pose by hand
_ANGLE_STEP = np.deg2rad(10.0)


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
    for configuration in experiment["configurations"]:
        for seed in experiment["seeds"]:
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


def check_log(plan: Plan, trial: Trial) -> None:
    """Raise SettingError unless a trial's log and a guess of its pose are there, or can be made."""
    configuration, log = plan.configurations[trial.configuration], trial.log(plan)
    if configuration.log_folder is None:
        return
    if not log.exists():
        raise SettingError(f"there is no {log}; accepted: seeds of which there are logs")
    if not beside(log).exists():
        raise SettingError(
            f"there is no {beside(log)}; accepted: the pose that `python -m runners.align {log} "
            "object=NAME session/rig=NAME position=[x,y,z] rotation=[roll,pitch,yaw]` finds"
        )
    read_pose(beside(log))


def ensure_log(plan: Plan, trial: Trial) -> Path:
    """The log of a trial; it is simulated if it is missing and a simulated robot's."""
    log = trial.log(plan)
    if not is_missing(plan, trial):
        return log
    from runners.simulated_robot.simulation import simulate_log  # imports the physics engine

    log.parent.mkdir(parents=True, exist_ok=True)
    model = load_object(plan.object_config(trial.configuration), plan.assets)
    configuration = CABINET_CONFIGURATIONS[trial.configuration]
    made = simulate_log(log, configuration, model.mesh, trial.seed, RobotSettings())
    about = {"object": model.name, "scale": model.scale, "configuration": trial.configuration}
    about |= {"seed": trial.seed}
    write_pose(_truth_path(log), made.world_from_object, about, overwrite=True)
    return log


def is_missing(plan: Plan, trial: Trial) -> bool:
    """Whether a trial's log is still to be simulated."""
    recorded = plan.configurations[trial.configuration].log_folder is not None
    return not recorded and not _is_usable(trial.log(plan))


def guessed_pose(log: Path) -> FloatArray:
    """world_from_object (4, 4) about where a log's object is.

    That of the pose file beside it; of a simulated robot its truth, as roughly as a person
    sets a pose.
    """
    if beside(log).exists():
        return read_pose(beside(log))
    truth = simulated_truth(log)
    if truth is None:
        raise SettingError(f"there is no {beside(log)}; accepted: a pose that runners.align finds")
    return as_set_by_hand(truth)


def simulated_truth(log: Path) -> FloatArray | None:
    """world_from_object (4, 4) of a simulated log, to which results are compared; else None."""
    path = _truth_path(log)
    return read_pose(path) if path.exists() else None


def as_set_by_hand(world_from_object: FloatArray) -> FloatArray:
    """A pose (4, 4) to whole centimetres, and to whole 10 degrees of roll, pitch and yaw."""
    position = np.rint(world_from_object[:3, 3] / _POSITION_STEP) * _POSITION_STEP
    angles = np.rint(angles_of(world_from_object[:3, :3]) / _ANGLE_STEP) * _ANGLE_STEP
    return compose(roll_pitch_yaw(angles), position)


def angles_of(rotation: FloatArray) -> FloatArray:
    """Angles (3,) about the world's x, y and z, in this order, of a rotation (3, 3)."""
    pitch = np.arcsin(np.clip(-rotation[2, 0], -1.0, 1.0))
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    return np.array([roll, pitch, np.arctan2(rotation[1, 0], rotation[0, 0])])


def _truth_path(log: Path) -> Path:
    path = beside(log)
    return path.with_name(path.name.removesuffix(SUFFIX) + TRUTH)


def _is_usable(log: Path) -> bool:
    """Whether there is a log with something that tells about its object's pose."""
    return log.exists() and (beside(log).exists() or _truth_path(log).exists())
