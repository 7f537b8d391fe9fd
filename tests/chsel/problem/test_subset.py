"""Choosing few poses for many, and distances between poses by points."""

import numpy as np
import trimesh

from chsel.plausible.surface_distance import SQUARE_MILLIMETRES, DistanceSettings, SurfaceDistance
from chsel.problem.poses import Poses, axis_angle, compose, inverse
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.subset import farthest_points, representative_poses, surface_descriptors
from chsel.problem.surface import surface_points

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
    surface = surface_points(GRID, 2000, StreamKey(0, 0).stream(Purpose.METRIC_POINTS))
    settings = DistanceSettings(len(surface), "grid")
    apart = SurfaceDistance(GRID, None, surface, settings).between(poses, inverse(poses))
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
    chosen = representative_poses(GRID, poses, 15)
    assert sorted(chosen // 2) == list(range(15))


def test_each_choice_is_the_one_that_takes_off_the_most():
    poses = Poses.of(transforms(40))
    points = surface_descriptors(GRID, poses)
    squares = ((points[:, None] - points[None]) ** 2).sum(axis=2)
    chosen = representative_poses(GRID, poses, 6)
    assert chosen[0] == 0
    for n in range(1, 6):
        nearest = squares[:, chosen[:n]].min(axis=1, keepdims=True)
        means = np.minimum(squares, nearest).mean(axis=0)
        assert means[chosen[n]] <= means.min() + 1e-12


def test_copies_are_chosen_once():
    poses = Poses.of(np.repeat(transforms(3), 4, axis=0))
    chosen = representative_poses(GRID, poses, 10)
    assert sorted(chosen // 4) == [0, 1, 2]
    assert representative_poses(GRID, poses[:1], 5).tolist() == [0]


def test_points_far_apart_are_each_the_farthest_from_those_before():
    points = np.array([[0.0], [1.0], [10.0], [4.0]])
    assert farthest_points(points, 4).tolist() == [0, 2, 3, 1]
    assert farthest_points(points, 3, given=2).tolist() == [0, 1, 2]
