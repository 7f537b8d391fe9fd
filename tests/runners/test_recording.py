"""Folders of runs, traces as they are handed over, and points of files and arrays."""

import numpy as np
import pytest
import trimesh

import chsel
from chsel.errors import RecordingError
from chsel.events import ListRecorder, Measured, Traced
from chsel.numerics.arrays import digest
from chsel.problem.poses import apply, axis_angle, compose
from chsel.session.recording import StepObserver
from replay.mcap.reader import read_recording
from runners.objects.loader import load_model
from runners.probe import main
from runners.run.recording import make_run_folder
from tests.runners.in_process import run


@pytest.mark.parametrize("name", ["ycb/drill", "../../x", "a\0b", "x" * 5000, "a b\n"])
def test_run_folders_differ_and_stay_in_the_log_folder(tmp_path, name):
    folders = {make_run_folder(tmp_path, name, "chsel") for _ in range(3)}
    assert len(folders) == 3
    assert {folder.parent for folder in folders} == {tmp_path}
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match=r"cannot be made .*; accepted: a writable logs=DIR"):
        make_run_folder(tmp_path / "file", "drill")


@pytest.mark.parametrize("count", [4, 5])
def test_a_trace_is_of_the_moment_at_which_it_was_handed_over(count):
    recorder = ListRecorder()
    random = np.random.default_rng(count)
    vectors = random.normal(size=(count, 9))
    cost = random.uniform(size=count)
    expected = digest(vectors, cost), cost.min(), np.median(cost), cost.max()
    StepObserver(recorder, 0, snapshot_interval=5, show=lambda *_: None).trace(
        "descent", 10, vectors, cost
    )
    vectors[:], cost[:] = 0.0, 0.0
    assert recorder.events == [
        Traced(
            0,
            "descent",
            iteration=10,
            digest=expected[0],
            lowest_cost=expected[1],
            median_cost=expected[2],
            highest_cost=expected[3],
        )
    ]


POSE = compose(axis_angle(np.array([0.6, 0.0, 0.8]), np.array(0.5)), np.array([0.1, 0.2, 0.3]))


@pytest.fixture(scope="module")
def mesh_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("mesh") / "mustard.ply"
    load_model("mustard").export(path)
    return path


def known(mesh):
    """Points of every class on, in and around a mesh at POSE."""
    surface = trimesh.sample.sample_surface(mesh, 24, seed=0)[0]
    around = np.random.default_rng(0).uniform(-0.2, 0.2, (2000, 3)) + mesh.bounds.mean(axis=0)
    height = chsel.SdfGrid.from_mesh(mesh, 0.01, padding=0.25).at(around, lookup="trilinear")[0]
    far = np.asarray(height > 0.02)
    inside = np.asarray(height < -0.02)
    points = {"surface": surface, "free": around[far], "occupied": around[inside][:5]}
    return {name: apply(POSE, group) for name, group in points.items()}


def by_argument(points):
    """Points of a file as `chsel.register` takes them."""
    return {"contacts" if name == "surface" else name: group for name, group in points.items()}


def recorded(folder, mesh_file, points, *overrides):
    """What the command records, with its default settings but for the folders."""
    np.savez(folder / "points.npz", **points)
    chosen = ["session=points", f"session.path={folder / 'points.npz'}", "object=mesh"]
    chosen += [f"object.path={mesh_file}", "recording=mcap", f"logs={folder / 'logs'}"]
    done = run(main, *chosen, *overrides)
    assert done.returncode == 0, done.stderr
    (path,) = (folder / "logs").rglob("recording.mcap")
    return read_recording(path)


@pytest.mark.parametrize("method", ["chsel", "anchored"])
def test_a_file_of_points_and_the_same_arrays(tmp_path, mesh_file, method):
    mesh = chsel.load_mesh(mesh_file)
    points = known(mesh)
    beside = {"known": points["surface"][:3] + 0.001, "known_sdf": np.array([0.0, 0.001, -0.001])}
    recording = recorded(tmp_path, mesh_file, {**points, **beside}, f"method={method}", "seed=3")
    target = trimesh.load_mesh(mesh_file, process=False) if method == "chsel" else mesh
    found = chsel.register(target, **by_argument(points), **beside, method=method, seed=3)
    assert found.digest == recording.hypotheses(0).digest
    (measured,) = (event for event in recording.events() if isinstance(event, Measured))
    assert measured.values.items() >= found.trust.numbers.items()


def test_a_sequence_in_the_workspace_of_all_its_points(tmp_path, mesh_file):
    mesh = chsel.load_mesh(mesh_file)
    points = known(mesh)
    steps = {f"{name}_step": np.arange(len(group)) % 2 for name, group in points.items()}
    recording = recorded(tmp_path, mesh_file, {**points, **steps}, "method=anchored")
    every = np.concatenate(list(points.values()))
    workspace = chsel.Workspace.around(every, recording.start.sdf.diameter)
    assert workspace == recording.start.workspace
    found = None
    for step in range(2):
        order = {name: np.argsort(steps[f"{name}_step"], kind="stable") for name in points}
        so_far = {
            name: group[order[name]][: np.sum(steps[f"{name}_step"] <= step)]
            for name, group in points.items()
        }
        found = chsel.register(
            mesh,
            **by_argument(so_far),
            method="anchored",
            workspace=workspace,
            previous=found,
            step=step,
        )
        assert found.digest == recording.hypotheses(step).digest
