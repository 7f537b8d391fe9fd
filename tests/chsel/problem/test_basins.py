"""Basins and modes of a box, whose half turns leave its surface where it was."""

import math

import numpy as np

from chsel.problem.basins import MODE_DISTANCE, basin_bests, has_new_mode
from chsel.problem.poses import Poses, axis_angle, compose, inverse
from tests.chsel.methods.scene import BOX_GRID, TRUTH


def turned(angle, shift=0.0):
    """world_from_object: TRUTH after a turn about the box's x axis, and a shift along it."""
    turn = axis_angle(np.array([1.0, 0.0, 0.0]), np.array(angle))
    return np.asarray(TRUTH @ compose(turn, np.array([shift, 0.0, 0.0])))


def poses_of(*world_from_object):
    return Poses.of(inverse(np.array(world_from_object)))


def test_the_best_of_basins_are_apart_in_surface_or_turn():
    some = [turned(0.0), turned(0.02), turned(math.pi), turned(math.pi, 0.002), turned(0.0, 0.06)]
    some += [turned(0.0, 0.061)]
    assert basin_bests(BOX_GRID, poses_of(*some), most=9).tolist() == [0, 2, 4]
    assert basin_bests(BOX_GRID, poses_of(*some[::-1]), most=9).tolist() == [0, 2, 4]
    assert basin_bests(BOX_GRID, poses_of(*some), most=2).tolist() == [0, 2]
    assert basin_bests(BOX_GRID, poses_of(*some), most=9, distance=np.inf).tolist() == [
        0,
        2,
    ]  # by turns alone


def test_a_new_mode_is_farther_than_the_old_ones_are_from_each_other():
    near = [turned(0.0, 0.001 * n) for n in range(5)]
    far = [turned(0.0, 0.1)]
    assert not has_new_mode(BOX_GRID, poses_of(*near[:2]), new=poses_of(*near[2:]), count=30)
    assert has_new_mode(BOX_GRID, poses_of(*near), new=poses_of(near[0], *far), count=30)
    spread = poses_of(*(turned(0.0, MODE_DISTANCE * n) for n in (0, 14, 20, 30)))
    beside = poses_of(turned(0.0, MODE_DISTANCE * 38))
    between = poses_of(turned(0.0, MODE_DISTANCE * 25))
    assert has_new_mode(BOX_GRID, spread, new=beside, count=4)
    assert not has_new_mode(BOX_GRID, spread, new=beside, count=3)  # 14 cm from each other
    assert not has_new_mode(BOX_GRID, spread, new=between, count=4)
    none = Poses(np.zeros((0, 12)))
    assert has_new_mode(BOX_GRID, none, new=spread, count=30)
    assert not has_new_mode(BOX_GRID, spread, new=none, count=30)
