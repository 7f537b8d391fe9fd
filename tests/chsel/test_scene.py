"""Several objects at once: whose each touch is, and where they are."""

import numpy as np
import pytest
import trimesh

import chsel
from chsel.errors import PointsError, SettingError
from chsel.problem.poses import axis_angle, compose
from replay.__main__ import main
from replay.mcap.reader import read_recording
from tests.chsel.samples import box_with_knob

Z = np.array([0.0, 0.0, 1.0])
WORKSPACE = chsel.Workspace((-0.4, -0.4, -0.1), (0.4, 0.4, 0.4))
MESHES = {
    "knob": box_with_knob(np.array([0.10, 0.06, 0.16]))[0],
    "long": box_with_knob(np.array([0.05, 0.16, 0.05]))[0],
}
TRUTHS = {
    "knob": compose(axis_angle(Z, np.array(0.4)), np.array([-0.12, 0.0, 0.08])),
    "long": compose(axis_angle(Z, np.array(-0.3)), np.array([0.05, 0.03, 0.025])),
}
NOWHERE = np.array([0.3, 0.3, 0.3])


def touches(count):
    """Contacts (N, 3) on the two in turn, and their names."""
    found = {
        name: trimesh.sample.sample_surface(
            MESHES[name].copy().apply_transform(TRUTHS[name]), count, seed=5
        )[0]
        for name in MESHES
    }
    places = np.stack(list(found.values()), axis=1).reshape(-1, 3)
    return places, list(MESHES) * count


def test_touches_are_given_to_their_objects_which_are_found(tmp_path):
    places, names = touches(10)
    with chsel.Scene(MESHES, workspace=WORKSPACE, record=tmp_path / "two.mcap") as scene:
        for n in range(0, 20, 4):
            scene.add(contacts=places[n : n + 4])
            scene.register()
        assert scene.owners == names
        assert scene.margin > 9.0
        scene.add(contacts=NOWHERE[None], free=[[0.3, -0.3, 0.3]])
        objects = scene.register()
        assert scene.owners == [*names, ""]
        for number, name in enumerate(MESHES):
            np.testing.assert_array_equal(objects[name].contacts, np.arange(number, 20, 2))
            off = np.abs(objects[name].answer.world_from_object - TRUTHS[name]).max(axis=(1, 2))
            assert off.min() < 0.003  # of several poses, where the knob was not touched
            best = objects[name].world_from_object
            assert (np.abs(objects[name].answer.world_from_object - best) < 1e-12).all((1, 2)).any()
            known = scene.sessions[name].points
            np.testing.assert_array_equal(np.sort(known.known, 0), np.sort(places[number::2], 0))
            assert len(known.free) == 1
    for name in MESHES:
        path = tmp_path / f"two_{name}.mcap"
        assert main(["verify", str(path)]) == 0
        last = read_recording(path)
        assert last.hypotheses(last.steps[-1]).digest == objects[name].answer.digest


def test_an_object_that_nothing_touched_has_no_answer():
    places, _ = touches(12)
    with chsel.Scene(MESHES, workspace=WORKSPACE) as scene:
        scene.add(contacts=places[::2])
        objects = scene.register()
        assert set(scene.owners) == {"knob"}
        assert objects["long"].answer is None
        assert objects["long"].world_from_object is None
        assert len(objects["long"].contacts) == 0


def test_few_touches_leave_open_whose_they_are():
    """Two on each of two objects fit both, and the margin says so."""
    places, _ = touches(2)
    with chsel.Scene(MESHES, workspace=WORKSPACE) as scene:
        scene.add(contacts=places)
        scene.register()
        assert scene.margin < 9.0


def test_the_next_touch_is_for_the_object_that_is_asked_about():
    finger = trimesh.creation.box(bounds=[[-0.01, -0.01, -0.06], [0.01, 0.01, 0.0]])
    places, _ = touches(8)
    with chsel.Scene(MESHES, workspace=WORKSPACE, hand=finger) as scene:
        scene.add(contacts=places[:14])
        scene.register()
        decided = scene.next_probe("knob").decision
        assert decided.digest == scene.sessions["knob"]._run.loop.state.decided.decision.digest
        with pytest.raises(SettingError, match="a probe was chosen before"):
            scene.next_probe("knob")
        assert scene.next_probe("long") is not None  # of which none was chosen before
        with pytest.raises(SettingError, match="name is 'other'; accepted: knob, long"):
            scene.next_probe("other")


def test_points_of_one_object_say_whose_touches_are():
    """Three touches fit either; where one object is known to be elsewhere, they are the other's."""
    places, _ = touches(12)
    with chsel.Scene(MESHES, workspace=WORKSPACE) as scene:
        scene.sessions["knob"].add(known=places[::2], known_sdf=np.zeros(12))
        scene.add(contacts=places[1:6:2])
        scene.register()
        assert set(scene.owners) == {"long"}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"occupied": [[0.0, 0.0, 0.0]]}, "occupied is of one object; accepted: scene.sessions"),
        ({}, "nothing was added"),
        ({"contacts": [[0.0, 0.0]]}, "contacts"),
        ({"contacts": [[0.0, 0.0, 0.0]], "free": [[np.nan, 0.0, 0.0]]}, "free"),
    ],
)
def test_what_cannot_be_added_is_added_to_none(given, message):
    with chsel.Scene(MESHES, workspace=WORKSPACE) as scene:
        scene.add(contacts=touches(3)[0])
        scene.register()
        before = {name: one.points.digest for name, one in scene.sessions.items()}
        with pytest.raises(PointsError, match=message):
            scene.add(**given)
        assert before == {name: one.points.digest for name, one in scene.sessions.items()}
        assert len(scene.owners) == 6


def test_a_contact_far_outside_is_a_warning_and_one_in_millimetres_an_error():
    with chsel.Scene(MESHES, workspace=WORKSPACE) as scene:
        with pytest.warns(chsel.PointsWarning, match="a contact is 0.1 m outside of the workspace"):
            scene.add(contacts=[[0.5, 0.0, 0.0]])
        with pytest.raises(PointsError, match="workspace"):
            scene.add(contacts=[[120.0, 40.0, 300.0]])
        assert len(scene.owners) == 1


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"targets": {"one": MESHES["knob"]}}, "accepted: two to four, of different names"),
        ({"targets": dict.fromkeys("abcde", MESHES["knob"])}, "5 targets; accepted: two to 4"),
        ({"moves": 0.01}, "moves is 0.01; accepted: 0"),
        ({"priors": {"other": None}}, "a name in priors is 'other'; accepted: knob, long"),
    ],
)
def test_scenes_that_cannot_be_are_one_line(given, message):
    with pytest.raises(SettingError, match=message):
        chsel.Scene(**{"targets": MESHES, "workspace": WORKSPACE, **given})
