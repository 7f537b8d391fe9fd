"""Poses unlike each other, by their surfaces or by turns, and turns that are near symmetries."""

import math

import numpy as np
import pytest
import trimesh

from chsel.methods.anchored.modes import FAR, distinct, has_new_mode, near_symmetries
from chsel.problem.poses import Poses, axis_angle, compose, inverse, rotation_angle
from chsel.problem.sdf_grid import SdfGrid
from tests.chsel.methods.scene import BOX_GRID, GRID, TRUTH


def turned(angle, shift=0.0):
    """world_from_object: TRUTH after a turn about the box's x axis, and a shift along it."""
    turn = axis_angle(np.array([1.0, 0.0, 0.0]), np.array(angle))
    return np.asarray(TRUTH @ compose(turn, np.array([shift, 0.0, 0.0])))


def poses_of(*world_from_object):
    return Poses.of(inverse(np.array(world_from_object)))


def test_distinct_poses_are_apart_in_surface_or_turn():
    """A half turn of a box leaves its surface where it was."""
    some = [turned(0.0), turned(0.02), turned(math.pi), turned(math.pi, 0.002), turned(0.0, 0.06)]
    some += [turned(0.0, 0.061)]
    assert distinct(BOX_GRID, poses_of(*some), 9).tolist() == [0, 2, 4]
    assert distinct(BOX_GRID, poses_of(*some[::-1]), 9).tolist() == [0, 2, 4]
    assert distinct(BOX_GRID, poses_of(*some), 2).tolist() == [0, 2]
    assert distinct(BOX_GRID, poses_of(*some), 9, np.inf).tolist() == [0, 2]  # by turns alone


def test_a_new_mode_is_farther_than_the_old_ones_are_from_each_other():
    near, far = [turned(0.0, 0.001 * n) for n in range(5)], [turned(0.0, 0.1)]
    assert not has_new_mode(BOX_GRID, poses_of(*near[:2]), poses_of(*near[2:]), 30)
    assert has_new_mode(BOX_GRID, poses_of(*near), poses_of(near[0], *far), 30)
    spread = poses_of(*(turned(0.0, 8.0 * FAR * n) for n in range(4)))
    between = poses_of(turned(0.0, 12.0 * FAR))
    assert not has_new_mode(BOX_GRID, spread, between, 4)
    none = Poses(np.zeros((0, 12)))
    assert has_new_mode(BOX_GRID, none, spread, 30)
    assert not has_new_mode(BOX_GRID, spread, none, 30)


@pytest.mark.parametrize(
    ("sides", "halves", "quarters"),
    [((0.1, 0.06, 0.16), 3, 0), ((0.1, 0.102, 0.16), 5, 2)],
)
def test_near_symmetries_of_a_box(sides, halves, quarters):
    """Of two sides 2 mm apart also half turns about their diagonals, and quarter turns."""
    sdf = SdfGrid.from_mesh(trimesh.creation.box(sides), 0.005)
    found = near_symmetries(sdf)
    angles = rotation_angle(found[:, :3, :3])
    assert (np.abs(angles - np.pi) < 0.02).sum() == halves
    assert (np.abs(angles - 0.5 * np.pi) < 0.02).sum() == quarters
    assert len(found) == halves + quarters
    np.testing.assert_allclose(np.sort(np.abs(found[:, :3, :3]), axis=2)[..., :2], 0.0, atol=0.02)
    np.testing.assert_allclose(found[:, :3, 3], 0.0, atol=0.001)
    assert near_symmetries(sdf) is found


def test_an_object_without_symmetry_has_none():
    assert near_symmetries(GRID).shape == (0, 4, 4)
    nowhere = SdfGrid(GRID.origin, 0.01, np.abs(GRID.values) + 0.01, GRID.gradients)
    assert near_symmetries(nowhere).shape == (0, 4, 4)
