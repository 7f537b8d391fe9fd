"""Choosing few poses for many, and distances between poses by points."""

from __future__ import annotations

import numpy as np
import trimesh

from chsel.arrays import FloatArray, IntArray
from chsel.diverse import embedded, representative, spaced
from chsel.engine import poses_of
from chsel.pose import apply, axis_angle, compose, inverse
from chsel.sdf import SdfGrid
from chsel.streams import Purpose, StreamKey
from chsel.surface import surface_points

GRID = SdfGrid.from_mesh(trimesh.creation.box((0.2, 0.12, 0.08)), 0.01)


def transforms(count: int) -> FloatArray:
    """Poses in a few clusters of unequal sizes, object_from_world."""
    random = np.random.default_rng(4)
    cluster = np.minimum(random.geometric(0.4, count) - 1, 5)
    angles = cluster + 0.1 * random.standard_normal(count)
    turns = axis_angle(np.broadcast_to([0.0, 0.6, 0.8], (count, 3)), angles)
    places = 0.1 * cluster[:, None] + 0.01 * random.standard_normal((count, 3))
    return inverse(compose(turns, places))


def squared_distances(points: FloatArray, chosen: IntArray) -> FloatArray:
    """Of all points (B, d) to the nearest chosen one."""
    return ((points[:, None] - points[chosen][None]) ** 2).sum(axis=2).min(axis=1)


def test_distances_of_points_are_the_rms_distances_of_the_surface() -> None:
    poses = transforms(20)
    surface = surface_points(GRID, 20_000, StreamKey(0, 0).stream(Purpose.MESH_SAMPLES))
    moved = np.stack([apply(pose, surface) for pose in inverse(poses)])
    rms = np.sqrt(((moved[1:] - moved[0]) ** 2).sum(axis=2).mean(axis=1))
    points = embedded(GRID, poses_of(poses))
    distances = np.sqrt(((points[1:] - points[0]) ** 2).sum(axis=1))
    np.testing.assert_allclose(distances, rms, rtol=0.03)


def test_chosen_poses_stand_for_all_better_than_the_first_ones_do() -> None:
    poses = poses_of(transforms(200))
    points = embedded(GRID, poses)
    chosen = representative(GRID, poses, 8)
    assert chosen[0] == 0
    assert len(set(chosen)) == 8
    ours = squared_distances(points, chosen).mean()
    assert ours < 0.8 * squared_distances(points, np.arange(8)).mean()
    fewer = squared_distances(points, representative(GRID, poses, 4)).mean()
    assert ours < fewer


def test_each_choice_is_the_one_that_takes_off_the_most() -> None:
    poses = poses_of(transforms(40))
    points = embedded(GRID, poses)
    chosen = representative(GRID, poses, 6)
    for n in range(1, 6):
        means = [
            squared_distances(points, np.append(chosen[:n], other)).mean() for other in range(40)
        ]
        assert means[chosen[n]] <= min(means) + 1e-12


def test_copies_are_chosen_once() -> None:
    poses = np.repeat(poses_of(transforms(3)), 4, axis=0)
    chosen = representative(GRID, poses, 10)
    assert sorted(chosen // 4) == [0, 1, 2]
    assert representative(GRID, poses[:1], 5).tolist() == [0]


def test_every_next_pose_is_the_farthest_from_those_before() -> None:
    poses = poses_of(transforms(60))
    points, order = embedded(GRID, poses), spaced(GRID, poses, 60)
    assert order[0] == 0
    assert sorted(order) == list(range(60))
    reached = [
        ((points[order[:n]] - points[order[n]]) ** 2).sum(axis=1).min() for n in range(1, 60)
    ]
    assert (np.diff(reached) <= 1e-12).all()
