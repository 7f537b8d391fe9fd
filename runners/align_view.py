"""A Rerun file that shows how an object fits what is known, at a guess and where it was found."""

from __future__ import annotations

from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
import trimesh

from chsel.numerics.arrays import FloatArray
from chsel.problem.registration_problem import RegistrationProblem
from replay.rerun.blueprint import at_last_probe, scene_view
from replay.rerun.clock import PROBE
from replay.rerun.meshes import display_mesh
from replay.rerun.scene import Scene
from replay.rerun.stream import new_file_stream

APPLICATION = "chsel alignment"
_GUESS = (240, 140, 40, 60)


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
    with new_file_stream(path, APPLICATION) as stream:
        stream.set_time(PROBE, sequence=problem.key.step)
        view = scene_view(
            problem.workspace, name="The object where it was found; orange: the guess"
        )
        stream.send_blueprint(at_last_probe(rrb.Vertical(view)))
        scene = Scene(stream)
        scene.set_up(mesh, problem.workspace, found)
        pose = rr.Transform3D(translation=guess[:3, 3], mat3x3=guess[:3, :3])
        stream.log("scene/guess", display_mesh(mesh, _GUESS), pose, static=True)
        scene.add_points(problem.points, new=False)
