"""Input that is hardly meant: said on the terminal, in the log, and in the summary."""

import json

import numpy as np
import trimesh

from chsel.events import Logged
from chsel.problem.poses import apply, inverse
from chsel.problem.sdf_grid import mesh_sdf
from replay.mcap.reader import read_recording
from runners.probe import main
from tests.runners.box_session import BOX, POSE
from tests.runners.in_process import run

SURFACE = apply(POSE, trimesh.sample.sample_surface(BOX, 30, seed=0)[0])
STEPS = np.arange(30) // 10
FREE = np.random.default_rng(0).uniform(-0.3, 0.3, (3000, 3)) + POSE[:3, 3]
FREE = FREE[mesh_sdf(BOX, apply(inverse(POSE), FREE))[0] > 0.0]
QUICK = (
    "method=chsel",
    "method.descent.restarts=2",
    "method.descent.iterations=50",
    "method.emitter.iterations=10",
)


def probe(folder, *overrides, points, mesh=BOX):
    """A session of points: the command, its summary's warnings, and those of its recording."""
    np.savez(folder / "points.npz", **points)
    mesh.export(folder / "box.ply")
    chosen = ["session=points", f"session.path={folder / 'points.npz'}", f"logs={folder / 'logs'}"]
    if not any(override.startswith("object=") for override in overrides):
        chosen += ["object=mesh", f"object.path={folder / 'box.ply'}"]
    quick = () if any(override.startswith("method=") for override in overrides) else QUICK
    done = run(main, *chosen, *quick, "recording=mcap", *overrides, columns=1000)
    if done.returncode:
        return done, [], []
    (made,) = (folder / "logs" / "probe").iterdir()
    told = json.loads((made / "summary.json").read_text())["warnings"]
    events = read_recording(made / "recording.mcap").events(images=False)
    logged = [e for e in events if isinstance(e, Logged) and e.level == "warning"]
    return done, told, [(event.step, event.text) for event in logged]


def said(done):
    """The warnings on the terminal."""
    lines = (done.stdout + done.stderr).splitlines()
    return [line.removeprefix("warning: ") for line in lines if line.startswith("warning: ")]


def sequence(surface=SURFACE, free=FREE):
    return {"surface": surface, "surface_step": STEPS, "free": free}


def test_a_warning_is_given_once_with_the_step_at_which_it_first_holds(tmp_path):
    surface = SURFACE.copy()
    surface[[15, 25]] = [[5.0, 0.0, 0.0], [0.0, 5.0, 0.0]]  # of the second and third probe
    done, told, logged = probe(tmp_path, points=sequence(surface))
    assert [(each["step"], each["code"]) for each in told] == [
        (1, "contacts_apart"),
        (1, "contacts_far_from_free"),
    ]
    texts = [each["text"] for each in told]
    assert said(done) == texts
    assert logged == [(1, text) for text in texts]
    probes = [line for line in done.stdout.splitlines() if line.startswith(("probe  ", "warning"))]
    words = [line.split()[0] for line in probes[:5]]
    assert words == ["probe", "probe", "warning:", "warning:", "probe"]


def test_free_points_alone_are_a_warning_at_the_end(tmp_path):
    steps = np.arange(len(FREE)) % 3
    done, told, logged = probe(tmp_path, points={"free": FREE, "free_step": steps})
    assert [(each["step"], each["code"]) for each in told] == [(2, "no_contact")]
    assert "all known points are free" in said(done)[0]
    assert logged == [(2, told[0]["text"])]


def test_points_outside_of_a_given_workspace_are_a_warning_even_unregistered(tmp_path):
    workspace = "session.workspace=[[0.13,0.5],[0,0.5],[0,0.5]]"
    never = "session.start_contacts=100"
    done, told, _ = probe(tmp_path, workspace, never, points=sequence())
    assert [(each["step"], each["code"]) for each in told] == [(2, "contacts_outside")]
    assert "outside of the workspace [[0.13, 0.5], [0, 0.5], [0, 0.5]]" in said(done)[0]


def test_points_in_millimetres_are_an_error_before_anything_is_written(tmp_path):
    done, _, _ = probe(tmp_path, points=sequence(1000.0 * SURFACE, 1000.0 * FREE))
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: point file {tmp_path / 'points.npz'}: points on the obj")
    assert "are they in millimetres? accepted: points in metres" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "logs").exists()


def test_warnings_about_the_object_come_first_and_are_recorded_too(tmp_path):
    two = trimesh.util.concatenate([BOX, BOX.copy().apply_translation((0.0, 1.0, 0.0))])
    points = sequence(SURFACE, FREE[:0])
    done, told, logged = probe(tmp_path, "object.scale=1.5", points=points, mesh=two)
    assert [(each["step"], each["code"]) for each in told[:2]] == [
        (0, "bodies_apart"),
        (0, "object_size"),
    ]
    assert [text for _, text in logged] == said(done) == [each["text"] for each in told]
    assert done.stdout.index("warning: ") < done.stdout.index("probe   0")
