"""`replay accept`: today's results become the expected ones, if wanted; errors that are shown."""

import io
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from chsel.events import Believed, ListRecorder, Measured, ProblemPosed, RigDescribed, SensorImage
from chsel.plausible.symmetry import object_symmetry
from chsel.problem import initial_sets
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import axis_angle, compose, inverse
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from chsel.session.recording import register_recorded
from replay.__main__ import main
from replay.mcap.reader import read_recording
from replay.verbs.accept import best_pose_moves, write_accepted
from tests.replay.conftest import same_bits
from tests.tools.small_recordings import robot_session

REPLAYS = Path(__file__).resolve().parents[1] / "replays"


@pytest.fixture
def stored(tmp_path):
    return Path(shutil.copy(REPLAYS / "cracker_box_gradient_descent.mcap", tmp_path / "box.mcap"))


@pytest.fixture
def other_code(monkeypatch):
    """Code that draws the noise of E_0 otherwise."""
    drawn = initial_sets.normals
    monkeypatch.setattr(initial_sets, "normals", lambda stream, shape: -drawn(stream, shape))


def test_nothing_changes_where_all_bits_are_equal(stored, capsys):
    before = stored.read_bytes()
    assert main(["accept", str(stored), "--yes"]) == 0
    assert "all 4 results are as recorded, nothing to change" in capsys.readouterr().out
    assert stored.read_bytes() == before
    assert list(stored.parent.iterdir()) == [stored]


@pytest.mark.usefixtures("other_code")
def test_todays_results_are_those_that_verify_then_expects(stored, capsys):
    recorded = read_recording(stored)
    assert main(["verify", str(stored)]) == 1
    (report,) = re.findall(
        r"^step 9, .*\n.* making E_0 .*\n  E_0: .*\n", capsys.readouterr().out, re.M
    )
    assert main(["accept", str(stored), "--yes"]) == 0
    shown = capsys.readouterr().out
    assert report in shown  # the same differences, from the same comparison
    assert "3 of 4 results change" in shown  # the first E_0 has no noise
    assert main(["verify", str(stored)]) == 0
    accepted = read_recording(stored)
    assert accepted.steps == recorded.steps
    assert accepted.hypotheses(8).digest == recorded.hypotheses(8).digest
    assert accepted.hypotheses(9).digest != recorded.hypotheses(9).digest
    for step in accepted.steps:
        assert accepted.problem(step).points.digest == recorded.problem(step).points.digest
    assert not np.array_equal(accepted.problem(9).initial_set, recorded.problem(9).initial_set)
    assert list(stored.parent.iterdir()) == [stored]


@pytest.mark.usefixtures("other_code")
def test_a_recorded_belief_becomes_that_of_todays_result(stored, write, tmp_path):
    events = list(read_recording(stored).events())
    (place,) = [n for n, e in enumerate(events) if isinstance(e, Measured) and e.step == 9]
    shapes = (0,), (0, 4, 4), (0, 3), (0, 6, 6)
    stale = Believed(9, np.zeros(0, dtype=np.int64), *map(np.zeros, shapes), 0.5)
    path = write([*events[: place + 1], stale, *events[place + 1 :]])
    write_accepted(read_recording(path), tmp_path / "new.mcap")
    today = list(read_recording(tmp_path / "new.mcap").events())
    (believed,) = [event for event in today if isinstance(event, Believed)]
    measured = [event for event in today if isinstance(event, Measured) and event.step == 9]
    assert [believed.spread] == [event.values["set_spread"] for event in measured]
    assert measured[0].values["set_spread"] != events[place].values["set_spread"]


@pytest.mark.usefixtures("other_code")
@pytest.mark.parametrize(("answer", "status"), [("\n", 1), ("y\n", 0)])
def test_it_asks(stored, answer, status, monkeypatch):
    before = stored.read_bytes()
    terminal = io.StringIO(answer)
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stdin", terminal)
    assert main(["accept", str(stored)]) == status
    assert (stored.read_bytes() == before) is (status == 1)
    assert list(stored.parent.iterdir()) == [stored]


def test_where_nobody_can_answer_or_a_file_is_not_whole_nothing_is_done(
    stored, monkeypatch, capsys
):
    monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))
    assert main(["accept", str(stored)]) == 2
    assert capsys.readouterr().err == "error: nobody can be asked here; accepted: --yes\n"
    stored.write_bytes(stored.read_bytes()[:-9])
    before = stored.read_bytes()
    assert main(["accept", str(stored), "--yes"]) == 2
    assert stored.read_bytes() == before
    assert "is unfinished" in capsys.readouterr().err


def test_a_robots_session_is_verified_and_accepted_with_its_rig_and_images(write, tmp_path):
    path = write(robot_session("gradient_descent"))
    new = tmp_path / "new.mcap"
    assert main(["verify", str(path)]) == 0
    write_accepted(read_recording(path), new)
    found, before = (
        [e for e in read_recording(file).events() if isinstance(e, RigDescribed | SensorImage)]
        for file in (new, path)
    )
    assert len(found) == 5
    assert all(map(same_bits, found, before))


CENTRE = np.array([0.3, -0.2, 0.25])
TRUTH = compose(axis_angle(np.array([0.6, 0.0, 0.8]), np.array(0.8)), np.array([0.1, 0.0, -0.3]))
BOX = trimesh.creation.box((0.06, 0.1, 0.14)).apply_translation(CENTRE)


def turned(degrees, shift=0.0):
    """object_from_world of the true pose turned about the box's z axis, and shifted along it."""
    rotation = axis_angle(np.array([0.0, 0.0, 1.0]), np.deg2rad(degrees))
    return inverse(TRUTH @ compose(rotation, CENTRE - rotation @ CENTRE + [0.0, 0.0, shift]))


def found(*poses):
    count = len(poses)
    cost = np.arange(float(count))
    duplicate = np.zeros(count, dtype=bool)
    stacked = np.array(poses).reshape(-1, 4, 4)
    return Hypotheses(
        stacked, cost, duplicate=duplicate, cell=np.full(count, -1), elites=np.zeros((0, 4, 4))
    )


def test_recorded_errors_are_modulo_the_symmetries_of_the_object_at_its_centre():
    class Fixed:
        """A method that knows its result."""

        def register(self, *_):
            return found(turned(180.0, 0.03), turned(10.0))

    problem = RegistrationProblem(
        sdf=SdfGrid.from_mesh(BOX, 0.01, padding=0.03),
        points=KnownPoints(known=[[0.0, 0.0, 0.0]]),
        initial_set=turned(0.0)[None],
        workspace=Workspace((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)),
        free_resolution=0.01,
        key=StreamKey(0, 1),
    )
    recorder = ListRecorder()
    registered = register_recorded(
        ProblemPosed(1, problem),
        Fixed(),
        recorder=recorder,
        world_from_object=TRUTH,
        symmetry=object_symmetry(BOX),
    )
    (measured,) = (event for event in recorder.events if isinstance(event, Measured))
    assert measured.values == registered.numbers
    assert measured.values["best_position_error"] == pytest.approx(0.03, abs=1e-9)
    assert measured.values["best_rotation_error"] == pytest.approx(0.0, abs=1e-6)
    assert measured.values["closest_position_error"] == pytest.approx(0.0, abs=1e-9)
    assert measured.values["closest_rotation_error"] == pytest.approx(np.deg2rad(10.0), abs=1e-6)


def test_how_far_the_best_pose_moves():
    pair = (found(turned(180.0)), found(turned(20.0, 0.004)))
    symmetry = object_symmetry(BOX)
    moves = 0.004, pytest.approx(np.deg2rad(20.0), abs=1e-6)
    assert best_pose_moves(pair[0], pair[1], symmetry=symmetry) == (
        pytest.approx(moves[0], abs=1e-9),
        moves[1],
    )
    assert np.isnan(best_pose_moves(pair[0], found(), symmetry=symmetry)).all()
