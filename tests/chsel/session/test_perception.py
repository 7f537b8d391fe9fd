"""What a program says that its robot perceived: units, arrays, cameras, hands, repeated places."""

import ctypes
import warnings

import numpy as np
import pytest
import trimesh

import chsel
from chsel.problem.points import check_points
from chsel.problem.poses import apply, compose, inverse
from replay.mcap.reader import read_recording
from tests.chsel.samples import box_distance
from tests.chsel.session.test_session import (
    BOX,
    CAMERA,
    CONTACTS,
    HAND,
    LOOK,
    SIDES,
    TRUTH,
    ray_lengths,
    refused,
)

RAYS = CAMERA.directions().reshape(-1, 3) @ LOOK[:3, :3].T
ON_BOX = ray_lengths(LOOK[None, :3, 3], RAYS).reshape(60, 80)
MASK = np.isfinite(ON_BOX)
SEEN = {"mask": MASK, "camera": CAMERA, "world_from_camera": LOOK}
MATRIX = np.array([[90.0, 0.0, 39.5], [0.0, 90.0, 29.5], [0.0, 0.0, 1.0]])
AWAY = compose(np.eye(3), [400.0, 100.0, 100.0])
ROOM = chsel.Workspace((0.0, 0.0, 0.0), (0.3, 0.2, 0.2))


def depths(background):
    return np.where(MASK, ON_BOX, background)


def added(**what):
    """A session after one `add`."""
    session = chsel.Session(BOX)
    session.add(**what)
    return session


def codes(session):
    """The codes of its warnings, those of a registration included."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        session.register()
    return [warning.code for warning in session.warnings]


def test_points_of_an_image_have_normals_where_they_are_asked_for(tmp_path):
    """Those of the box's faces; none at corners of the mask, at edges none, or one between."""
    path = tmp_path / "look.mcap"
    with chsel.Session(BOX, record=path) as session:
        session.add(depth=depths(2.0), **SEEN, image_normal_noise=0.2)
    points = session.points
    bare = added(depth=depths(2.0), **SEEN).points
    np.testing.assert_array_equal(points.known, bare.known)
    assert not bare.has_normals
    places = np.abs(apply(inverse(TRUTH), points.known)) / (0.5 * SIDES)
    face = places.argmax(axis=1)
    given = points.normals.any(axis=1)
    local = points.normals @ TRUTH[:3, :3]
    signs = np.sign(apply(inverse(TRUTH), points.known))
    cosine = (local * signs)[np.arange(len(face)), face]
    inner = np.sort(places, axis=1)[:, 1] < 0.8
    assert inner.sum() > 20
    assert given[inner].mean() > 0.9
    np.testing.assert_allclose(cosine[inner & given], 1.0, atol=1e-9)
    assert cosine[given].min() > np.cos(0.3)
    np.testing.assert_array_equal(points.normal_noise, np.where(given, 0.2, 0.0))
    (probe,) = read_recording(path).probes
    assert probe.new_points.digest == points.digest
    image = {"depth": depths(2.0), **SEEN}
    without = {name: value for name, value in image.items() if name != "mask"}
    session = chsel.Session(BOX)
    for what, text in (
        (image | {"image_normal_noise": 12}, "image_normal_noise is 12; in degrees"),
        (image | {"image_normal_noise": 0.0}, "image_normal_noise is 0; accepted: above 0"),
        (image | {"image_normal_noise": [0.1, 0.2]}, "image_normal_noise has shape"),
        (without | {"image_normal_noise": 0.2}, "image_normal_noise has no mask"),
    ):
        refused(text, session.add, **what)


def test_many_adds_give_the_points_and_the_warnings_of_all_at_once():
    """In any order, with places that repeat; points that somebody holds never change."""
    stream = np.random.default_rng(0)
    cube = 0.01 * np.argwhere(np.ones((8, 8, 8)))  # free space around three of the contacts
    contacts = np.concatenate([CONTACTS - 0.03, cube[[150, 210, 290]] + 0.001])
    room = chsel.Workspace((0.0, 0.0, 0.0), (0.36, 0.3, 0.3))
    session = chsel.Session(BOX, workspace=room)
    order = stream.permutation(len(contacts))
    held = []
    for some, place in zip(
        np.array_split(stream.permutation(cube), len(order)), order, strict=True
    ):
        session.add(free=some, contact=contacts[place])
        session.add(free=some + 0.001, contacts=contacts[order[:3]])
        held.append((session.points, session.points.free.copy(), session.points.known.copy()))
    found = codes(session)
    for points, free, known in held:
        np.testing.assert_array_equal(points.free, free)
        np.testing.assert_array_equal(points.known, known)
    points = chsel.KnownPoints(free=session.points.free, known=contacts[order])
    assert session.points.digest == points.digest
    assert sorted(points.free.tolist()) == sorted(cube.tolist())
    points = chsel.KnownPoints(free=cube, known=contacts)
    expected = check_points(points, session.intake.diameter, free_resolution=0.01, workspace=room)
    assert [warning.code for warning in expected] == ["contacts_outside", "contacts_in_free_space"]
    texts = {warning.code: warning.text for warning in session.warnings}
    assert {warning.code: warning.text for warning in expected}.items() <= texts.items()
    assert found[0] == "repeated"


FARTHEST = float(np.finfo(np.float32).max)


@pytest.mark.parametrize("background", [100.0, 1000.0, 65504.0, 1e10, FARTHEST])
def test_a_far_background_is_free_up_to_the_end_of_the_workspace(tmp_path, background):
    """The same points as with a wall just outside, and the object recorded as finely."""
    path = tmp_path / "look.mcap"
    with chsel.Session(BOX, record=path) as session:
        session.add(depth=depths(background), **SEEN)
    wall = added(depth=depths(5.0), **SEEN)
    assert session.points.digest == wall.points.digest
    free = apply(inverse(TRUTH), session.points.free)
    assert (box_distance(free, SIDES) > 0.0).all()
    assert len(free) > 10_000
    (image,) = read_recording(path).sensor_images([0])
    assert image.unit == 1e-4
    recorded = image.values * image.unit
    assert np.abs(recorded - ON_BOX)[MASK].max() <= 0.5e-4 + 1e-12
    assert (recorded[~MASK] == 0.0).all()  # beyond: no points to draw
    assert image.mask[~MASK].mean() > 0.9  # whose rays count


def test_depths_in_a_large_workspace_are_recorded_up_to_its_end(tmp_path):
    path = tmp_path / "look.mcap"
    room = chsel.Workspace((-1.0, -1.0, -1.0), (9.0, 1.0, 1.0))
    with chsel.Session(BOX, record=path, workspace=room, free_resolution=0.05) as session:
        session.add(depth=depths(7.0), **SEEN)
    (image,) = read_recording(path).sensor_images([0])
    assert image.unit == 2e-4
    np.testing.assert_allclose(image.values[~MASK] * image.unit, 7.0, atol=1e-4)


def test_masked_depths_are_no_measurement():
    masked = np.ma.masked_array(depths(0.9), mask=~MASK)
    expected = added(depth=depths(0.0), **SEEN).points
    assert added(depth=masked, **SEEN).points.digest == expected.digest


def test_the_same_image_again_adds_no_point_on_the_object_and_a_touch_does():
    session = added(depth=depths(0.9), **SEEN)
    points = session.points
    for noise in (0.0, 0.0002):
        off = np.random.default_rng(0).normal(0.0, noise, MASK.shape) if noise else 0.0
        session.add(depth=depths(0.9) + off, **SEEN)
    assert len(session.points.contacts) <= 1.1 * len(points.contacts)
    session.add(contacts=points.contacts[:1] + 0.001)
    assert session.points.contacts[-1].tolist() == (points.contacts[0] + 0.001).tolist()


IMAGE = {"depth": np.ones((60, 80)), "camera": MATRIX, "world_from_camera": LOOK}
MIXED = np.where(np.arange(80) < 40, 15, 700) * np.ones((60, 1), dtype=np.uint16)
FORM = r"not a pinhole camera's matrix; accepted: \[\[fx, 0, cx\], \[0, fy, cy\], \[0, 0, 1\]\]"
REFUSED = (
    (IMAGE | {"camera": MATRIX.T}, FORM),
    (IMAGE | {"camera": MATRIX + np.array([[0, 9, 0], [0, 0, 0], [0, 0, 0]])}, FORM),
    (IMAGE | {"camera": 2.0 * MATRIX}, FORM),
    (IMAGE | {"camera": MATRIX[:2]}, r"camera has shape \(2, 3\)"),
    (IMAGE | {"camera": MATRIX * [[1e6], [1e6], [1]]}, "camera fx is 90000000.0; accepted: at mo"),
    (
        IMAGE | {"camera": MATRIX + np.array([[0, 0, 2e6], [0, 0, 0], [0, 0, 0]])},
        "cx, cy are 20000",
    ),
    (IMAGE | {"depth": MIXED}, "whole numbers up to 700: millimetres"),
    (IMAGE | {"mask": np.full((60, 80), np.nan)}, r"mask\[0\] is not finite"),
    (IMAGE | {"mask": np.arange(4800.0).reshape(60, 80)}, "mask has 4799 values other than 0"),
    (IMAGE | {"depth": np.where(MASK, 30.0, 1.0), "mask": MASK}, "mask shows is 30 m away"),
    (IMAGE | {"world_from_camera": compose(np.eye(3), [0, 0, 1e17])}, r"1e\+17; accepted: up to"),
    ({"contacts": [[1e17, 0, 0]]}, r"contacts\[0\] has 1e\+17; accepted: up to 100000 \(m\)"),
    ({"contacts": CONTACTS, "free": [[0, 1e8, 0]]}, r"free\[0\] has 1e\+08"),
    ({"contact": [0, 0, 1e8]}, r"contact\[2\] has 1e\+08"),
    ({"occupied": [[0, 0, 1e8]]}, r"occupied\[0\]"),
    ({"known": [[0, 0, 1e8]], "known_sdf": [0.0]}, r"known\[0\]"),
    ({"known": [[0, 0, 0]], "known_sdf": [1e8]}, r"known_sdf\[0\]"),
    ({"hand": HAND, "path": compose(np.eye(3), [0, 0, 1e8])[None]}, r"path\[0\] has 1e\+08"),
    ({"contacts": np.ma.masked_array(CONTACTS, CONTACTS > 0.45)}, "contacts has masked values"),
    ({"contacts": [np.ma.masked_array([1.0, 2, 3], [0, 1, 0])]}, "contacts has masked values"),
    ({"contacts": CONTACTS.astype(str)}, "contacts is not an array of numbers"),
    ({"contacts": CONTACTS.astype(str).astype(object)}, "contacts is not an array of numbers"),
    ({"contacts": CONTACTS + 0.1j}, "contacts is not an array of numbers"),
    ({"surface": CONTACTS}, "surface was renamed; accepted: contacts="),
    ({"hand": trimesh.Trimesh(), "path": TRUTH[None]}, "hand has no faces; accepted: a closed"),
    (
        {"hand": trimesh.Trimesh(HAND.vertices, HAND.faces[:1]), "path": TRUTH[None]},
        "hand has no inside; accepted: a closed mesh",
    ),
)


@pytest.mark.parametrize(("what", "text"), REFUSED, ids=[text[:30] for _, text in REFUSED])
def test_what_cannot_be_meant_is_one_line_and_the_session_goes_on(what, text):
    session = chsel.Session(BOX)
    for _ in range(2):  # before the first points, and after them
        refused(text, session.add, **what)
        session.add(contacts=CONTACTS)
    assert session.step == 1
    assert len(session.points.contacts) == len(CONTACTS)


def test_a_matrix_is_the_camera_and_a_swapped_centre_is_a_warning():
    wide = np.full((48, 64), 0.6)
    ahead = {"contacts": CONTACTS, "depth": wide, "world_from_camera": LOOK}
    for matrix, expected in (
        ([[90, 0, 31.0], [0, 90, 24.5], [0, 0, 1]], []),
        ([[90, 0, 26.0], [0, 90, 20.5], [0, 0, 1]], []),  # off the centre, either way round
        ([[90, 0, 24.5], [0, 90, 31.0], [0, 0, 1]], ["principal_point"]),
        ([[90, 0, 320.0], [0, 90, 240.0], [0, 0, 1]], ["principal_point"]),  # of a larger image
    ):
        session = added(camera=matrix, **ahead)
        assert [warning.code for warning in session.warnings] == expected
    by_matrix = added(depth=depths(0.9), **SEEN | {"camera": MATRIX}).points
    assert by_matrix.digest == added(depth=depths(0.9), **SEEN).points.digest


def test_poses_points_and_rooms_in_millimetres_are_a_warning():
    moved = compose(LOOK[:3, :3], 1000.0 * LOOK[:3, 3])
    assert codes(added(depth=depths(0.9), **SEEN | {"world_from_camera": moved})) == ["far_away"]
    session = added(contacts=CONTACTS)
    session.add(hand=HAND, path=AWAY[None])
    (warning,) = session.warnings
    assert warning.text.startswith("the hand's path is 423.4 m from the workspace and")
    session = added(contacts=1000.0 * CONTACTS[:1])
    assert [warning.code for warning in session.warnings] == ["far_away"]
    room = chsel.Workspace((-100.0, -200.0, -50.0), (700.0, 300.0, 300.0))
    session = chsel.Session(BOX, workspace=room, free_resolution=2.0)
    session.add(contacts=CONTACTS)
    assert [warning.code for warning in session.warnings] == ["wide_workspace"]
    wall = chsel.Session(BOX, workspace=chsel.Workspace((300, 0, 0), (301, 1, 1)))  # of a map
    wall.add(contacts=CONTACTS + np.array([300.0, 0.0, 0.0]))
    assert wall.warnings == []


def test_lengths_in_millimetres_are_refused():
    refused("noise is 0.5 m, and the object is 0.253 m", chsel.Session, BOX, noise=0.5)
    refused("moves is 5 m, and the object", chsel.Session, BOX, moves=5.0)
    refused("free_resolution is 1e-07", chsel.Session, BOX, free_resolution=1e-7)
    belief = added(contacts=CONTACTS)
    belief.register()
    refused("width is not above 0 and up to 2", belief.belief.grasp_chance, TRUTH[None], [40.0])
    refused("opening is 80", chsel.Gripper, opening=80.0)


def free_of(hand):
    """The voxels that a hand makes free where it stands."""
    session = chsel.Session(BOX, workspace=ROOM)
    session.add(hand=hand, path=compose(np.eye(3), [0.15, 0.1, 0.1])[None])
    return session.points.free.tolist()


def test_a_hand_whose_faces_look_inward_is_as_solid_as_another():
    hand = trimesh.creation.box((0.03, 0.03, 0.06))
    inward = hand.copy()
    inward.invert()
    assert free_of(inward) == free_of(hand) != []
    left, right = (hand.copy().apply_translation((x, 0.0, 0.0)) for x in (-0.05, 0.05))
    both = free_of(trimesh.util.concatenate([left, right]))
    right.invert()
    assert free_of(trimesh.util.concatenate([left, right])) == both
    assert len(both) == len(free_of(left)) + len(free_of(right))


def test_points_added_in_another_rounding_mode_are_refused():
    session = chsel.Session(BOX)
    library = ctypes.CDLL("libm.so.6")
    usual = library.fegetround()
    library.fesetround(0x800)  # upward, on x86-64
    try:
        refused("does not round to the nearest", session.add, contacts=CONTACTS)
    finally:
        library.fesetround(usual)
    session.add(contacts=CONTACTS)


def test_a_place_that_is_touched_again_counts_once():
    """A sensor that sends a held contact a hundred times, with a jitter of 0.2 mm."""
    jitter = np.random.default_rng(0).normal(0.0, 0.0002, (100, 3))
    session = added(contacts=CONTACTS[:14])
    first = session.points
    for off in jitter:
        session.add(contact=CONTACTS[3] + off, occupied=None)
    assert session.points.digest == first.digest
    assert [warning.code for warning in session.warnings] == ["repeated"]
    assert session.warnings[0].text.startswith("1 of 1 points are within 3 mm of an earlier one")
    assert session.step == 100
    at_once = added(contacts=np.concatenate([CONTACTS[:14], CONTACTS[3] + jitter]))
    assert at_once.points.digest == first.digest
    with pytest.warns(chsel.PointsWarning, match="100 of 114 points"):
        found = chsel.register(BOX, contacts=np.concatenate([CONTACTS[:14], CONTACTS[3] + jitter]))
    assert found.trust.redundancy == 8
    assert found.digest == chsel.register(BOX, contacts=CONTACTS[:14]).digest


def test_after_a_touch_that_moves_the_object_a_place_counts_again():
    start = compose(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]), [0.2, 0.1, 0.1])
    touch = {"hand": HAND, "path": start[None], "contact": CONTACTS[0]}
    for moves, count in ((0.0, 1), (0.015, 3)):
        session = chsel.Session(BOX, moves=moves)
        for _ in range(3):
            session.add(**touch)
        assert len(session.points.contacts) == count
