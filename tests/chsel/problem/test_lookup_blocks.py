"""Signed distances of points in blocks beside those of single points."""

import numba
import numpy as np
import pytest

from chsel.numerics.pose_tuples import pose_at
from chsel.problem.lookup_blocks import (
    MOST,
    block_of,
    blocks_of,
    distance_in_block,
    gradient_in_block,
    locate_block,
)
from chsel.problem.sdf_lookup import distance_at, distance_field, distance_with_gradient
from tests.chsel.methods.scene import BOX_GRID, poses_around_truth


@numba.njit
def fill_in_blocks(field, poses, points, blocks, out):
    pose = pose_at(poses, 0)
    for first in range(0, len(points), MOST):
        block = block_of(blocks, first)
        size = min(MOST, len(points) - first)
        locate_block(field.box, pose, block, size)
        for n in range(size):
            out[first + n, 0] = distance_in_block(field, pose, block, n)
            gradient = gradient_in_block(field, pose, block, n)
            for i in range(4):
                out[first + n, 1 + i] = gradient[i]


@numba.njit
def fill_one_by_one(field, poses, points, out):
    pose = pose_at(poses, 0)
    for n in range(len(points)):
        x, y, z = points[n]
        out[n, 0] = distance_at(field, pose, x, y, z)
        gradient = distance_with_gradient(field, pose, x, y, z)
        for i in range(4):
            out[n, 1 + i] = gradient[i]


@pytest.mark.parametrize("count", [0, 1, MOST, 2 * MOST + 5])
def test_points_in_blocks_have_the_distances_of_single_points(count):
    """Most are out of the grid, some in it."""
    field = distance_field(BOX_GRID, "trilinear", outside="surface_point")
    pose = poses_around_truth(1, 0.05, turn=0.4).numbers
    points = np.random.default_rng(3).uniform(-0.6, 0.9, (count, 3))
    found = np.zeros((count, 5))
    wanted = np.zeros((count, 5))
    fill_in_blocks(field, pose, points, blocks_of(points), found)
    fill_one_by_one(field, pose, points, wanted)
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-12)
