"""Declared symmetries: groups that are known, verdicts, modes and poses that go by them."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import trimesh

import chsel
from chsel.errors import PoseError, SettingError
from chsel.plausible.pose_metrics import pose_errors
from chsel.problem.object_symmetry import ObjectSymmetry, symmetry_from_settings
from chsel.problem.pose_distances import distances_apart, with_symmetry
from chsel.problem.poses import (
    Poses,
    apply,
    axis_angle,
    compose,
    inverse,
    random_rotations,
    rotation_angle,
    rotation_vector,
)
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.surface import outline_distances
from tests.chsel.samples import box_with_knob

X, Y, Z = np.eye(3)
NONE = ObjectSymmetry()
SIDES = np.array([0.10, 0.06, 0.16])
TRUTH = compose(rotation_vector(np.array([0.3, -0.8, 0.5])), np.array([0.3, 0.1, 0.2]))
PLACE = np.array([0.02, -0.03, 0.05])


def about(axis, degrees, place=(0.0, 0.0, 0.0)):
    """A turn (4, 4) of the object's frame about an axis through a place."""
    turn = axis_angle(np.asarray(axis, float), np.array(math.radians(degrees)))
    return compose(turn, place - turn @ np.asarray(place, float))


def on(mesh, count=60, seed=0):
    """Points (N, 3) all over a mesh at TRUTH."""
    return apply(TRUTH, np.asarray(trimesh.sample.sample_surface(mesh, count, seed=seed)[0]))


def rotations(seed, count):
    return random_rotations(StreamKey(seed, 0).stream(Purpose.MESH_SAMPLES), count)


def test_turns_generate_their_group_about_the_place_that_all_leave():
    found = ObjectSymmetry.declared(turns=[about(Z, 90.0, PLACE), about(X, 180.0, PLACE)])
    assert len(found.rotations) == 8
    assert found.axis is None
    np.testing.assert_allclose(found.centre, PLACE, atol=1e-12)
    quarters = [about(Z, 90.0 * n)[:3, :3] for n in range(4)]
    expected = np.array([*quarters, *(turn @ about(X, 180.0)[:3, :3] for turn in quarters)])
    apart = np.abs(found.rotations[:, None] - expected).max(axis=(2, 3))
    assert (apart.min(axis=0) < 1e-9).all()


def test_the_centre_of_a_turn_is_the_place_on_its_axis_that_is_nearest_to_the_object():
    found = ObjectSymmetry.declared(turns=[about(Z, 180.0, PLACE)])
    np.testing.assert_allclose(found.about(np.array([1.0, 2.0, 3.0])).centre, [0.02, -0.03, 3.0])
    can = ObjectSymmetry.declared(axes=[[[0.0, 0.0, 5.0], PLACE]])
    np.testing.assert_allclose(can.about(np.array([1.0, 2.0, 3.0])).centre, [0.02, -0.03, 3.0])
    np.testing.assert_allclose(can.axis, Z)
    assert NONE.about(PLACE).centre.tolist() == PLACE.tolist()
    both = ObjectSymmetry.declared(
        turns=[about(X, 180.0, PLACE), about(Z, 40.0, PLACE)], axes=[[Z, PLACE]]
    )
    assert len(both.rotations) == 2  # turns about the axis are among its own
    np.testing.assert_allclose(both.about(np.ones(3)).centre, PLACE, atol=1e-12)
    ball = ObjectSymmetry.declared(axes=[[Z, PLACE], [X, PLACE]])
    assert ball.sphere
    np.testing.assert_allclose(ball.centre, PLACE, atol=1e-12)


@pytest.mark.parametrize(
    ("declared", "error", "text"),
    [
        ({"turns": [about(Z, 180.0), about(Y, 180.0, PLACE)]}, SettingError, "no common centre"),
        ({"turns": [compose(np.eye(3), PLACE)]}, SettingError, "no common centre, by 50 mm"),
        ({"turns": [about(Z, 3.0)]}, SettingError, "no group of at most 60"),
        ({"turns": [about(Z, 36.5)]}, SettingError, "no group of at most 60"),
        ({"turns": [about(X, 40.0)], "axes": [[Z, Y]]}, SettingError, "no common centre"),
        ({"turns": [about(X, 40.0)], "axes": [[Z, 0 * X]]}, SettingError, "another direction"),
        ({"axes": [[0 * Z, X]]}, SettingError, "direction of length 0"),
        ({"turns": np.eye(3)[None]}, SettingError, "turns has shape"),
        ({"turns": [np.diag([2.0, 1.0, 1.0, 1.0])]}, PoseError, "turns"),
    ],
)
def test_what_is_no_symmetry_is_one_line(declared, error, text):
    with pytest.raises(error, match=text):
        ObjectSymmetry.declared(**declared)


@pytest.mark.parametrize(
    "symmetry",
    [
        ObjectSymmetry.declared(turns=[about(Z, 120.0, PLACE), about(X, 180.0, PLACE)]),
        ObjectSymmetry.declared(axes=[[X + Z, PLACE]]),
        ObjectSymmetry.declared(turns=[about(X, 180.0, PLACE)], axes=[[Z, PLACE]]),
    ],
)
def test_the_nearest_copy_is_that_of_the_smallest_turn(symmetry):
    """Beside 3600 turns about the axis times all rotations."""
    own = Poses.of(inverse(TRUTH)[None])
    others = Poses.of(compose(rotations(1, 20), rotations(2, 20)[:, 0]))
    copies = symmetry.nearest_copies(others, own)
    places = apply(copies.world_from_object, symmetry.centre[None])
    there = apply(others.world_from_object, symmetry.centre[None])
    np.testing.assert_allclose(places, there, atol=1e-12)
    steps = np.zeros(1) if symmetry.axis is None else np.arange(3600.0) * (math.pi / 1800.0)
    axis = Z if symmetry.axis is None else symmetry.axis
    group = symmetry.rotations[:, None] @ axis_angle(np.tile(axis, (len(steps), 1)), steps)
    turns = others.world_from_object[:, None, :3, :3] @ group.reshape(-1, 3, 3)
    least = rotation_angle(TRUTH[:3, :3].T @ turns).min(axis=1)
    found = rotation_angle(TRUTH[:3, :3].T @ copies.world_from_object[:, :3, :3])
    assert (found <= least + 1e-9).all()
    assert (found >= least - 0.001).all()
    looks = symmetry.rotation_errors(
        others.rotations @ np.swapaxes(copies.rotations, 1, 2)  # they look alike
    )
    np.testing.assert_allclose(looks, 0.0, atol=1e-6)


def test_a_box_that_is_painted_has_as_many_modes_as_its_surface_has_turns():
    mesh = trimesh.creation.box(SIDES)
    contacts = on(mesh)
    half = ObjectSymmetry.declared(turns=[about(Z, 180.0)])
    found = [
        chsel.register(mesh, contacts=contacts, symmetry=symmetry).trust
        for symmetry in (None, half, NONE)
    ]
    assert [trust.verdict for trust in found] == ["determined", "several modes", "several modes"]
    assert [trust.modes for trust in found] == [1, 2, 4]
    assert "determined up to a turn of 180 degrees" in str(found[2])


def test_a_can_that_is_printed_is_not_determined():
    mesh = trimesh.creation.cylinder(0.04, 0.12)
    contacts = on(mesh)
    assert chsel.register(mesh, contacts=contacts).trust.verdict == "determined"
    trust = chsel.register(mesh, contacts=contacts, symmetry=NONE).trust
    assert trust.verdict == "wide"
    assert "no declared symmetry" in trust.reason
    assert trust.turn_within > math.radians(150.0)


def test_a_half_turn_that_is_declared_is_one_mode_though_the_surface_has_it_not():
    """Contacts are on the sides without the knob, which leaves two modes."""
    mesh, points = box_with_knob(SIDES)
    contacts = apply(TRUTH, points)
    half = ObjectSymmetry.declared(turns=[about(Z, 180.0)])
    trust = chsel.register(mesh, contacts=contacts).trust
    assert (trust.verdict, trust.modes) == ("several modes", 2)
    trust = chsel.register(mesh, contacts=contacts, symmetry=half).trust
    assert (trust.verdict, trust.modes) == ("determined", 1)
    with pytest.raises(SettingError, match=r"symmetry is 'none'; accepted: chsel\.ObjectSymmetry"):
        chsel.register(mesh, contacts=contacts, symmetry="none")


def test_distances_are_those_of_the_nearest_copies():
    mesh, _ = box_with_knob(SIDES)
    plain = SdfGrid.from_mesh(mesh, 0.005)
    declared = with_symmetry(plain, ObjectSymmetry.declared(turns=[about(Z, 180.0)]))
    shift = compose(np.eye(3), np.array([0.0, 0.004, 0.0]))
    world_from_object = np.array([TRUTH, TRUTH @ about(Z, 180.0), shift @ TRUTH])
    poses = Poses.of(inverse(world_from_object))
    apart = distances_apart(declared, poses)
    assert apart[0, 1] < 1e-4  # the grid's interpolation
    assert distances_apart(plain, poses)[0, 1] > 0.005
    expected = outline_distances(plain, poses)[0, 2]
    np.testing.assert_allclose(apart[:2, 2], expected, rtol=0.1)


def test_errors_and_the_digest_go_by_what_is_declared():
    mesh = trimesh.creation.box(SIDES)
    grid = SdfGrid.from_mesh(mesh, 0.01)
    same = replace(grid)
    assert same.digest == grid.digest
    assert with_symmetry(grid, NONE).digest != grid.digest
    position, rotation = pose_errors(
        inverse(TRUTH @ about(Z, 180.0))[None], TRUTH, symmetry=with_symmetry(grid, NONE).symmetry
    )
    assert position[0] < 1e-3
    assert rotation[0] == pytest.approx(math.pi)


def test_the_pose_of_a_session_stays_the_same_copy(tmp_path):
    """Of a box, whose best pose is any of four."""
    mesh = trimesh.creation.box(SIDES)
    contacts = on(mesh, 40)
    with chsel.Session(mesh, record=tmp_path / "box.mcap") as session:
        assert session.pose is None
        poses = []
        best = []
        for n in range(8):
            session.add(contacts=contacts[5 * n : 5 * n + 5])
            best.append(session.register().world_from_object[0])
            poses.append(session.pose)
    turns = [rotation_angle((a.T @ b)[None])[0] for a, b in _pairs(poses[3:])]
    assert max(turns) < math.radians(20.0)
    jumps = [rotation_angle((a.T @ b)[None])[0] for a, b in _pairs(best[3:])]
    assert max(jumps) > math.radians(150.0)  # what the best hypotheses do


def _pairs(poses):
    turns = [pose[:3, :3] for pose in poses]
    return pairwise(turns)


@pytest.mark.parametrize("given", ["all", 3, {}, {"turn": []}, {"turns": [[1.0]]}])
def test_settings_that_are_no_symmetry_are_one_line(given):
    with pytest.raises(SettingError, match=r"^symmetry"):
        symmetry_from_settings("symmetry", given)


def test_settings_are_none_turns_or_axes():
    assert symmetry_from_settings("symmetry", None) is None
    assert len(symmetry_from_settings("symmetry", "none").rotations) == 1
    given = {"turns": [about(Z, 180.0).tolist()]}
    assert len(symmetry_from_settings("symmetry", given).rotations) == 2
