"""Points that turn out not to be the object's, and are withdrawn."""

import numpy as np
import pytest
import trimesh

import chsel
from chsel.errors import PointsError
from replay.__main__ import main
from replay.mcap.reader import read_recording

BOX = trimesh.creation.box([0.10, 0.06, 0.16])
ON_BOX = np.array(
    [[0.05, 0.01, 0.02], [0.05, -0.02, -0.05], [0.01, 0.03, 0.0], [-0.02, 0.03, 0.06]]
)
NORMALS = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
ELSEWHERE = np.array([[0.2, 0.1, 0.0], [0.22, 0.1, 0.03]])


def test_what_is_withdrawn_counts_no_more_and_may_come_again(tmp_path):
    path = tmp_path / "touches.mcap"
    workspace = chsel.Workspace((-0.3, -0.3, -0.3), (0.4, 0.3, 0.3))
    with chsel.Session(BOX, workspace=workspace, record=path) as session:
        session.add(contacts=ON_BOX[:2], normals=NORMALS[:2], normal_noise=0.1)
        session.add(contacts=ELSEWHERE, free=[[0.3, 0.2, 0.2]])
        session.register()
        session.add(withdraw=[3, 2], contacts=ON_BOX[2:], normals=NORMALS[2:], normal_noise=0.2)
        found = session.register()
        points = session.points
        np.testing.assert_array_equal(points.known, ON_BOX)
        np.testing.assert_array_equal(points.normals, NORMALS)
        np.testing.assert_array_equal(points.normal_noise, [0.1, 0.1, 0.2, 0.2])
        assert len(points.free) == 1
        session.add(withdraw=[0])
        assert session.outcome == "points"
        session.add(contacts=ON_BOX[:1])  # at a place that is no longer measured
        assert {warning.code for warning in session.warnings} <= {"no_fit"}
        again = [*ON_BOX[1:], ON_BOX[0]]
        np.testing.assert_array_equal(session.points.known, again)
        last = session.register()
    recording = read_recording(path)
    np.testing.assert_array_equal(recording.problem(2).points.known, ON_BOX)
    assert recording.hypotheses(2).digest == found.digest
    with chsel.Session.resume(path, step=3) as resumed:
        resumed.add(contacts=ON_BOX[:1])
        assert resumed.register().digest == last.digest
    assert main(["verify", str(path)]) == 0
    assert main(["info", str(path)]) == 0


@pytest.mark.parametrize(
    ("withdraw", "moves", "message"),
    [
        ([2], 0.0, "withdraw has 2; accepted: numbers of session.points.known, below 2"),
        ([-1], 0.0, r"withdraw is \[-1\]; accepted: numbers of points, each once"),
        ([1, 1], 0.0, r"withdraw is \[1, 1\]; accepted: numbers of points, each once"),
        ([0.5], 0.0, r"withdraw is \[0.5\]; accepted: numbers of points, each once"),
        ([0], 0.01, "withdraw is given, and touches may move the object; accepted: moves=0"),
    ],
)
def test_other_numbers_are_refused_with_nothing_withdrawn(withdraw, moves, message):
    with chsel.Session(BOX, moves=moves) as session:
        session.add(contacts=ON_BOX[:2])
        with pytest.raises(PointsError, match=message):
            session.add(withdraw=withdraw)
        assert len(session.points.known) == 2
