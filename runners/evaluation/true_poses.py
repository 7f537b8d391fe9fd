"""True poses of recorded sensors: logs, a rough guess beside each, the best pose near it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from chsel.errors import SessionError, SettingError
from chsel.numerics.arrays import FloatArray
from chsel.numerics.threads import require_threads
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.pose_scan import TruePoseSettings, find_true_pose
from chsel.plausible.symmetry import symmetry_of
from chsel.problem.poses import apply, compose, inverse, roll_pitch_yaw
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.settings import CheckedSettings
from chsel.problem.streams import StreamKey
from runners.command.program import require_used
from runners.evaluation.plan import Plan, Trial
from runners.objects.loader import load_object
from runners.objects.scans import AssetsConfig
from runners.sensors.pose_file import SUFFIX, beside, read_pose, write_pose
from runners.sessions.problem_file import ProblemFile, is_recording, open_problem_file
from runners.simulated_robot.cabinet import CABINET_CONFIGURATIONS
from runners.simulated_robot.settings import RobotSettings

TRUTH = ".truth.yaml"
_POSITION_STEP = 0.01  # metres: about as well as a person sets a pose by hand
_ANGLE_STEP = np.deg2rad(10.0)


@dataclass(frozen=True)
class SourceConfig(CheckedSettings):
    """The settings of a command on a recording, a raw log or known points; Any is for others."""

    object: Any
    session: Any
    assets: AssetsConfig
    file: str | None
    out: str | None
    seed: int
    threads: Annotated[int, require_threads]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.file:
            raise SettingError("file is missing; pass a recording.mcap, a raw log or known points")
        StreamKey(self.seed, 0)

    @property
    def path(self) -> Path:
        """The file."""
        return Path(self.file or "").expanduser()

    def folder(self, usual: Path) -> Path:
        """Return the folder to write to."""
        return Path(self.out).expanduser() if self.out else usual

    def open(self) -> ProblemFile:
        """Return the content of the file; raise SettingError for settings that it makes useless."""
        if is_recording(self.path):
            accepted = "a raw log or known points with it"
            reason = f"the recording {self.path} brings its own object and points"
            require_used("object", "session", "session/rig", reason=reason, accepted=accepted)
        return open_problem_file(
            self.path, self.object, session=self.session, assets=self.assets.folder, seed=self.seed
        )


def sought_pose(
    problem: RegistrationProblem,
    mesh: trimesh.Trimesh,
    *,
    guess: FloatArray,
    settings: TruePoseSettings,
    truth: FloatArray | None = None,
) -> tuple[FloatArray, dict[str, Any]]:
    """Return the pose of least evaluation cost near a guess, and numbers about it.

    problem: of a session's last step. mesh: of the object, m. truth: (4, 4), where it is known. The
    numbers are plain values: metres and radians, modulo the object's symmetries, at its centre.
    Raise SessionError if there is no contact.
    """
    if len(problem.points.known) == 0:
        raise SessionError("there is no contact; accepted: a session that touched the object")
    found = find_true_pose(problem, guess, settings=settings)
    symmetry = symmetry_of(problem.sdf, mesh)
    pose = found.world_from_object

    def apart(other: FloatArray) -> dict[str, float]:
        position, rotation = pose_errors(inverse(pose)[None], other, symmetry=symmetry)
        return {"position": float(position[0]), "rotation": float(rotation[0])}

    numbers: dict[str, Any] = {
        "cost": found.cost,
        **fit(problem, pose, settings=settings),
        "guess": guess.tolist(),
        "guess_cost": found.guess_cost,
        "from_guess": apart(guess),
    }
    if truth is not None:
        numbers |= {"known": truth.tolist(), "from_known": apart(truth)}
    return pose, numbers


def fit(
    problem: RegistrationProblem, world_from_object: FloatArray, *, settings: TruePoseSettings
) -> dict[str, Any]:
    """Return how well a pose (4, 4) fits the known points.

    Mean and greatest distance in metres of known points from where their SDF has their values, and
    how many free points are deeper inside than the tolerance of the evaluation cost.
    """

    def distances(points: FloatArray) -> FloatArray:
        """Return signed distances (N,) of points (N, 3), world, between the nodes of the grid."""
        return problem.sdf.at(apply(inverse(world_from_object), points), lookup="trilinear")[0]

    points = problem.points
    off = np.abs(distances(points.known) - points.sdf)
    inside = distances(points.free) <= -settings.cost.tolerance
    return {
        "mean_distance": float(off.mean()),
        "most_distance": float(off.max()),
        "violations": int(inside.sum()),
    }


def pose_beside(path: Path) -> FloatArray:
    """Return world_from_object (4, 4) of the pose file beside a log, a recording or points."""
    if not beside(path).exists():
        raise SettingError(
            f"{path} has no true pose, and there is no {beside(path).name} beside it; accepted: a "
            f"pose that `python -m runners.align {path} position=[x,y,z] rotation=[roll,pitch,yaw]`"
            " finds, with object=NAME session/rig=NAME for a log"
        )
    return read_pose(beside(path))


def check_log(plan: Plan, trial: Trial) -> None:
    """Raise SettingError unless a trial's log and a guess of its pose are there, or can be made."""
    if plan.configurations[trial.configuration].log_folder is not None:
        if not trial.log(plan).exists():
            raise SettingError(
                f"there is no {trial.log(plan)}; accepted: seeds of which there are logs"
            )
        pose_beside(trial.log(plan))


def ensure_log(plan: Plan, trial: Trial) -> Path:
    """Return the log of a trial; it is simulated if it is missing and a simulated robot's."""
    log = trial.log(plan)
    if not is_missing(plan, trial):
        return log
    from runners.simulated_robot.simulation import simulate_log  # imports the physics engine

    log.parent.mkdir(parents=True, exist_ok=True)
    model = load_object(plan.object_config(trial.configuration), plan.assets)
    configuration = CABINET_CONFIGURATIONS[trial.configuration]
    made = simulate_log(
        log, configuration, mesh=model.mesh, seed=trial.seed, settings=RobotSettings()
    )
    about = {"object": model.name, "scale": model.scale, "configuration": trial.configuration}
    about |= {"seed": trial.seed}
    write_pose(_truth_path(log), made.world_from_object, about=about, overwrite=True)
    return log


def is_missing(plan: Plan, trial: Trial) -> bool:
    """Return whether a trial's log, or the file of its object's pose, is still to be simulated."""
    log = trial.log(plan)
    there = log.exists() and (beside(log).exists() or _truth_path(log).exists())
    return plan.configurations[trial.configuration].log_folder is None and not there


def guessed_pose(log: Path) -> FloatArray:
    """Return a rough world_from_object (4, 4): beside the log, or its simulated truth rounded."""
    truth = None if beside(log).exists() else simulated_truth(log)
    return pose_beside(log) if truth is None else as_set_by_hand(truth)


def simulated_truth(log: Path) -> FloatArray | None:
    """Return world_from_object (4, 4) of a simulated log, for comparison; else None."""
    path = _truth_path(log)
    return read_pose(path) if path.exists() else None


def as_set_by_hand(world_from_object: FloatArray) -> FloatArray:
    """Return a pose (4, 4) to whole centimetres, and to whole 10 degrees of roll, pitch and yaw."""
    position = np.rint(world_from_object[:3, 3] / _POSITION_STEP) * _POSITION_STEP
    angles = Rotation.from_matrix(world_from_object[:3, :3]).as_euler("xyz")
    return compose(roll_pitch_yaw(np.rint(angles / _ANGLE_STEP) * _ANGLE_STEP), position)


def _truth_path(log: Path) -> Path:
    path = beside(log)
    return path.with_name(path.name.removesuffix(SUFFIX) + TRUTH)
