"""Which of several objects is touched: rows, refusals, and the next action."""

import numpy as np
import pytest
import trimesh

import chsel
from chsel.problem.poses import apply
from replay.comparing.verification import EQUAL, verify
from replay.mcap.reader import read_recording
from tests.chsel.methods.scene import BOX, BOX_SIDES, TRUTH, WORKSPACE, on_faces


def test_the_true_object_comes_first(tmp_path):
    slim = trimesh.creation.box(BOX_SIDES * [1.0, 0.5, 1.0])
    contacts = apply(TRUTH, on_faces(12))
    around = contacts.mean(axis=0) + np.random.default_rng(0).uniform(-0.3, 0.3, (400, 3))
    in_box = apply(np.linalg.inv(TRUTH), around)
    free = around[(np.abs(in_box) > 0.5 * BOX_SIDES + 0.02).any(axis=1)]
    meshes = {"slim": slim, "box": BOX}
    with chsel.WhichObject(meshes, record=tmp_path / "touches.mcap") as which:
        which.add(contacts=contacts, free=free)
        first, second = which.register()
    assert (first.name, second.name) == ("box", "slim")
    assert first.alive
    assert not second.alive
    # Four contacts are on the wide sides, which the slim box cannot reach, 30 mm off for two.
    assert second.energy - first.energy > 9.0
    verdicts = list(verify(read_recording(tmp_path / "touches_slim.mcap")))
    assert [verdict.outcome for verdict in verdicts] == [EQUAL]
    with pytest.raises(chsel.ChselError, match="accepted: two or more, of different names"):
        chsel.WhichObject(["a.obj", "other/a.obj"])
    (tmp_path / "again_box.mcap").touch()
    with pytest.raises(chsel.ChselError, match=r"again_box\.mcap"):
        chsel.WhichObject(meshes, record=tmp_path / "again.mcap", workspace=WORKSPACE)
    assert read_recording(tmp_path / "again_slim.mcap").ended.outcome.startswith("failed")


def test_what_one_object_cannot_have_is_added_to_none():
    """Contacts 21 m apart, which are never those of the smaller object: its diameter is 0.2 m."""
    small, large = BOX.copy(), BOX.copy().apply_scale(2.0)
    size = float(np.linalg.norm(small.extents))
    with chsel.WhichObject({"large": large, "small": small}, workspace=WORKSPACE) as which:
        which.add(contacts=apply(TRUTH, on_faces(12)))
        spread = np.array([[0.0, 0.0, 0.0], [110.0 * size, 0.0, 0.0]]).repeat(30, axis=0)
        jitter = np.random.default_rng(0).uniform(0.0, 0.2, spread.shape)
        with pytest.raises(chsel.ChselError, match="millimetres"):
            which.add(contacts=spread + jitter)
        counts = [len(session.points.known) for session in which.sessions.values()]
        assert counts == [12, 12]
        assert {session.step for session in which.sessions.values()} == {0}


def test_objects_of_other_sizes_are_compared_by_the_same_points():
    small, large = BOX.copy().apply_scale(0.2), BOX
    contacts = apply(TRUTH, on_faces(12))
    near = np.concatenate([contacts, contacts + np.array([0.0, 0.0, 0.0025])])
    with chsel.WhichObject({"large": large, "small": small}) as which:
        which.add(contacts=near)
        digests = {session.points.digest for session in which.sessions.values()}
    assert len(digests) == 1


def test_no_action_is_chosen_by_two_objects():
    meshes = {"slim": trimesh.creation.box(BOX_SIDES * [1.0, 0.5, 1.0]), "box": BOX}
    contacts = apply(TRUTH, on_faces(12))
    finger = trimesh.creation.cylinder(0.01, 0.1)
    with chsel.WhichObject(meshes, workspace=WORKSPACE, hand=finger) as which:
        which.add(contacts=contacts[:3])
        names = [one.name for one in which.register()]
        every, chosen = which.sessions["box"].actions(), which.next_probe().action
        one = chsel.Actions(every.world_from_hand[[chosen]], every.length[[chosen]])
        for contact, name, action in ((3, names[0], 0), (4, names[1], None)):
            which.add(contacts=contacts[contact : contact + 1])
            which.candidates = [one for one in which.register() if one.name == name]
            probe = which.next_probe(one)
            assert (None if probe is None else probe.action) == action
        assert which.sessions[names[1]].stop == "actions"
        with pytest.raises(chsel.ChselError, match=r"without is \[2\]; accepted: indices below 1"):
            which.sessions[names[0]].next_probe(one, without=[2])
