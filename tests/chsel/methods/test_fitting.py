"""Fits of poses: that they lower the written likelihood until it has a minimum."""

import numpy as np
from scipy.optimize import minimize

from chsel.methods.anchored.fitting import fitted, twists_of
from chsel.problem.noise import LEVELS, NoiseModel, noise_model
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses, apply, axis_angle, compose, rotation_angle
from chsel.problem.search_space import PlaneSettings, SE3Space, search_space
from chsel.problem.surface import object_centre
from tests.chsel.methods.scene import (
    BOX,
    BOX_GRID,
    BOX_SIDES,
    TRUTH,
    contacts_on,
    energy_of,
    on_faces,
    poses_around_truth,
)
from tests.chsel.samples import plain_energies

NOISE = noise_model(0.0005)
CENTRE = object_centre(BOX_GRID)
TWISTS = twists_of(SE3Space(), CENTRE)
X, Y, Z = 0.5 * BOX_SIDES
FOREIGN = apply(TRUTH, np.array([[0.0, 0.0, Z + 0.03]]))
FREE = np.array([[X - 0.004, 0.02, 0.01], [X - 0.003, -0.02, 0.01], [X - 0.006, 0.0, -0.01]])
OCCUPIED = np.array([[0.02, 0.01, -Z - 0.003], [-0.02, 0.01, -Z - 0.004]])
AT_ODDS = KnownPoints(
    free=apply(TRUTH, np.concatenate([FREE, [[0.03, Y - 0.004, 0.01], [0.04, Y - 0.015, -0.01]]])),
    occupied=apply(TRUTH, OCCUPIED),
    known=np.concatenate(
        [apply(TRUTH, on_faces(24, 0.001 * np.random.default_rng(1).standard_normal(24))), FOREIGN]
    ),
)
"""Contacts off by 1 mm, one on another object, and free and occupied voxels that are wrong."""


def off_truth(poses):
    """Metres and radians (B,)."""
    off = Poses.of(poses.matrices @ TRUTH)
    return np.sqrt((off.translations**2).sum(axis=1)), rotation_angle(off.rotations)


def test_a_fit_ends_where_no_motion_lowers_the_plain_formula():
    """Points of all classes disagree there, so that each must have its weight and its sign."""
    poses = poses_around_truth(6, 0.01, 0.1)
    found = fitted(energy_of(AT_ODDS, NOISE), TWISTS, poses, 60)
    before = plain_energies(NOISE, BOX_GRID, AT_ODDS, poses)
    after = plain_energies(NOISE, BOX_GRID, AT_ODDS, found)
    assert (after < before - 10.0).all()

    def moved(twist):
        angle = np.sqrt((twist[:3] ** 2).sum())
        turn = axis_angle(twist[:3] / max(angle, 1e-9), angle / 0.1)
        pose = Poses.of((compose(turn, twist[3:]) @ found.matrices[0])[None])
        return float(plain_energies(NOISE, BOX_GRID, AT_ODDS, pose)[0])

    options = {"xtol": 1e-5, "ftol": 1e-6, "direc": 1e-3 * np.eye(6)}
    least = minimize(moved, np.zeros(6), method="Powell", options=options)
    assert least.nfev > 60
    assert after[0] - least.fun < 0.01
    known = BOX_GRID.at(apply(found.matrices[0], AT_ODDS.known), lookup="trilinear")[0]
    assert np.abs(known[:24]).max() < 0.006
    assert abs(known[24] - 0.03) < 0.002  # the foreign contact moves nothing


def test_fits_by_rough_then_exact_noise_come_from_afar():
    rough = NoiseModel((0.015,) * LEVELS, (1.0 / LEVELS,) * LEVELS, softness=0.01, wrong=50.0)
    points = KnownPoints(known=np.concatenate([apply(TRUTH, on_faces(24)), FOREIGN]))
    energy = energy_of(points, NOISE)
    poses = poses_around_truth(40, 0.03, 0.3)
    shift, turn = off_truth(fitted(energy, TWISTS, fitted(energy.by(rough), TWISTS, poses, 20), 30))
    arrived = (shift < 0.001) & (turn < 0.01)
    assert arrived.mean() > 0.8
    assert (np.array(off_truth(poses)) > [[0.029], [0.29]]).all()


def test_no_fit_raises_an_energy_and_none_of_no_steps_moves():
    energy, poses = energy_of(AT_ODDS, NOISE), poses_around_truth(40, 0.1, 1.5)
    assert (energy.of(fitted(energy, TWISTS, poses, 4)) <= energy.of(poses)).all()
    np.testing.assert_array_equal(fitted(energy, TWISTS, poses, 0).numbers, poses.numbers)


def test_on_a_plane_fits_stay_on_it():
    space = search_space(PlaneSettings(plane_height=0.3), BOX_GRID)
    poses = space.poses(space.encode(poses_around_truth(6, 0.01, 0.1)))
    energy = energy_of(KnownPoints(known=contacts_on(BOX, 20)), NOISE)
    found = fitted(energy, twists_of(space, CENTRE), poses, 10)
    assert (energy.of(found) < energy.of(poses)).all()
    again = space.poses(space.encode(found))
    np.testing.assert_allclose(again.numbers, found.numbers, atol=1e-9)
