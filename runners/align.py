"""`python -m runners.align FILE position=[x,y,z]`: where the object of real data truly is."""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np
import rerun.blueprint as rrb
import trimesh
from omegaconf import DictConfig

from chsel.errors import RecordingError, SettingError
from chsel.numerics.arrays import FloatArray
from chsel.numerics.threads import threads
from chsel.plausible.pose_scan import TruePoseSettings
from chsel.problem.poses import compose, roll_pitch_yaw
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.settings import build_settings, settings_mapping
from replay.console import Console, print_written
from replay.rerun.scene import Scene
from replay.rerun.stream import PROBE, new_file_stream
from replay.rerun.views import at_last_probe, scene_view
from runners.command.program import command, plain
from runners.evaluation.true_poses import SourceConfig, fit, sought_pose
from runners.reporting.tables import print_table, table_of
from runners.sensors.pose_file import SUFFIX, beside, read_pose, write_pose

Triple = tuple[float, float, float]
_APPLICATION = "chsel alignment"
_GUESS_COLOR = (240, 140, 40, 60)


@dataclass(frozen=True)
class AlignConfig(SourceConfig):
    """conf/align.yaml, which has all defaults and says what they are, checked."""

    search: TruePoseSettings
    position: Triple | None
    rotation: Triple | None
    pose: str | None
    overwrite: bool

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.position is None) == (self.pose is None) or (self.pose and self.rotation):
            raise SettingError(
                "accepted: either position=[x,y,z] rotation=[roll,pitch,yaw], in metres and "
                "radians, or pose=FILE.yaml with world_from_object"
            )

    def guess(self) -> FloatArray:
        """Return world_from_object (4, 4) as a person gave it."""
        if self.pose is not None:
            return read_pose(self.pose)
        rotation = roll_pitch_yaw(np.array(self.rotation or (0.0, 0.0, 0.0)))
        pose = compose(rotation, np.array(self.position))
        if not np.isfinite(pose).all():
            raise SettingError("position or rotation is not finite; accepted: finite numbers")
        return pose


@command("align")
def main(config: DictConfig) -> None:
    """Search, say what was found, and write the pose with a picture of it."""
    checked = build_settings(AlignConfig, plain(config), where="align")
    guess = checked.guess()
    search = checked.search
    pose_path = beside(checked.path)
    pose_path = checked.folder(pose_path.parent) / pose_path.name
    view_path = pose_path.with_name(pose_path.name.removesuffix(SUFFIX) + ".pose.rrd")
    for written in (pose_path, view_path):
        if written.exists() and not checked.overwrite:
            raise RecordingError(f"{written} exists; accepted: overwrite=true, or another out=DIR")
    source = checked.open()
    problem = source.problems.problem(source.steps[-1])
    truth = source.world_from_object
    with threads(checked.threads):
        pose, numbers = sought_pose(problem, source.mesh, guess=guess, settings=search, truth=truth)
    guessed = {"cost": numbers["guess_cost"], **fit(problem, guess, settings=search)}
    points = problem.points
    console = Console(soft_wrap=True)
    title = (
        f"{source.object}, after probe {problem.key.step}: {len(points.contacts)} contacts, "
        f"{len(points.free)} free points"
    )
    lines = [
        {
            "": name,
            "cost C": of["cost"],
            "mean |SDF|\nmm": 1000.0 * of["mean_distance"],
            "most\nmm": 1000.0 * of["most_distance"],
            "free points\ninside": of["violations"],
        }
        for name, of in (("guess", guessed), ("found", numbers))
    ]
    print_table(Console(), table_of(title, lines))
    position = ", ".join(f"{value:.4f}" for value in pose[:3, 3])
    console.print(f"moved from the guess by {_apart(numbers['from_guess'])}, to ({position}) m")
    if truth is not None:
        apart = _apart(numbers["from_known"])
        console.print(f"from the true pose that the recording has: {apart}")
    for warning in _warnings(pose, guess, numbers=numbers, search=search):
        console.print(f"warning: {warning}")
    about = {
        "object": source.object,
        **numbers,
        "search": settings_mapping(search),
        "seed": checked.seed,
        "source": source.digest,
        "sdf": problem.sdf.digest,
    }
    pose_path.parent.mkdir(parents=True, exist_ok=True)
    view_path.unlink(missing_ok=True)
    save_view(view_path, source.mesh, problem=problem, guess=guess, found=pose)
    write_pose(pose_path, pose, about=about, overwrite=checked.overwrite)
    print_written(pose_path, view_path)


def _apart(distance: dict[str, float]) -> str:
    return f"{1000.0 * distance['position']:.1f} mm, {degrees(distance['rotation']):.1f} degrees"


def _warnings(
    pose: FloatArray, guess: FloatArray, *, numbers: dict[str, Any], search: TruePoseSettings
) -> list[str]:
    """Return reasons against the result."""
    offset = np.abs(pose[:3, 3] - guess[:3, 3])
    turned = numbers["from_guess"]["rotation"]
    axis = "xyz"[int(np.argmax(offset))]
    tolerance = 1000.0 * search.cost.tolerance
    doubts = (
        (
            offset.max() > search.reach - search.spacing,
            f"the pose found is at the edge of the search along {axis}: start again from it, "
            f"pose=FILE.pose.yaml overwrite=true, or with search.reach above {search.reach:g} m",
        ),
        (
            turned > 3.0 * search.angle,
            f"the pose found is turned by {degrees(turned):.1f} degrees, further than most that "
            f"are looked at: start again from it, or with search.angle above {search.angle:g} rad",
        ),
        (
            numbers["violations"] > 0,
            f"{numbers['violations']} free points are more than {tolerance:g} mm inside of the "
            "object: the guess, the log's frames or its depth may be off",
        ),
    )
    return [text for is_so, text in doubts if is_so]


def save_view(
    path: Path,
    mesh: trimesh.Trimesh,
    *,
    problem: RegistrationProblem,
    guess: FloatArray,
    found: FloatArray,
) -> None:
    """Write a new .rrd with the known points and the mesh at both poses (4, 4)."""
    with new_file_stream(path, _APPLICATION) as stream:
        stream.set_time(PROBE, sequence=problem.key.step)
        view = scene_view(
            problem.workspace, name="The object where it was found; orange: the guess"
        )
        stream.send_blueprint(at_last_probe(rrb.Vertical(view)))
        scene = Scene(stream)
        scene.set_up(mesh, problem.workspace, world_from_object=found)
        scene.add_mesh("guess", mesh, world_from_mesh=guess, color=_GUESS_COLOR)
        scene.add_points(problem.points)


if __name__ == "__main__":
    main()
