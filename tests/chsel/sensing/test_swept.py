"""Solids that move through a grid."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from chsel.errors import PoseError, SettingError
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import Workspace
from chsel.problem.poses import apply, axis_angle, compose, inverse
from chsel.sensing.free_space import FreeGrid, interior_lattice, poses_between
from tests.chsel.samples import box_distance, random_poses

SIZE = np.array([0.10, 0.04, 0.06])
SPACING = 0.01
DIAGONAL = np.sqrt(3.0) * SPACING
WORKSPACE = Workspace((-0.2, -0.2, -0.1), (0.3, 0.2, 0.1))
UP = np.array([0.0, 0.0, 1.0])


def turns(angles: FloatArray) -> FloatArray:
    return axis_angle(np.tile(UP, (len(angles), 1)), angles)


def distance_to_box(points: FloatArray, poses: FloatArray) -> FloatArray:
    """Signed distance (N,) to the union of the box at poses (P, 4, 4), from outside exact."""
    best = np.full(len(points), np.inf)
    for box_from_world in inverse(poses):
        best = np.minimum(best, box_distance(apply(box_from_world, points), SIZE))
    return best


def test_nodes_of_a_box_are_around_its_middle_and_off_its_faces() -> None:
    box = trimesh.creation.box(SIZE)
    box.apply_translation([0.3, 0.2, 0.1])
    nodes = interior_lattice(box, 0.01)
    assert len(nodes) == 9 * 3 * 5
    np.testing.assert_allclose(nodes.mean(axis=0), [0.3, 0.2, 0.1], atol=1e-12)
    assert (np.abs(nodes - [0.3, 0.2, 0.1]) < 0.5 * SIZE - 1e-3).all()


def test_thin_parts_have_nodes_and_several_solids_add_up() -> None:
    plate = trimesh.creation.box((0.1, 0.1, 0.001))
    ball = trimesh.creation.icosphere(radius=0.03)
    ball.apply_translation([0.5, 0.0, 0.0])
    assert len(interior_lattice(plate, 0.01)) == 81
    both = interior_lattice([plate, ball], 0.01)
    near_ball = np.sqrt(((both - [0.5, 0.0, 0.0]) ** 2).sum(axis=1)) < 0.03
    assert near_ball.sum() == 93  # whole numbers with i^2 + j^2 + k^2 < 9
    assert len(both) == 81 + near_ball.sum()
    assert interior_lattice([], 0.01).shape == (0, 3)


def test_a_spacing_that_makes_too_many_nodes_is_refused() -> None:
    with pytest.raises(SettingError, match=r"spacing is 1e-05 m.*2_000_000"):
        interior_lattice(trimesh.creation.box(SIZE), 1e-5)


def test_nothing_moves_further_than_a_step_and_all_poses_lie_near_the_way() -> None:
    stream = np.random.default_rng(0)
    poses = random_poses(stream, 6, 0.2)
    way = poses_between(poses, step=0.005, radius=0.1)
    np.testing.assert_array_equal(way[[0, -1]], poses[[0, -1]])
    points = stream.normal(size=(50, 3))
    points *= 0.1 / np.sqrt((points**2).sum(axis=1, keepdims=True))
    moved = np.diff(apply(way, points), axis=0)
    longest = np.sqrt((moved**2).sum(axis=-1)).max()
    assert 0.003 < longest <= 0.005 + 1e-12
    for pose in poses:  # each of them is one of the way
        assert np.abs(way - pose).max(axis=(1, 2)).min() == 0.0


def test_poses_that_hardly_move_are_thinned() -> None:
    poses = np.tile(np.eye(4), (5001, 1, 1))
    poses[:, 0, 3] = np.linspace(0.0, 0.1, 5001)
    way = poses_between(poses, step=0.01, radius=0.2)
    assert 11 <= len(way) <= 12
    assert np.diff(way[:, 0, 3]).max() <= 0.01 + 1e-12
    np.testing.assert_array_equal(way[[0, -1]], poses[[0, -1]])
    assert len(poses_between(np.tile(np.eye(4), (100, 1, 1)), step=0.01, radius=0.2)) == 2
    assert len(poses_between(np.eye(4)[None], step=0.01, radius=0.2)) == 1
    assert len(poses_between(np.zeros((0, 4, 4)), step=0.01, radius=0.2)) == 0


def test_poses_too_far_apart_are_refused() -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 1e9
    with pytest.raises(PoseError, match=r"1e\+09 m.*accepted: at most 1_000_000"):
        poses_between(poses, step=0.005, radius=0.1)
    with pytest.raises(PoseError, match=r"poses\[1\] is not a rigid transform"):
        poses_between(np.stack([np.eye(4), 2.0 * np.eye(4)]), step=0.005, radius=0.1)


@pytest.mark.parametrize("turned", [0.0, 1.3, 3.0])
def test_a_box_that_moves_and_turns_frees_the_voxels_it_passes(turned: float) -> None:
    given = compose(
        turns(np.array([0.2, 0.2 + turned])), np.array([[-0.1, 0.0, 0], [0.2, 0.05, 0]])
    )
    interior = interior_lattice(trimesh.creation.box(SIZE), 0.005)
    grid = FreeGrid(WORKSPACE, SPACING)
    fresh = grid.at(interior, poses=poses_between(given, step=0.005, radius=0.07))
    centres = grid.new()
    assert len(centres) == fresh

    s = np.linspace(0.0, 1.0, 301)
    position = given[0, :3, 3] + s[:, None] * (given[1] - given[0])[:3, 3]
    dense = compose(turns(0.2 + s * turned), position)
    assert distance_to_box(centres, dense).max() <= 0.5 * DIAGONAL
    every = grid.lattice.centres(np.indices(grid.shape).reshape(3, -1).T)
    wholly = every[distance_to_box(every, dense) < -0.5 * DIAGONAL]
    assert len(wholly) > 100
    grid.at(wholly)
    assert len(grid.new()) == 0  # all of them were free before
