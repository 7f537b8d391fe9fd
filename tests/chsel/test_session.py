"""Sessions of a robot's own program: what is added, registered, chosen, recorded and refused."""

import shutil

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

import chsel
from chsel.events import ListRecorder, ProblemPosed
from chsel.methods.anchored.anchored import Anchored
from chsel.problem.poses import apply, axis_angle, compose, inverse
from replay.comparing.verification import EQUAL, verify
from replay.mcap.reader import read_recording
from tests.chsel.samples import box_distance

SIDES = np.array([0.12, 0.08, 0.2])
BOX = trimesh.creation.box(SIDES)
TRUTH = compose(axis_angle(np.array([0.0, 0.0, 1.0]), 0.3), np.array([0.4, 0.1, 0.1]))
CONTACTS = apply(TRUTH, np.asarray(trimesh.sample.sample_surface(BOX, 20, seed=0)[0]))
HAND = trimesh.creation.box((0.01, 0.01, 0.06))
CAMERA = chsel.PinholeCamera(80, 60, 90.0, 90.0, 39.5, 29.5)
LOOK = compose(np.array([[0.0, -0.6, 0.8], [-1.0, 0.0, 0.0], [0.0, -0.8, -0.6]]), [0.0, 0.1, 0.4])


def ray_lengths(origins, directions):
    """How far rays (N, 3) go until they meet the box at its true pose, by slabs; inf for a miss."""
    place, along = (origins - TRUTH[:3, 3]) @ TRUTH[:3, :3], directions @ TRUTH[:3, :3]
    along = np.where(along == 0.0, 1e-12, along)
    ends = (np.array([[[-0.5]], [[0.5]]]) * SIDES - place) / along
    enters, leaves = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
    return np.where((enters > 0.0) & (enters < leaves), enters, np.inf)


def touched(session, probe):
    """Make a probe with HAND, and add where it meets the box."""
    start, along = probe.world_from_hand, probe.world_from_hand[:3, 2]
    front = start[:3, 3] + 0.03 * along
    way = ray_lengths(front[None], along[None])[0]
    end = compose(start[:3, :3], start[:3, 3] + min(way, probe.length) * along)
    contact = front + way * along if way < probe.length else None
    session.add(hand=HAND, path=[start, end], contact=contact)


def test_what_is_added_is_what_is_registered():
    """As single calls of `chsel.register` do, which take the same points as they are."""
    recorder = ListRecorder()
    with chsel.Session(BOX, seed=3, record=recorder) as session:
        session.add(contacts=CONTACTS[:5], contact=CONTACTS[5])
        first = session.register()
        assert session.register() is first is session.answer
        place = session.started.workspace
        free = np.array(place.lower) + 0.01 * np.array([[2, 3, 4], [2, 3, 5], [7, 0, 1]])
        others = {"occupied": TRUTH[:3, 3][None], "known": [[0.4, 0.1, 0.3]], "known_sdf": [0.1]}
        session.add(contacts=CONTACTS[6:], free=free + 0.004, **others)
        second = session.register()
    given = {"workspace": place, "seed": 3}
    one = chsel.register(BOX, surface=CONTACTS[:6], **given)
    assert first.digest == one.digest
    given |= {"surface": CONTACTS, "free": free, "previous": one, "step": 1}
    assert second.digest == chsel.register(BOX, **others, **given).digest
    assert sum(isinstance(event, ProblemPosed) for event in recorder.events) == 2


DEPTH = {"depth": np.ones((60, 80)), "camera": CAMERA, "world_from_camera": LOOK}
PATH = TRUTH[None]
OPENING = (
    ({"record": "touches.bag"}, "accepted: a name.mcap or name.rrd"),
    ({"workspace": [[0, 1]] * 3}, "workspace is"),
    ({"workspace": chsel.Workspace((0, 0, 0), (90, 90, 90))}, "smaller workspace"),
    ({"hand": "hand.stl"}, "hand is 'hand.stl'; accepted: a mesh"),
    ({"method": 5}, "accepted: chsel.build_method"),
    ({"seed": -1}, "seed is -1"),
)
MISTAKES = (
    ({}, "nothing was added"),
    ({"contacts": 1000.0 * CONTACTS}, "millimetres"),
    ({"contact": CONTACTS[:1]}, r"contact has shape \(1, 3\)"),
    ({"known": CONTACTS, "known_sdf": [0.0]}, "one per known point, 20"),
    ({"path": PATH}, "hand and path belong together"),
    ({"hand": chsel.HandShape.of(HAND), "path": PATH}, "accepted: a mesh"),
    ({"hand": HAND, "path": 2.0 * PATH}, r"path\[0\] is not a rigid transform"),
    ({"depth": DEPTH["depth"]}, "depth, camera and world_from_camera belong together"),
    (DEPTH | {"camera": np.eye(2)}, r"camera has shape \(2, 2\)"),
    (DEPTH | {"depth": [[1.0], [1.0, 2.0]]}, "depth is not an array of numbers"),
    (DEPTH | {"depth": np.full((60, 80), np.nan)}, "depth has no measurement"),
    (DEPTH | {"depth": np.full((60, 80), 700)}, "the nearest depth is 700 m: millimetres"),
    (DEPTH | {"mask": np.zeros((60, 80))}, "none of the 0 pixels of mask"),
)


def refused(text, call, *arguments, **named):
    with pytest.raises(chsel.ChselError, match=text) as caught:
        call(*arguments, **named)
    assert "\n" not in str(caught.value)


def test_a_mistake_is_one_line_and_leaves_the_session_as_it_was(tmp_path):
    path = tmp_path / "touches.mcap"
    for given, text in OPENING:
        refused(text, chsel.Session, BOX, **({"record": path} | given))
    session = chsel.Session(BOX, hand=HAND, record=path)
    refused("touches.mcap cannot be written: File exists", chsel.Session, BOX, record=path)
    refused("nothing is known yet", session.register)
    refused("workspace is missing", session.next_probe)
    refused("nothing says where the object can be", session.add, **DEPTH)
    for _ in range(2):  # before the first points, and after them
        for given, text in MISTAKES:
            refused(text, session.add, **given)
        session.add(contacts=CONTACTS)
    refused("actions is", session.next_probe, [1])
    assert session.next_probe() is not None
    refused("`add` its outcome first", session.next_probe)
    refused("`register` before `next_probe`", session.register)
    session.add(contacts=[])  # met nothing
    assert session.step == 2
    assert session.register().trust.verdict == "determined"
    session.close()
    for call in (session.register, session.next_probe, session.add):
        refused("the session is closed", call)
    assert read_recording(path).ended.outcome == "finished"


def test_what_was_added_is_in_the_file_when_add_returns_and_also_how_it_failed(tmp_path):
    path, copy = tmp_path / "touches.mcap", tmp_path / "copy.mcap"
    session = chsel.Session(BOX, record=path)
    for n in range(2):
        session.add(contacts=CONTACTS[n : n + 1])
        shutil.copy(path, copy)
        probes = read_recording(copy, partial=True).probes
        assert [probe.contacts.tolist() for probe in probes] == CONTACTS[: n + 1, None].tolist()
    with pytest.raises(ValueError, match="arm"), session:
        raise ValueError("the arm stopped")
    assert read_recording(path).ended.outcome == "failed: ValueError: the arm stopped"
    chsel.Session(BOX, record=tmp_path / "none.mcap").close()
    assert read_recording(tmp_path / "none.mcap").probes == []


def test_touches_by_the_policy_are_verified_also_where_other_actions_are_offered(tmp_path):
    path, never = tmp_path / "touches.mcap", {"spread": 0.0, "gain": 0.0}
    policy = chsel.build_policy("information", {"stop": never, "actions": {"most": 40}})
    bounds = chsel.Workspace((0.25, -0.05, 0.0), (0.55, 0.25, 0.25))
    given = {"workspace": bounds, "method": "anchored", "settings": {"size": "small"}}
    chosen = []
    with chsel.Session(BOX, policy=policy, hand=HAND, record=path, **given) as session:
        whole = session.actions()
        half = chsel.Actions(whole.world_from_hand[::2], whole.length[::2])
        for actions in (None, None, half, half):
            probe = session.next_probe(actions)
            chosen.append(probe.action)
            touched(session, probe)
            if len(session.online.points.contacts):
                session.register()
    assert len(whole) <= 40
    recording = read_recording(path)
    assert recording.decision_steps == (-1, 0, 1, 2)
    for step, offered in zip(recording.decision_steps, (whole, whole, half, half), strict=True):
        problem = recording.decision(step).problem
        assert problem.actions.digest == offered.digest
        before = chosen[step : step + 1] if step in (0, 2) else []  # none of others
        assert np.flatnonzero(~problem.available).tolist() == before
    verdicts = list(verify(recording))
    assert {verdict.outcome for verdict in verdicts} == {EQUAL}
    assert len(verdicts) == 4 + len(recording.steps) > 5


def test_a_depth_image_and_two_touches_give_the_pose():
    rays, eye = CAMERA.directions().reshape(-1, 3) @ LOOK[:3, :3].T, LOOK[:3, 3]
    box = ray_lengths(eye[None], rays)
    floor = np.where(rays[:, 2] < 0.0, -eye[2] / rays[:, 2], np.inf)
    depth, mask = np.minimum(box, floor).reshape(60, 80), np.isfinite(box).reshape(60, 80)
    session = chsel.Session(BOX)
    session.add(depth=depth, mask=mask, camera=CAMERA, world_from_camera=LOOK)
    known = session.online.points
    assert len(known.contacts) > 20
    assert np.abs(box_distance(apply(inverse(TRUTH), known.known), SIDES)).max() < 1e-9
    assert len(known.free) > 500
    assert box_distance(apply(inverse(TRUTH), known.free), SIDES).min() > 0.0
    for place in ([0.06, 0.01, 0.05], [0.02, 0.04, -0.03]):  # on the sides that it did not see
        session.add(contact=apply(TRUTH, np.array([place]))[0])
    found = inverse(session.register().object_from_world[0])
    corners, estimate = (apply(pose, np.asarray(BOX.vertices)) for pose in (TRUTH, found))
    assert cKDTree(corners).query(estimate)[0].max() < 0.003  # whichever way round


def test_a_hand_leaves_free_the_voxels_whose_centres_it_passed():
    """Voxels of 1 cm around multiples of it; the hand ends just before their faces."""
    hand = trimesh.creation.box((0.0298, 0.0498, 0.0698))
    session = chsel.Session(BOX, workspace=chsel.Workspace((0.0, 0.0, 0.0), (0.3, 0.2, 0.2)))
    across = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # its z axis is x
    places = np.linspace([0.08, 0.1, 0.09], [0.2, 0.1, 0.09], 121)
    session.add(hand=hand, path=compose(np.stack([across] * 2), places[[0, -1]]))
    centres = 0.01 * np.argwhere(np.ones((31, 21, 21)))
    away = np.abs((centres - places[:, None]) @ across)  # in the hand's frame
    passed = (away < 0.5 * hand.extents).all(axis=2).any(axis=0)
    np.testing.assert_allclose(session.online.points.free, centres[passed], atol=1e-12)
    assert passed.sum() == 19 * 5 * 3


def test_a_failed_registration_is_said_and_the_next_one_goes_on(monkeypatch, tmp_path):
    def fail(*_):
        raise chsel.ChselError("no pose")

    with chsel.Session(BOX, record=tmp_path / "touches.mcap") as session:
        session.add(contacts=CONTACTS)
        with monkeypatch.context() as patch:
            patch.setattr(Anchored, "register", fail)
            refused("no pose", session.register)
        refused("no pose", session.register)
        session.add(contact=CONTACTS[0] + np.array([0.0, 0.0, 0.5]))
        with pytest.warns(chsel.PointsWarning) as caught:
            session.register()
        assert {warning.filename for warning in caught} == {__file__}
        assert [each.code for each in session.warnings] == [w.message.code for w in caught]
    verdicts = verify(read_recording(tmp_path / "touches.mcap"))
    assert [each.outcome for each in verdicts] == ["no result", EQUAL]
