"""Search vectors of poses, in space and on a plane, and rotations and quaternions."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation, Slerp

from chsel.errors import PoseError, SettingError
from chsel.plausible.surface_distance import SQUARE_MILLIMETRES, DistanceSettings, SurfaceDistance
from chsel.problem.poses import (
    Poses,
    apply,
    axis_angle,
    check_rigid,
    compose,
    interpolated,
    inverse,
    nearest_rigid,
    quaternions,
    random_rotations,
    rotation_matrices,
    rotation_vector,
)
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import PlaneSettings, SE2Space, SE3Space
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.subset import farthest_points, representative_poses, surface_descriptors
from chsel.problem.surface import surface_points
from tests.chsel.samples import decode, random_poses

SIDES = (0.2, 0.1, 0.06)
BOX = SdfGrid.from_mesh(trimesh.creation.box(SIDES), 0.01)
STREAM = np.random.default_rng(0)
TILTED = SE2Space(PlaneSettings(axis=(0.0, 0.6, 0.8), offset=0.1), BOX)
OBLIQUE = SE2Space(
    PlaneSettings(axis=(0.3, 0.6, 0.8), offset=0.1, resting_rotation=(0.4, 1.0, 0.2)), BOX
)


def test_nine_numbers_and_transforms_are_inverse_to_each_other():
    transforms = random_poses(STREAM, 50, reach=0.3)
    vectors = SE3Space().encode(Poses.of(transforms))
    np.testing.assert_allclose(SE3Space().poses(vectors).matrices, transforms, atol=1e-14)
    vectors[:, 3:6] = 1.7 * vectors[:, 3:6] - 0.4 * vectors[:, 0:3]  # same span, same halves
    vectors[:, 0:3] *= 0.2
    np.testing.assert_allclose(SE3Space().poses(vectors).matrices, transforms, atol=1e-12)


def test_plane_pose_of_a_tilted_rotation_is_the_nearest_by_frobenius():
    tilt = axis_angle(np.array([0.8, 0.0, 0.6]), np.deg2rad(10.0))
    angles = np.linspace(-np.pi, np.pi, 20_001)
    turns = axis_angle(np.tile(TILTED.axis, (len(angles), 1)), angles)
    for rotation in turns[::2222] @ tilt:
        found = TILTED.encode(Poses.of(compose(rotation, np.zeros(3))[None]))[0, 0]
        best = angles[((turns - rotation) ** 2).sum(axis=(1, 2)).argmin()]
        assert np.cos(found - best) > np.cos(4e-4)


def test_plane_poses_survive_encoding_and_stay_on_the_plane():
    settings = PlaneSettings(axis=(0, 0, 2.0), offset=-0.1, resting_rotation=(np.pi / 2, 0, 0))
    space = SE2Space(settings, BOX)
    vectors = STREAM.uniform(-1.0, 1.0, (30, 3))
    transforms = space.poses(vectors).matrices
    np.testing.assert_allclose(space.encode(Poses.of(transforms)), vectors, atol=1e-12)
    np.testing.assert_allclose(transforms[:, 2, 3], -0.1, atol=1e-15)
    rest = rotation_vector(np.array([np.pi / 2, 0, 0]))
    np.testing.assert_allclose(transforms[:, 2, :3], np.tile(rest[2], (30, 1)), atol=1e-12)


@pytest.mark.parametrize(
    ("resting", "normal", "half"),
    [((0, 0, 0), (0, 0, 1), 0.03), ((np.pi / 2, 0, 0), (0, 1, 0), 0.05)],
)
def test_plane_height_puts_the_object_onto_the_plane(resting, normal, half):
    """A box at rest on a table at height 0.4, in every pose of the plane."""
    axis = rotation_vector(np.array(resting)) @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(np.abs(axis), normal, atol=1e-12)
    settings = PlaneSettings(axis=tuple(axis), plane_height=0.4, resting_rotation=resting)
    transforms = SE2Space(settings, BOX).poses(STREAM.uniform(-1.0, 1.0, (5, 3))).matrices
    for transform in transforms:
        heights = apply(inverse(transform), trimesh.creation.box(SIDES).vertices)[:, 2]
        assert heights.min() == pytest.approx(0.4, abs=1e-3)
        assert heights.max() == pytest.approx(0.4 + 2 * half, abs=1e-3)


@pytest.mark.parametrize("space", [SE3Space(), OBLIQUE])
def test_compiled_decoding_is_that_of_torch(space):
    vectors = STREAM.uniform(-3.0, 3.0, (50, space.dimension))
    rotation, translation = decode(space, torch.tensor(vectors))
    expected = compose(rotation.numpy(), translation.numpy())
    np.testing.assert_allclose(space.poses(vectors).matrices, expected, rtol=0.0, atol=3e-15)


@pytest.mark.parametrize(
    "changes", [{}, {"plane_height": 0.0, "offset": 0.0}, {"axis": (0, 0, 0), "offset": 0.0}]
)
def test_planes_that_say_too_little_or_too_much_are_refused(changes):
    with pytest.raises(SettingError):
        PlaneSettings(**changes)


def test_transforms_that_are_not_rigid_are_named():
    poses = np.tile(np.eye(4), (3, 1, 1))
    check_rigid("poses", poses)
    for row, column, value in ((0, 0, 1.1), (0, 0, -1.0), (3, 0, 0.5)):
        broken = poses.copy()
        broken[2, row, column] = value
        with pytest.raises(PoseError, match=r"poses\[2\] is not a rigid transform"):
            check_rigid("poses", broken)
    rounded = np.round(poses + 1e-5 * np.arange(16).reshape(4, 4) * (np.arange(4)[:, None] < 3), 7)
    check_rigid("poses", nearest_rigid("poses", rounded))


def test_quaternions_and_rotations_are_each_others_inverse():
    r = random_rotations(np.random.default_rng(0), 100)
    r = np.concatenate([r, np.eye(3)[None], axis_angle(np.eye(3), np.full(3, np.pi))])
    np.testing.assert_allclose(rotation_matrices(quaternions(r)), r, atol=1e-14)


def test_turns_are_those_of_scipy_and_positions_on_a_line():
    first, second = random_rotations(np.random.default_rng(1), 2)
    t = np.array([0.0, 0.1, 0.5, 0.9, 1.0])
    ends = np.tile(compose(first, np.array([1.0, 2.0, 3.0])), (5, 1, 1))
    others = np.tile(compose(second, np.array([2.0, 0.0, 3.0])), (5, 1, 1))
    between = interpolated(ends, others, fraction=t)
    expected = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([first, second])))(t)
    np.testing.assert_allclose(between[:, :3, :3], expected.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(between[:, :3, 3], [[1 + s, 2 - 2 * s, 3] for s in t], atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, np.pi])
def test_half_of_a_turn_is_half_its_angle(angle):
    rotation = random_rotations(np.random.default_rng(2), 1)[0]
    axis = np.array([0.6, 0.0, 0.8])
    start, half, turned = (
        compose(axis_angle(axis, part * angle) @ rotation, np.zeros(3))[None]
        for part in (0.0, 0.5, 1.0)
    )
    found = interpolated(start, turned, fraction=np.array([0.5]))
    if angle == np.pi:  # either way round is as short
        found = interpolated(found, turned, fraction=np.array([1.0]))
        half = turned
    np.testing.assert_allclose(found, half, atol=1e-12)


GRID = SdfGrid.from_mesh(trimesh.creation.box((0.2, 0.12, 0.08)), 0.01)


def transforms(count):
    """Poses in a few clusters of unequal sizes, object_from_world."""
    random = np.random.default_rng(4)
    cluster = np.minimum(random.geometric(0.4, count) - 1, 5)
    angles = cluster + 0.1 * random.standard_normal(count)
    turns = axis_angle(np.broadcast_to([0.0, 0.6, 0.8], (count, 3)), angles)
    places = 0.1 * cluster[:, None] + 0.01 * random.standard_normal((count, 3))
    return inverse(compose(turns, places))


def test_descriptors_differ_about_as_much_as_surfaces_do():
    poses = transforms(30)
    surface = surface_points(GRID, 2000, stream=StreamKey(0, 0).stream(Purpose.METRIC_POINTS))
    settings = DistanceSettings(len(surface), "grid")
    apart = SurfaceDistance(GRID, None, points=surface, settings=settings).between(
        poses, inverse(poses)
    )
    apart = (apart + apart.T) / 2.0
    descriptors = surface_descriptors(GRID, Poses.of(poses))
    squares = ((descriptors[:, None] - descriptors[None]) ** 2).mean(axis=2) * SQUARE_MILLIMETRES
    near = (apart > 1.0) & (apart < 400.0)
    assert near.sum() > 100
    ratio = np.sqrt(squares[near] / apart[near])
    assert 0.5 < np.quantile(ratio, 0.05) < np.quantile(ratio, 0.95) < 1.6


def test_poses_that_a_symmetry_makes_alike_stand_for_each_other():
    turns = axis_angle(np.broadcast_to([0.0, 0.0, 1.0], (30, 3)), np.pi * (np.arange(30) % 2))
    places = np.repeat(0.02 * np.arange(15.0)[:, None] * [1.0, 0.5, 0.0], 2, axis=0)
    poses = Poses.of(inverse(compose(turns, places)))  # a box looks the same after half a turn
    descriptors = surface_descriptors(GRID, poses)
    np.testing.assert_allclose(descriptors[::2], descriptors[1::2], atol=3e-4)
    chosen = representative_poses(GRID, poses, count=15)
    assert sorted(chosen // 2) == list(range(15))


def test_each_choice_is_the_one_that_takes_off_the_most():
    poses = Poses.of(transforms(40))
    points = surface_descriptors(GRID, poses)
    squares = ((points[:, None] - points[None]) ** 2).sum(axis=2)
    chosen = representative_poses(GRID, poses, count=6)
    assert chosen[0] == 0
    for n in range(1, 6):
        nearest = squares[:, chosen[:n]].min(axis=1, keepdims=True)
        means = np.minimum(squares, nearest).mean(axis=0)
        assert means[chosen[n]] <= means.min() + 1e-12


def test_copies_are_chosen_once():
    poses = Poses.of(np.repeat(transforms(3), 4, axis=0))
    chosen = representative_poses(GRID, poses, count=10)
    assert sorted(chosen // 4) == [0, 1, 2]
    assert representative_poses(GRID, poses[:1], count=5).tolist() == [0]


def test_points_far_apart_are_each_the_farthest_from_those_before():
    points = np.array([[0.0], [1.0], [10.0], [4.0]])
    assert farthest_points(points, 4).tolist() == [0, 2, 3, 1]
    assert farthest_points(points, 3, chosen_first=2).tolist() == [0, 1, 2]
