"""The command that makes plausible sets of a recording or of points."""

import os

import numpy as np
import pytest

from chsel.plausible.evaluation_cost import EvaluationCost
from chsel.plausible.plausible_set import load_plausible, plausible_set, read_plausible
from chsel.plausible.plausible_settings import plausible_settings
from chsel.problem.points import KnownPoints
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.settings import settings_mapping
from chsel.problem.streams import StreamKey
from replay.mcap.reader import read_recording
from runners import plausible
from runners.sensors.pose_file import beside, write_pose
from tests.chsel.plausible.scenes import WORKSPACE, ball
from tests.runners.box_session import POSE, recorded_box
from tests.runners.in_process import run

SMALL = (
    "definition.grid.rotations=200",
    "definition.grid.upright=4",
    "definition.grid.offsets.x=[[-0.01,0.01,3]]",
    "definition.grid.offsets.y=[[0,0,1]]",
    "definition.grid.offsets.z=[[0,0,1]]",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A box, points on it in two files, of which one says where it is, and a recording."""
    folder = tmp_path_factory.mktemp("plausible")
    recorded_box(folder, contacts=15).rename(folder / "recording.mcap")
    with np.load(folder / "box.npz") as points:
        arrays = {name: points[name] for name in points.files if name != "world_from_object"}
    np.savez(folder / "unknown.npz", **arrays)
    return folder


def rows(output):
    """The cells of the table's rows, as text."""
    lines = [line.split() for line in output.splitlines()]
    return [line for line in lines if line and line[0].isdigit()]


def test_a_recording_gets_its_sets_and_its_hypotheses_are_measured(folder):
    path = folder / "recording.mcap"
    done = run(plausible.main, str(path), *SMALL)
    assert (done.returncode, done.stderr) == (0, "")
    assert "epsilon 2 mm" in done.stdout
    assert [row[0] for row in rows(done.stdout)] == ["0", "1"]
    files = sorted((folder / "plausible").iterdir())
    assert len(files) == 2
    recording = read_recording(path)
    settings = read_plausible(files[0]).settings
    assert settings.epsilon == 0.002
    assert settings.grid.rotations == 200
    for step in recording.steps:
        problem = recording.problem(step)
        stored = load_plausible(
            folder / "plausible", problem, settings=settings, world_from_object=POSE
        )
        assert stored.digest == plausible_set(problem, POSE, settings=settings).digest
        assert stored.local.any()
        cells = rows(done.stdout)[step]
        assert float(cells[9]) == pytest.approx(float(cells[7]) + float(cells[8]), rel=0.01)
        assert float(cells[10]) == pytest.approx(float(cells[9]) ** 0.5, rel=0.01)
    before = [file.stat().st_mtime_ns for file in files]
    again = run(plausible.main, str(path), "1", *SMALL, "threads=2")
    assert [row[-1] for row in rows(again.stdout)] == ["found"]
    assert rows(again.stdout)[0][:-1] == rows(done.stdout)[1][:-1]
    assert [file.stat().st_mtime_ns for file in files] == before
    os.replace(files[0], files[1])
    refused = run(plausible.main, str(path), *SMALL)
    assert refused.returncode == 1
    assert "belongs to other points" in refused.stdout


def test_a_points_file_needs_its_object_and_the_true_pose_in_it_or_beside_it(folder):
    thing = ("object=mesh", f"object.path={folder / 'box.ply'}", f"out={folder / 'sets'}", *SMALL)
    done = run(plausible.main, str(folder / "box.npz"), "1", *thing, "definition=paper")
    assert (done.returncode, done.stderr) == (0, "")
    assert "definition paper" in done.stdout
    assert len(rows(done.stdout)) == 1
    (path,) = (folder / "sets").iterdir()
    assert read_plausible(path).settings.cost.combine == "sums"
    np.testing.assert_array_equal(read_plausible(path).truth, POSE)
    unknown = run(plausible.main, str(folder / "unknown.npz"), *thing)
    assert unknown.returncode == 2
    assert "has no true pose" in unknown.stderr
    assert "python -m runners.align" in unknown.stderr
    write_pose(beside(folder / "unknown.npz"), POSE, about={})  # as runners.align does
    found = run(plausible.main, str(folder / "unknown.npz"), *thing)
    assert (found.returncode, found.stderr) == (0, "")
    sets = [read_plausible(file) for file in (folder / "sets").iterdir() if file != path]
    assert len(sets) == 2
    for one in sets:
        np.testing.assert_allclose(one.truth, POSE, atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nothing.mcap"], "recording nothing.mcap"),
        ([], "file is missing"),
        (["{recording}", "7"], "there is no step 7; accepted: 0, 1"),
        (["{recording}", "definition.epsilon=-1"], "epsilon is -1.0"),
        (["{recording}", "metrics.quantile=2"], "quantile is 2.0"),
    ],
)
def test_a_mistake_is_one_line_on_stderr(folder, arguments, message):
    given = [word.format(recording=folder / "recording.mcap") for word in arguments]
    done = run(plausible.main, *given)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1


def definition(name, **changes):
    """A choice of the command, with its settings changed."""
    values = {**settings_mapping(plausible_settings(name, 1.0)), "epsilon": None}
    return {"name": name, **values, **changes}


@pytest.mark.parametrize(("name", "expected"), [("wide_sums", 0.02), ("wide_means", 0.005)])
def test_wide_definitions_add_up_contacts_or_take_their_mean(name, expected):
    """A ball that is 5 mm off four contacts on its sides."""
    contacts = 0.1 * np.array(
        [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
    )
    points = KnownPoints(known=1.05 * contacts)
    problem = RegistrationProblem(
        sdf=ball(0.1, 0.005),
        points=points,
        initial_set=np.eye(4)[None],
        workspace=WORKSPACE,
        free_resolution=0.03,
        key=StreamKey(0, 0),
    )
    settings = plausible_settings(name, 0.001)
    cost = EvaluationCost(problem, settings.cost).evaluate(np.eye(4)[None])[0]
    assert cost == pytest.approx(expected, rel=0.02)
    assert settings.fill_to == 300
    assert settings.cost.tolerance == 0.0
