"""Objects that move along each push: contacts, errors and recorded problems."""

import numpy as np
import pytest

from chsel.events import Measured, Probe
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import object_symmetry
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.points import KnownPoints
from chsel.problem.poses import apply, inverse, rotation_angle
from chsel.problem.sdf_grid import mesh_sdf
from replay.comparing.verification import EQUAL, verify
from replay.mcap.reader import read_recording
from runners import evaluate, probe
from runners.sessions.placement import centre_of_mass
from runners.sessions.recorded import RecordedSettings, RecordedSource
from tests.runners.in_process import run

MOVES = 0.01  # m
SESSION = ("object=mustard", "session=kinematic", f"session.moves={MOVES}")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A mustard bottle, pushed along x by every probe that touches it."""
    logs = tmp_path_factory.mktemp("moving")
    method = ("method=anchored", "method.size=small", "recording=mcap")
    done = run(probe.main, *SESSION, *method, "session.expect_moves=0.02", f"logs={logs}")
    assert done.returncode == 0, done.stderr
    (folder,) = (logs / "probe").iterdir()
    return read_recording(folder / "recording.mcap")


def test_contacts_are_where_the_object_is_and_then_it_moves_along_the_push(recording):
    mesh, pose = recording.start.mesh, recording.start.world_from_object
    centre = centre_of_mass(mesh)[None]
    turns = []
    for each in recording.probes:
        assert (
            np.abs(mesh_sdf(mesh, apply(inverse(pose), each.contacts))[0]).max(initial=0.0) < 1e-5
        )
        assert (each.world_from_object is None) == (each.outcome == "free")
        if each.world_from_object is not None:
            way = apply(each.world_from_object, centre)[0] - apply(pose, centre)[0]
            np.testing.assert_allclose(way, [MOVES, 0.0, 0.0], atol=1e-9)
            turn = each.world_from_object[:3, :3] @ pose[:3, :3].T
            np.testing.assert_allclose(turn[2], [0.0, 0.0, 1.0], atol=1e-12)
            turns.append(rotation_angle(turn))
            pose = each.world_from_object
        np.testing.assert_array_equal(recording.start_at(each.step).world_from_object, pose)
    assert len(turns) >= 5
    assert 0.0 < min(turns) < max(turns) < 0.1


def test_errors_are_those_to_the_pose_at_their_step(recording):
    symmetry = object_symmetry(recording.start.mesh)
    measured = [event for event in recording.events() if isinstance(event, Measured)]
    for event in measured:
        found = recording.hypotheses(event.step).object_from_world[:1]
        truth = recording.start_at(event.step).world_from_object
        errors = pose_errors(found, truth, symmetry=symmetry)
        assert event.values["best_position_error"] == pytest.approx(errors[0][0], abs=1e-12)
    assert len(measured) >= 3


def test_recorded_problems_with_pushes_give_the_recorded_bits(recording):
    last = recording.problem(recording.steps[-1])
    assert last.pushes.largest == 0.02
    assert len(last.pushes.directions) == sum(p.outcome == "contact" for p in recording.probes)
    np.testing.assert_array_equal(
        last.pushes.directions, [[1.0, 0.0, 0.0]] * len(last.pushes.before)
    )
    verdicts = list(verify(recording))
    assert {verdict.outcome for verdict in verdicts} == {EQUAL}
    session = RecordedSource(RecordedSettings(str(recording.path)))
    loop = session.loop(OnlineSettings(), seed=recording.seed)
    assert [problem.pushes.digest for problem in loop.problems(session.probes())] == [
        recording.problem(step).pushes.digest for step in recording.steps
    ]
    np.testing.assert_array_equal(
        session.world_from_object, recording.start_at(recording.steps[-1]).world_from_object
    )


@pytest.mark.parametrize(
    ("way", "outcome", "push"),
    [
        ([0.48, 0.64, -0.6], "contact", [0.6, 0.8, 0.0]),
        ([0.48, 0.64, -0.6], "free", None),
        ([0.0, 0.0, -1.0], "contact", None),
    ],
)
def test_a_push_is_horizontal_along_the_z_axis_of_a_hand_that_touches(way, outcome, push):
    path = np.eye(4)[None].repeat(2, axis=0)
    path[1, :3, 2] = way  # the other axes do not matter
    found = Probe(0, outcome, new_points=KnownPoints(), gripper_path=path).push
    assert (found is None) == (push is None)
    if push is not None:
        np.testing.assert_allclose(found, push)


def test_there_are_no_plausible_sets_of_an_object_that_moves(tmp_path):
    done = run(evaluate.main, "session=kinematic", "session.moves=0.01", f"out={tmp_path}")
    assert done.returncode != 0
    assert "accepted: plausible=false" in done.stderr
