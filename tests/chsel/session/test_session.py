"""Sessions of a robot's own program: what is added, registered, chosen, recorded and refused."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

import chsel
from chsel.methods.anchored.anchored import Anchored
from chsel.problem.poses import apply, axis_angle, compose, inverse
from replay.__main__ import main
from replay.comparing.verification import EQUAL, verify
from replay.mcap.reader import read_recording
from tests.chsel.samples import box_distance

SIDES = np.array([0.12, 0.08, 0.2])
BOX = trimesh.creation.box(SIDES)
TRUTH = compose(axis_angle(np.array([0.0, 0.0, 1.0]), 0.3), np.array([0.4, 0.1, 0.1]))
SAMPLED, FACES = trimesh.sample.sample_surface(BOX, 20, seed=0)
CONTACTS = apply(TRUTH, np.asarray(SAMPLED))
NORMALS = np.asarray(BOX.face_normals)[FACES] @ TRUTH[:3, :3].T
HAND = trimesh.creation.box((0.01, 0.01, 0.06))
CAMERA = chsel.PinholeCamera(80, 60, fx=90.0, fy=90.0, cx=39.5, cy=29.5)
LOOK = compose(np.array([[0.0, -0.6, 0.8], [-1.0, 0.0, 0.0], [0.0, -0.8, -0.6]]), [0.0, 0.1, 0.4])


def ray_lengths(origins, directions):
    """How far rays (N, 3) go until they meet the box at its true pose, by slabs; inf for a miss."""
    place = (origins - TRUTH[:3, 3]) @ TRUTH[:3, :3]
    along = directions @ TRUTH[:3, :3] + 1e-12
    ends = (np.array([[[-0.5]], [[0.5]]]) * SIDES - place) / along
    enters, leaves = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
    return np.where((enters > 0.0) & (enters < leaves), enters, np.inf)


def touched(session, probe):
    """Make a probe with HAND, and add where it meets the box."""
    start = probe.world_from_hand
    along = probe.world_from_hand[:3, 2]
    way = ray_lengths(start[None, :3, 3], along[None])[0] - 0.03  # of its front
    end = compose(start[:3, :3], start[:3, 3] + min(way, probe.length) * along)
    contact = end[:3, 3] + 0.03 * along if way < probe.length else None
    session.add(hand=HAND, path=[start, end], contact=contact)


def test_what_is_added_is_what_is_registered():
    session = chsel.Session(BOX, seed=3)
    session.add(contacts=CONTACTS[:5], contact=CONTACTS[5])
    first = session.register()
    given = {"workspace": session.started.workspace, "seed": 3}
    assert session.register() is first
    expected = chsel.register(BOX, contacts=CONTACTS[:6], **given)
    assert first.digest == expected.digest
    free = session.started.workspace.lower + 0.01 * np.array([[2, 3, 4], [2, 3, 5], [7, 0, 1]])
    others = {"occupied": TRUTH[None, :3, 3], "known": [[0.4, 0.1, 0.3]], "known_sdf": [0.1]}
    session.add(contacts=CONTACTS[6:], free=free + 0.004, **others)
    given |= {"contacts": CONTACTS, "free": free, "previous": expected, "step": 1}
    assert session.register().digest == chsel.register(BOX, **others, **given).digest


def test_normals_reach_the_problem_the_recording_and_its_reader(tmp_path):
    """A place that is measured again keeps its first normal; NORMALS[12:] are not known."""
    path = tmp_path / "touches.mcap"
    noise = np.linspace(0.1, 0.4, 5)
    with chsel.Session(BOX, record=path) as session:
        session.add(contacts=CONTACTS[:5], normals=1.001 * NORMALS[:5], normal_noise=noise)
        session.add(
            contacts=CONTACTS[3:8],
            normals=-NORMALS[3:8],
            contact=CONTACTS[8],
            normal=NORMALS[8],
            normal_noise=0.2,
        )
        session.add(contacts=CONTACTS[9:11], normals=NORMALS[9:11], contact=CONTACTS[11])
        session.register()
        session.add(contacts=CONTACTS[12:], normals=0.0 * NORMALS[12:])
        session.register()
        points = session.problem.points
    sign = np.ones((20, 1))
    sign[5:8] = -1.0
    sign[11:] = 0.0
    np.testing.assert_array_equal(points.known, CONTACTS)
    np.testing.assert_allclose(points.normals, sign * NORMALS, atol=1e-12)
    np.testing.assert_array_equal(
        points.normal_noise, [*noise, *[0.2] * 4, *[0.25] * 2, *[0.0] * 9]
    )
    recording = read_recording(path)
    assert recording.problem(3).points.digest == points.digest
    assert [verdict.outcome for verdict in verify(recording)] == [EQUAL] * 2
    shown = [probe.contact_normals for probe in recording.probes]
    np.testing.assert_array_equal(shown[1], [*-NORMALS[3:8], NORMALS[8]])
    np.testing.assert_array_equal(shown[2], [*NORMALS[9:11], np.zeros(3)])
    assert not shown[3].any()


def test_recordings_with_normals_and_a_prior_replay_to_the_bit_and_compare(tmp_path, capsys):
    path = tmp_path / "touches.mcap"
    prior = chsel.PosePrior(centre=TRUTH[:3, 3], centre_noise=0.02, point=np.zeros(3))
    with chsel.Session(BOX, record=path, prior=prior) as session:
        for part in (slice(0, 4), slice(4, 8)):
            session.add(contacts=CONTACTS[part], normals=NORMALS[part])
            found = session.register()
    recording = read_recording(path)
    assert [verdict.outcome for verdict in verify(recording)] == [EQUAL] * 2
    assert recording.hypotheses(1).digest == found.digest
    assert main(["step", str(path), "--step", "1", "-o", str(tmp_path / "step.mcap")]) == 0
    assert main(["compare", str(path), "--methods", "anchored", "icp"]) == 0
    out = capsys.readouterr().out
    assert "anchored has the recorded settings: its 2 results are those recorded, to the bit" in out
    problem = recording.problem(1)
    bare = replace(problem, points=problem.points.without_normals(), prior=None)
    alike = [chsel.build_method("icp").register(each).digest for each in (problem, bare)]
    assert alike[0] == alike[1]
    assert chsel.build_method("anchored").register(bare).digest != found.digest


def test_a_push_carries_points_and_keeps_their_normals():
    session = chsel.Session(BOX, moves=0.01)
    turned = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # z along x
    path = compose(np.stack([turned] * 2), np.array([[0.2, 0.1, 0.1], [0.3, 0.1, 0.1]]))
    session.add(contacts=CONTACTS[:4], normals=NORMALS[:4], normal_noise=0.1)
    session.add(hand=HAND, path=path, contact=[0.335, 0.1, 0.1], normal=[-1, 0, 0])
    session.register()
    points = session.problem.carried(0.01).points
    np.testing.assert_allclose(
        points.known[:4], CONTACTS[:4] + np.array([0.01, 0.0, 0.0]), atol=1e-12
    )
    np.testing.assert_allclose(points.normals, [*NORMALS[:4], [-1.0, 0.0, 0.0]], atol=1e-12)
    np.testing.assert_array_equal(points.normal_noise, [*[0.1] * 4, 0.25])


DEPTH = {"depth": np.ones((60, 80)), "camera": CAMERA, "world_from_camera": LOOK}
PATH = TRUTH[None]
NOISY = {"contacts": CONTACTS, "normals": NORMALS}
TOUCH = {"contact": CONTACTS[0]}
OPENING = (
    ({"record": "touches.bag"}, "accepted: a name.mcap or name.rrd"),
    ({"workspace": chsel.Workspace((0, 0, 0), (90, 90, 90))}, "smaller workspace"),
    ({"hand": "hand.stl"}, "hand is 'hand.stl'; accepted: a mesh"),
    ({"prior": "upright"}, r"prior is 'upright'; accepted: chsel\.PosePrior"),
)
MISTAKES = (
    ({}, "nothing was added"),
    ({"contacts": 1000.0 * CONTACTS}, "millimetres"),
    ({"contact": CONTACTS[:1]}, r"contact has shape \(1, 3\)"),
    ({"known": CONTACTS, "known_sdf": [0.0]}, "one per known point, 20"),
    ({"normals": NORMALS}, "normals have no contacts"),
    ({"contacts": CONTACTS, "normals": NORMALS[1:]}, "normals has 19 rows; accepted: one per"),
    ({"contacts": CONTACTS, "normals": 1.02 * NORMALS}, r"normals\[0\] is 1.02 long"),
    ({"contacts": CONTACTS, "normals": np.nan * NORMALS}, r"normals\[0\] is not finite"),
    ({"contacts": CONTACTS, "normal_noise": 0.1}, "normal_noise has no normals"),
    (NOISY | {"normal_noise": 15}, "normal_noise is 15; in degrees"),
    (NOISY | {"normal_noise": np.full(20, 15.0)}, "normal_noise is 15; in degrees"),
    (NOISY | {"normal_noise": 0.0}, "normal_noise is 0; accepted: above 0"),
    (NOISY | {"normal_noise": [0.1, 0.2]}, "normal_noise has 2 entries; accepted: one, or 20"),
    (NOISY | {"normal_noise": [0.1, [0.2]]}, "normal_noise is not an array of numbers"),
    (NOISY | {"normal": NORMALS[0]}, "normal has no contact"),
    (TOUCH | {"normal": NORMALS[:1]}, r"normal has shape \(1, 3\); accepted: \(3\)"),
    (TOUCH | {"normal": [0, 0, 2]}, r"normal\[0\] is 2 long"),
    (TOUCH | {"normal_noise": 0.1}, "normal_noise has no normals"),
    (TOUCH | {"normal": NORMALS[0], "normal_noise": [0.1]}, "is an array beside normal"),
    ({"path": PATH}, "hand and path belong together"),
    ({"hand": chsel.HandShape.of(HAND), "path": PATH}, "accepted: a mesh"),
    ({"hand": HAND, "path": 2.0 * PATH}, r"path\[0\] is not a rigid transform"),
    ({"depth": DEPTH["depth"]}, "depth, camera and world_from_camera belong together"),
    (DEPTH | {"depth": [[1.0], [1.0, 2.0]]}, "depth is not an array of numbers"),
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
    assert session.register().trust.verdict == "determined"
    session.close()
    for call in (session.register, session.next_probe, session.add):
        refused("the session is closed", call)


def test_what_was_added_is_in_the_file_when_add_returns_and_also_how_it_failed(tmp_path):
    path, copy, none = (tmp_path / f"{name}.mcap" for name in ("touches", "copy", "none"))
    session = chsel.Session(BOX, record=path)
    for n in range(2):
        session.add(contacts=CONTACTS[n : n + 1])
        shutil.copy(path, copy)
        probes = read_recording(copy, partial=True).probes
        assert [probe.contacts.tolist() for probe in probes] == CONTACTS[: n + 1, None].tolist()
    with pytest.raises(ValueError, match="arm"), session:
        raise ValueError("the arm stopped")
    assert read_recording(path).ended.outcome == "failed: ValueError: the arm stopped"
    chsel.Session(BOX, record=none).close()
    assert read_recording(none).probes == []


def test_touches_by_the_policy_are_verified_also_where_other_actions_are_offered(tmp_path):
    policy = chsel.build_policy("information", {"actions": {"most": 40}})
    bounds = chsel.Workspace((0.25, -0.05, 0.0), (0.55, 0.25, 0.25))
    chosen = []
    given = {"hand": HAND, "workspace": bounds, "record": tmp_path / "touches.mcap"}
    with chsel.Session(BOX, policy=policy, settings={"size": "small"}, **given) as session:
        whole = session.actions()
        half = chsel.Actions(whole.world_from_hand[::2], whole.length[::2])
        for actions in (None, None, half, half):
            chosen.append(session.next_probe(actions))
            touched(session, chosen[-1])
            session.register()
    assert len(whole) <= 40
    recording = read_recording(given["record"])
    for step, offered in zip((-1, 0, 1, 2), (whole, whole, half, half), strict=True):
        problem = recording.decision(step).problem
        assert problem.actions.digest == offered.digest
        before = [chosen[step].action] if step in (0, 2) else []  # of the same actions
        assert np.flatnonzero(~problem.available).tolist() == before
    assert [verdict.outcome for verdict in verify(recording)] == [EQUAL] * 8


def test_a_depth_image_and_two_touches_give_the_pose():
    rays = CAMERA.directions().reshape(-1, 3) @ LOOK[:3, :3].T
    eye = LOOK[:3, 3]
    box = ray_lengths(eye[None], rays)
    floor = np.where(rays[:, 2] < 0.0, -eye[2] / rays[:, 2], np.inf)
    depth = np.minimum(box, floor).reshape(60, 80)
    mask = np.isfinite(box).reshape(60, 80)
    session = chsel.Session(BOX)
    session.add(depth=depth, mask=mask, camera=CAMERA, world_from_camera=LOOK)
    points = session.points
    seen, free = (apply(inverse(TRUTH), each) for each in (points.contacts, points.free))
    assert np.sum(np.abs(box_distance(seen, SIDES)) < 1e-9) == len(seen) > 20
    assert np.sum(box_distance(free, SIDES) > 0.0) == len(free) > 500
    assert cKDTree(seen).query(free)[0].min() > 0.5 * 0.01 * 3.0**0.5  # half a voxel's diagonal
    for place in ([[0.06, 0.01, 0.05]], [[0.02, 0.04, -0.03]]):  # on sides that it does not see
        session.add(contacts=apply(TRUTH, np.array(place)))
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
    np.testing.assert_allclose(session.points.free, centres[passed], atol=1e-12)
    assert passed.sum() == 19 * 5 * 3


def test_a_failed_registration_is_an_error_and_the_next_one_goes_on(monkeypatch, tmp_path):
    with chsel.Session(BOX, record=tmp_path / "touches.mcap") as session:
        session.add(contacts=CONTACTS)
        monkeypatch.setattr(Anchored, "register", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            session.register()
        refused("ZeroDivisionError", session.register)
        monkeypatch.undo()
        session.add(contact=CONTACTS[0] + np.array([0.0, 0.0, 0.5]))
        with pytest.warns(chsel.PointsWarning) as caught:
            session.register()
    assert {warning.filename for warning in caught} == {__file__}
    verdicts = verify(read_recording(tmp_path / "touches.mcap"))
    assert [each.outcome for each in verdicts] == ["no result", EQUAL]


def test_a_session_records_its_prior_and_warns_where_points_contradict_it(tmp_path):
    path = tmp_path / "touches.mcap"
    prior = chsel.PosePrior(
        centre=TRUTH[:3, 3] + [0.0, 0.12, 0.0], centre_noise=0.01, point=[0.0, 0.0, 0.0]
    )
    with chsel.Session(BOX, prior=prior, record=path) as session:
        session.add(contacts=CONTACTS)
        with pytest.warns(chsel.PointsWarning, match="12.0 cm off it"):
            session.register()
        assert [warning.code for warning in session.warnings] == ["prior"]
        assert session.problem.prior is prior
    recording = read_recording(path)
    assert recording.start.prior.digest == prior.digest
    assert recording.problem(0).digest == session.problem.digest
    assert [verdict.outcome for verdict in verify(recording)] == [EQUAL]
