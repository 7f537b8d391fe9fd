"""Rigid transforms, and poses between poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from chsel.errors import PoseError
from chsel.problem.poses import (
    axis_angle,
    check_rigid,
    compose,
    interpolated,
    nearest_rigid,
    quaternions,
    random_rotations,
    rotation_matrices,
)


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
    between = interpolated(ends, others, t)
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
    found = interpolated(start, turned, np.array([0.5]))
    if angle == np.pi:  # either way round is as short
        found, half = interpolated(found, turned, np.array([1.0])), turned
    np.testing.assert_allclose(found, half, atol=1e-12)
