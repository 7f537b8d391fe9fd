"""Makes stored replays: `python -m tests.tools.make_replays [NAME ...]`, of today's code.

Existing files stay as they are, as the bits that later code must give; to accept new bits, use
`python -m replay accept`. Needs PyBullet for simulated sessions.

`points_default_METHOD` has the settings of preset `default` without any change: when the preset
changes, it is made again. The others keep older settings, and some are cut to two registrations.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from chsel.problem.poses import apply, axis_angle, compose
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.settings import PRESETS
from runners.objects.loader import ObjectConfig, load_object
from tests.tools.small_recordings import steered_session, write_recording

FOLDER = Path(__file__).parents[1] / "replays"
MOST_BYTES = 2**20
STEERED = "box_steered"  # the one with decisions
_POINTS = "points.npz"
_BRIEF = ["recording=mcap", "recording.snapshot_interval=0"]
_SMALL = ["session.object_resolution=0.03", "session.free_resolution=0.05"]
_OF_POINTS = ["object.scale=1", "session=points", f"session.path={_POINTS}", *_BRIEF]
_FEW = [*_OF_POINTS, "session.object_resolution=0.015", "session.start_probe=2"]  # the last two
_QUICK = ["method.archive.bins=10", "method.emitter.iterations=30"]
_BY_CHSEL = ["method=chsel", *_QUICK]
_CHSEL = ("chsel", "chsel_cma_me")
_MEDIAL = ("medial_constraint", "medial_constraint_cma_me")
_BASELINES: dict[str, list[str]] = {  # with what keeps those brief that take long
    "icp": [],
    "svgd": [],
    "cvo": ["method.max_iterations=20"],
    "cvo_no_free_space": ["method.max_iterations=20"],
    "medial_constraint": ["method.cma_es.generations=60"],
    "medial_constraint_cma_me": ["method.cma_es.generations=40", *_QUICK],
    "anchored": ["method.size=small", "method.archive.bins=10"],
}
_OBJECTS = {  # with the preset of CHSEL, CHSEL with CMA-ME, gradient descent
    "drill": ("default", "paper", "reference"),
    "mustard": ("paper", "reference", "default"),
    "hammer": ("reference", "default", "paper"),
    "cracker_box": ("default", "paper", "default"),
    "spam_can": ("paper", "default", "reference"),
    "clamp": ("default", "reference", "paper"),
}
# Not stored, as the meshes and grids of these objects are large; two are.
_LARGE = {f"{name}_{method}" for name in ("drill", "hammer") for method in _BASELINES}
_OF_DEFAULTS = "spam_can"  # of which points_default_METHOD are, and few others
_LARGE |= {f"{_OF_DEFAULTS}_{method}" for method in _BASELINES}
_LARGE -= {"hammer_icp", "spam_can_icp"}
_FULL = ("chsel", "chsel_cma_me", "gradient_descent", "svgd", "cvo", "cvo_no_free_space")
_FULL += (*_MEDIAL, "anchored", "icp")  # not brief in any other


def cases() -> dict[str, list[str]]:
    """Arguments of `python -m runners.probe` by name; older files were made with other ones."""
    found = {}
    for name, presets in _OBJECTS.items():
        for method, preset in zip((*_CHSEL, "gradient_descent"), presets, strict=True):
            found[f"{name}_{method}"] = [
                f"object={name}",
                f"preset={preset}",
                f"method={method}",
                *_FEW,
                *(_QUICK if method in _CHSEL else []),
            ]
        for index, (method, brief) in enumerate(_BASELINES.items()):
            if f"{name}_{method}" in _LARGE:
                continue
            start = 10
            if method in _MEDIAL and name != "clamp":  # one step, for its size
                start = 15 if name == "mustard" else 11
            found[f"{name}_{method}"] = [
                f"object={name}",
                f"session={('kinematic', 'simulated')[index % 2]}",
                f"preset={PRESETS[(index + len(name)) % len(PRESETS)]}",
                f"method={method}",
                *_BRIEF,
                *_SMALL,
                f"session.start_probe={start}",
                *brief,
            ]
    for method in _FULL:
        found[f"points_default_{method}"] = [f"object={_OF_DEFAULTS}", f"method={method}", *_FEW]
    for method in (*_CHSEL, *_MEDIAL, "svgd", "cvo_no_free_space"):
        found[f"points_default_{method}"].append("session.start_probe=3")  # one step, for its size
    points = [*_OF_POINTS, "session.object_resolution=0.01"]
    plane = "method.plane={plane_height: 0.0}"
    return found | {
        STEERED: [],  # of `tests.tools.small_recordings`: those of commands are larger
        "points_mustard": ["object=mustard", *points, *_BY_CHSEL, "recording.snapshot_interval=10"],
        "points_two_passes": ["object=drill", *points, *_BY_CHSEL, "method.passes=2", "seed=3"],
        "points_on_a_table": [
            "object=spam_can", *points, *_BY_CHSEL, plane, "method.archive.measure=plane_position",
        ],
        "points_interior": [
            "object=hammer", *points, *_BY_CHSEL, "preset=reference",
            "method.cost.volume_normalise=true",
        ],
        "points_exact_descent": [
            "object=clamp", *points, "method=gradient_descent", "method.cost.gradient=exact",
            "method.cost.known_tolerance=0.002",
        ],
    }  # fmt: skip


def write_points(path: Path, name: str) -> None:
    """A file of points of every kind that become known in four steps, around a model at rest."""
    model = load_object(ObjectConfig(name, scale=1.0, epsilon=0.001, configuration="drill"), Path())
    random = np.random.default_rng(5)
    sdf = SdfGrid.from_mesh(model.mesh, 0.01)
    turned = axis_angle(np.array([[0.0, 0.0, 1.0]]), np.array([0.7]))
    world_from_object = compose(turned, np.array([[0.1, 0.05, 0.1]]))[0]
    lower, upper = model.mesh.bounds
    anywhere = random.uniform(lower - 0.08, upper + 0.08, (4000, 3))
    distance = np.asarray(sdf.at(anywhere)[0])
    chosen = {
        "surface": np.asarray(model.mesh.triangles_center)[:: len(model.mesh.faces) // 12][:12],
        "free": anywhere[distance > 0.01][:1200],
        "occupied": anywhere[distance < -0.004][:8],
        "known": anywhere[np.abs(distance) < 0.01][:8],
    }
    arrays = {kind: apply(world_from_object, points) for kind, points in chosen.items()}
    steps = {f"{kind}_step": np.arange(len(points)) % 4 for kind, points in arrays.items()}
    np.savez(
        path,
        **arrays,
        **steps,
        known_sdf=distance[np.abs(distance) < 0.01][:8],
        world_from_object=world_from_object,
    )


def make(name: str, arguments: list[str]) -> Path:
    """Run the session and keep its recording."""
    target = FOLDER / f"{name}.mcap"
    if name == STEERED:
        target.unlink(missing_ok=True)
        write_recording(target, steered_session())
        return target
    with tempfile.TemporaryDirectory() as folder:
        if "session=points" in arguments:
            write_points(Path(folder) / _POINTS, arguments[0].removeprefix("object="))
        command = [sys.executable, "-m", "runners.probe", "logs=.", *arguments]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=folder)
        (recording,) = Path(folder).rglob("recording.mcap")
        shutil.move(recording, target)
    return target


def main() -> None:
    """Make those named, or all that do not exist."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME")
    named = parser.parse_args().names
    for name, arguments in cases().items():
        if name in named or (not named and not (FOLDER / f"{name}.mcap").exists()):
            print(f"{name}: {make(name, arguments).stat().st_size} bytes", flush=True)


if __name__ == "__main__":
    main()
