"""`python -m runners.align FILE position=[x,y,z]`: where the object of real data truly is."""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import trimesh
from omegaconf import DictConfig
from rich.box import SIMPLE_HEAD
from rich.table import Table

from chsel.errors import RecordingError, SettingError
from chsel.numerics.arrays import FloatArray
from chsel.numerics.threads import require_threads, threads
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.pose_scan import TruePose, TruePoseSettings, find_true_pose
from chsel.plausible.symmetry import ObjectSymmetry, object_symmetry
from chsel.problem.poses import compose, inverse, roll_pitch_yaw
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.settings import build_settings, settings_mapping
from chsel.problem.streams import StreamKey
from replay.console import Console
from replay.rerun.blueprint import at_last_probe, scene_view
from replay.rerun.clock import PROBE
from replay.rerun.meshes import display_mesh
from replay.rerun.scene import Scene
from replay.rerun.stream import new_file_stream
from runners.command.program import command, plain
from runners.objects.scans import AssetsConfig
from runners.sensors.alignment_fit import Fit, fit_of
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
    _check_new(pose_path, view_path, overwrite=checked.overwrite)
    source = open_source(path, checked.object, checked.session, checked.assets.folder, checked.seed)
    problem = source.problems.problem(source.steps[-1])
    if len(problem.points.known) == 0:
        raise SettingError(f"{path} has no contact; accepted: a session that touched the object")
    console, waiting = Console(), Console(stderr=True)
    with threads(checked.threads):
        if waiting.is_terminal:
            with waiting.status("searching"):
                found = find_true_pose(problem, guess, checked.search)
        else:
            found = find_true_pose(problem, guess, checked.search)
    fits = {
        "guess": fit_of(problem, guess, found.guess_cost, checked.search.cost),
        "found": fit_of(problem, found.world_from_object, found.cost, checked.search.cost),
    }
    console.print(_title(source, problem), style="bold", soft_wrap=True)
    console.print(_table(fits))
    symmetry = object_symmetry(source.mesh)
    moved = _between(found.world_from_object, guess, symmetry)
    console.print(f"moved from the guess by {_apart(*moved)}")
    if source.world_from_object is not None:
        apart = _apart(*_between(found.world_from_object, source.world_from_object, symmetry))
        console.print(f"from the true pose that the recording has: {apart}")
    for warning in _warnings(found, guess, moved[1], fits["found"], checked.search):
        console.print(f"warning: {warning}", soft_wrap=True)
    pose_path.parent.mkdir(parents=True, exist_ok=True)
    about = _about(checked, source, found, guess, fits["found"])
    view_path.unlink(missing_ok=True)
    save_view(view_path, source.mesh, problem, guess, found.world_from_object)
    write_pose(pose_path, found.world_from_object, about, overwrite=checked.overwrite)
    for written in (pose_path, view_path):
        console.print(str(written), soft_wrap=True)


def _check_new(*paths: Path, overwrite: bool) -> None:
    for path in paths:
        if path.exists() and not overwrite:
            raise RecordingError(f"{path} exists; accepted: overwrite=true, or another out=DIR")


def _title(source: Source, problem: RegistrationProblem) -> str:
    points = problem.points
    return (
        f"{source.object}, after probe {problem.key.step}: {len(points.contacts)} contacts, "
        f"{len(points.free)} free points"
    )


def _table(fits: dict[str, Fit]) -> Table:
    table = Table(box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for heading in (
        "",
        "cost C",
        "mean |SDF|\nmm",
        "most\nmm",
        "free points\ninside",
        "position\nm",
    ):
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for name, fit in fits.items():
        x, y, z = fit.world_from_object[:3, 3]
        table.add_row(
            name,
            f"{fit.cost:.4g}",
            f"{1000.0 * fit.mean_distance:.2f}",
            f"{1000.0 * fit.most_distance:.2f}",
            str(fit.violations),
            f"{x:.4f} {y:.4f} {z:.4f}",
        )
    return table


def _between(one: FloatArray, other: FloatArray, symmetry: ObjectSymmetry) -> tuple[float, float]:
    """Metres and radians between two world_from_object (4, 4), as `pose_errors` defines them."""
    position, rotation = pose_errors(inverse(one)[None], other, symmetry)
    return float(position[0]), float(rotation[0])


def _apart(position: float, rotation: float) -> str:
    return f"{1000.0 * position:.1f} mm, {degrees(rotation):.1f} degrees"


def _warnings(
    found: TruePose, guess: FloatArray, turned: float, fit: Fit, search: TruePoseSettings
) -> list[str]:
    """What speaks against the result. turned: from the guess, radians."""
    warnings = []
    offset = np.abs(found.world_from_object[:3, 3] - guess[:3, 3])
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
    if fit.violations:
        warnings.append(
            f"{fit.violations} free points are more than {1000.0 * search.cost.tolerance:g} mm "
            "inside of the object: the guess, the log's frames or its depth may be off"
        )
    return warnings


def _about(
    config: AlignConfig, source: Source, found: TruePose, guess: FloatArray, fit: Fit
) -> dict[str, Any]:
    """What the pose file says beside the pose; metres."""
    return {
        "object": source.object,
        "cost": found.cost,
        "mean_distance": fit.mean_distance,
        "violations": fit.violations,
        "guess": guess.tolist(),
        "guess_cost": found.guess_cost,
        "search": settings_mapping(config.search),
        "seed": config.seed,
        "source": source.digest,
        "sdf": source.problems.problem(source.steps[-1]).sdf.digest,
    }


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
        pose = rr.Transform3D(translation=guess[:3, 3], mat3x3=guess[:3, :3])
        stream.log("scene/guess", display_mesh(mesh, _GUESS_COLOR), pose, static=True)
        scene.add_points(problem.points, new=False)


if __name__ == "__main__":
    main()
