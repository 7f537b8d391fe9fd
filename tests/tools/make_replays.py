"""Makes stored replays: `python -m tests.tools.make_replays [NAME ...]`, of today's code.

Existing files stay as they are, as the bits that later code must give; to accept new bits, use
`python -m replay accept`.

`points_default_METHOD` has the settings of preset `default` without any change: when the preset
changes, it is made again. Others, of sessions of all kinds, keep older settings.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from chsel.methods import OURS
from chsel.problem.poses import apply, axis_angle, compose
from chsel.problem.sdf_grid import SdfGrid
from runners.objects.loader import ObjectConfig, load_object
from tests.tools.small_recordings import steered_session, write_recording

FOLDER = Path(__file__).parents[1] / "replays"
STEERED = "box_steered"  # the one with decisions
_OF_POINTS = "object.scale=1 session=points session.path=points.npz recording=mcap"
_OF_POINTS += " recording.snapshot_interval=0 session.object_resolution"
_DEFAULT = f"object=spam_can {_OF_POINTS}=0.015 session.start_probe"
_BY_CHSEL = f"{_OF_POINTS}=0.01 method=chsel method.archive.bins=10 method.emitter.iterations=30"
_SMALL = ("gradient_descent", "cvo", "anchored", "icp")  # of others, two steps are too large


def cases():
    """Arguments of `python -m runners.probe` by name."""
    table = "method.plane={plane_height:0.0} method.archive.measure=plane_position"
    volume = "preset=reference method.cost.volume_normalise=true"
    exact = "method.cost.gradient=exact method.cost.known_tolerance=0.002"
    return {
        STEERED: "",  # by `tests.tools.small_recordings`: those of commands are larger
        **{
            f"points_default_{method}": f"{_DEFAULT}={2 if method in _SMALL else 3} method={method}"
            for method in OURS
        },
        "points_mustard": f"object=mustard {_BY_CHSEL} recording.snapshot_interval=10",
        "points_two_passes": f"object=drill {_BY_CHSEL} method.passes=2 seed=3",
        "points_on_a_table": f"object=spam_can {_BY_CHSEL} {table}",
        "points_interior": f"object=hammer {_BY_CHSEL} {volume}",
        "points_exact_descent": f"object=clamp {_OF_POINTS}=0.01 method=gradient_descent {exact}",
    }


def write_points(path, name):
    """A file of points of every kind that become known in four steps, around a model at rest."""
    model = load_object(ObjectConfig(name, scale=1.0, epsilon=0.001, configuration="drill"), Path())
    random = np.random.default_rng(5)
    turned = axis_angle(np.array([[0.0, 0.0, 1.0]]), np.array([0.7]))
    world_from_object = compose(turned, np.array([[0.1, 0.05, 0.1]]))[0]
    lower, upper = model.mesh.bounds
    anywhere = random.uniform(lower - 0.08, upper + 0.08, (4000, 3))
    distance = np.asarray(SdfGrid.from_mesh(model.mesh, 0.01).at(anywhere)[0])
    near = np.abs(distance) < 0.01
    chosen = {
        "surface": np.asarray(model.mesh.triangles_center)[:: len(model.mesh.faces) // 12][:12],
        "free": anywhere[distance > 0.01][:1200],
        "occupied": anywhere[distance < -0.004][:8],
        "known": anywhere[near][:8],
    }
    arrays = {kind: apply(world_from_object, points) for kind, points in chosen.items()}
    arrays |= {f"{kind}_step": np.arange(len(points)) % 4 for kind, points in chosen.items()}
    np.savez(path, **arrays, known_sdf=distance[near][:8], world_from_object=world_from_object)


def make(name, arguments):
    """Run the session and keep its recording."""
    target = FOLDER / f"{name}.mcap"
    if name == STEERED:
        target.unlink(missing_ok=True)
        write_recording(target, steered_session())
        return target
    with tempfile.TemporaryDirectory() as folder:
        write_points(Path(folder) / "points.npz", arguments[0].removeprefix("object="))
        command = [sys.executable, "-m", "runners.probe", "logs=.", *arguments]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=folder)
        (recording,) = Path(folder).rglob("recording.mcap")
        shutil.move(recording, target)
    return target


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="default: all that do not exist")
    named = parser.parse_args().names
    for name, arguments in cases().items():
        if name in named or (not named and not (FOLDER / f"{name}.mcap").exists()):
            print(f"{name}: {make(name, arguments.split()).stat().st_size} bytes", flush=True)
