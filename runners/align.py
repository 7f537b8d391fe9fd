"""`python -m runners.align FILE position=[x,y,z]`: where the object of real data truly is."""

from __future__ import annotations

from contextlib import ExitStack
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
from chsel.numerics.threads import require_threads, threads
from chsel.plausible.pose_scan import TruePoseSettings
from chsel.problem.poses import compose, roll_pitch_yaw
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.settings import build_settings, settings_mapping
from chsel.problem.streams import StreamKey
from replay.console import Console
from replay.rerun.scene import Scene
from replay.rerun.stream import PROBE, new_file_stream
from replay.rerun.views import at_last_probe, scene_view
from runners.command.program import command, plain
from runners.evaluation.true_poses import fit, sought_pose
from runners.objects.scans import AssetsConfig
from runners.reporting.tables import Table, print_table, table_of
from runners.sensors.pose_file import SUFFIX, beside, read_pose, write_pose
from runners.sessions.problem_source import Source, open_source

Triple = tuple[float, float, float]
_VIEW = ".pose.rrd"
_APPLICATION = "chsel alignment"
_GUESS_COLOR = (240, 140, 40, 60)


@dataclass(frozen=True)
class AlignConfig:
    """conf/align.yaml, which has all defaults, checked.

    object, session: checked where they are used. position: of the object's frame in the world,
    metres. rotation: roll, pitch, yaw, radians, about the world's x, y, z in this order. pose: a
    pose file in place of both. out: folder of what is written; None: beside the file.
    """

    object: Any
    session: Any
    assets: AssetsConfig
    search: TruePoseSettings
    file: str | None
    position: Triple | None
    rotation: Triple | None
    pose: str | None
    out: str | None
    overwrite: bool
    seed: int
    threads: int

    def __post_init__(self) -> None:
        if not self.file:
            raise SettingError("file is missing; pass a recording.mcap or a raw log")
        if (self.position is None) == (self.pose is None):
            raise SettingError(
                "accepted: either position=[x,y,z] rotation=[roll,pitch,yaw], in metres and "
                "radians, or pose=FILE.yaml with world_from_object"
            )
        if self.pose is not None and self.rotation is not None:
            raise SettingError("rotation is given beside pose; accepted: one of both")
        StreamKey(self.seed, 0)
        require_threads("threads", self.threads)

    def guess(self) -> FloatArray:
        """world_from_object (4, 4) as a person gave it."""
        if self.pose is not None:
            return read_pose(self.pose)
        position = np.array(self.position)
        rotation = roll_pitch_yaw(np.array(self.rotation or (0.0, 0.0, 0.0)))
        if not np.isfinite(position).all() or not np.isfinite(rotation).all():
            raise SettingError("position or rotation is not finite; accepted: finite numbers")
        return compose(rotation, position)


@command("align")
def main(config: DictConfig) -> None:
    """Search, say what was found, and write the pose with a picture of it."""
    checked = build_settings(AlignConfig, plain(config), "align")
    guess = checked.guess()
    path = Path(checked.file or "").expanduser()
    pose_path = beside(path)
    if checked.out is not None:
        pose_path = Path(checked.out).expanduser() / pose_path.name
    view_path = pose_path.with_name(pose_path.name.removesuffix(SUFFIX) + _VIEW)
    for written in (pose_path, view_path):
        if written.exists() and not checked.overwrite:
            raise RecordingError(f"{written} exists; accepted: overwrite=true, or another out=DIR")
    source = open_source(path, checked.object, checked.session, checked.assets.folder, checked.seed)
    problem, search = source.problems.problem(source.steps[-1]), checked.search
    console, waiting = Console(soft_wrap=True), Console(stderr=True)
    with threads(checked.threads), ExitStack() as stack:
        if waiting.is_terminal:
            stack.enter_context(waiting.status("searching"))
        truth = source.world_from_object
        pose, numbers = sought_pose(problem, source.mesh, guess, search, truth)
    guessed = {"cost": numbers["guess_cost"], **fit(problem, guess, search)}
    print_table(Console(), _table(_title(source, problem), {"guess": guessed, "found": numbers}))
    position = ", ".join(f"{value:.4f}" for value in pose[:3, 3])
    console.print(f"moved from the guess by {_apart(numbers['from_guess'])}, to ({position}) m")
    if truth is not None:
        apart = _apart(numbers["from_known"])
        console.print(f"from the true pose that the recording has: {apart}")
    for warning in _warnings(pose, guess, numbers, search):
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
    save_view(view_path, source.mesh, problem, guess, pose)
    write_pose(pose_path, pose, about, overwrite=checked.overwrite)
    for written in (pose_path, view_path):
        console.print(str(written))


def _title(source: Source, problem: RegistrationProblem) -> str:
    points = problem.points
    return (
        f"{source.object}, after probe {problem.key.step}: {len(points.contacts)} contacts, "
        f"{len(points.free)} free points"
    )


def _table(title: str, fits: dict[str, dict[str, Any]]) -> Table:
    lines = [
        {
            "": name,
            "cost C": numbers["cost"],
            "mean |SDF|\nmm": 1000.0 * numbers["mean_distance"],
            "most\nmm": 1000.0 * numbers["most_distance"],
            "free points\ninside": numbers["violations"],
        }
        for name, numbers in fits.items()
    ]
    return table_of(title, lines)


def _apart(distance: dict[str, float]) -> str:
    return f"{1000.0 * distance['position']:.1f} mm, {degrees(distance['rotation']):.1f} degrees"


def _warnings(
    pose: FloatArray, guess: FloatArray, numbers: dict[str, Any], search: TruePoseSettings
) -> list[str]:
    """What speaks against the result."""
    warnings = []
    offset, turned = np.abs(pose[:3, 3] - guess[:3, 3]), numbers["from_guess"]["rotation"]
    if offset.max() > search.reach - search.spacing:
        axis = "xyz"[int(np.argmax(offset))]
        warnings.append(
            f"the pose found is at the edge of the search along {axis}: start again from it, "
            f"pose=FILE.pose.yaml overwrite=true, or with search.reach above {search.reach:g} m"
        )
    if turned > 3.0 * search.angle:
        warnings.append(
            f"the pose found is turned from the guess by {degrees(turned):.1f} degrees, further "
            f"than most that are looked at: start again from it, or with search.angle above "
            f"{search.angle:g} rad"
        )
    if numbers["violations"]:
        warnings.append(
            f"{numbers['violations']} free points are more than "
            f"{1000.0 * search.cost.tolerance:g} mm inside of the object: the guess, the log's "
            "frames or its depth may be off"
        )
    return warnings


def save_view(
    path: Path,
    mesh: trimesh.Trimesh,
    problem: RegistrationProblem,
    guess: FloatArray,
    found: FloatArray,
) -> None:
    """Write a new .rrd with the known points and the mesh at both poses (4, 4), world_from_object.

    Raises RecordingError if the file exists or cannot be written.
    """
    with new_file_stream(path, _APPLICATION) as stream:
        stream.set_time(PROBE, sequence=problem.key.step)
        view = scene_view(
            problem.workspace, name="The object where it was found; orange: the guess"
        )
        stream.send_blueprint(at_last_probe(rrb.Vertical(view)))
        scene = Scene(stream)
        scene.set_up(mesh, problem.workspace, found)
        scene.add_mesh("guess", mesh, guess, _GUESS_COLOR)
        scene.add_points(problem.points)


if __name__ == "__main__":
    main()
