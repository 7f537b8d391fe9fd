"""The raw log of a trial: where it is, how it is simulated, and about where its object is."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from chsel.errors import SettingError
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import compose, roll_pitch_yaw
from runners.evaluation.plan import Plan, Trial
from runners.objects.loader import load_object
from runners.sensors.pose_file import SUFFIX, beside, read_pose, write_pose
from runners.simulated_robot.cabinet import CABINET_CONFIGURATIONS
from runners.simulated_robot.settings import RobotSettings

TRUTH = ".truth.yaml"
_POSITION_STEP = 0.01  # metres: about as well as a person sets a pose by hand
_ANGLE_STEP = np.deg2rad(10.0)


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
