"""The energy of poses in kernels against its plain formula.

A box of 20 x 12 x 8 cm (BOX_GRID) is at TRUTH, world_from_object; `energy_of` is the kernel's
energy by points and noise, `plain_energies` the formula of chsel/problem/noise.py in numpy.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from chsel.methods.anchored.energy import Energy
from chsel.problem.noise import FACET, INDEPENDENT, WRONG, noise_model, normal_factors
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses, apply, compose, inverse, random_rotations
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from chsel.problem.trust import pose_energies
from tests.chsel.methods.scene import (
    BOX,
    BOX_GRID,
    BOX_SIDES,
    TRUTH,
    WORKSPACE,
    box_problem,
    contacts_on,
    energy_of,
    poses_around_truth,
)
from tests.chsel.samples import plain_energies

RANDOM = np.random.default_rng(8)
LATTICE = np.stack(np.meshgrid(*[np.arange(-0.1, 0.6, 0.04)] * 3, indexing="ij"), -1).reshape(-1, 3)
FREE = LATTICE[BOX_GRID.at(apply(inverse(TRUTH), LATTICE))[0] > 0.005]
OCCUPIED = apply(TRUTH, 0.03 * RANDOM.standard_normal((5, 3)))
SENSOR = 0.0005
TABLE_ERROR = 0.25**2 / 8.0  # nats a point: of chords of a parabola, a quarter of sigma long


def points_with(contacts):
    """Contacts, one of which is outside of the grid and one far off, and points of other kinds."""
    known = contacts_on(BOX, contacts)
    values = 0.005 * RANDOM.standard_normal(contacts)
    return KnownPoints(
        free=np.concatenate([FREE, [[5.0, 0.0, -3.0]]]),
        occupied=OCCUPIED,
        known=np.concatenate([known, [[2.0, -1.0, 0.5], [0.2, 0.1, 0.5]]]),
        known_sdf=np.concatenate([values, [2.0, 0.0]]),
    )


def near_and_far():
    """Most have free voxels in the object, some far more than WRONG allows."""
    places = np.random.default_rng(2).uniform(-0.1, 0.5, (8, 3))
    turns = random_rotations(np.random.default_rng(1), 8)
    near = [
        poses_around_truth(8, by[0], turn=by[1])
        for by in ((0.003, 0.03), (0.015, 0.1), (0.05, 0.4))
    ]
    return Poses.joined([*near, Poses.of(inverse(compose(turns, places)))])


@pytest.mark.parametrize(
    ("points", "shared"),
    [
        (points_with(6), 0.0),
        (points_with(60), 0.004),
        (KnownPoints(free=FREE, known=contacts_on(BOX, 20)), 0.0),
        (KnownPoints(free=FREE), 0.004),
        (KnownPoints(free=np.concatenate([FREE, [[1e9, 0.0, 0.0]]])), 0.0),
        (KnownPoints(occupied=OCCUPIED), 0.0),
    ],
    ids=["few contacts", "many contacts", "exact contacts", "free", "free, and far", "occupied"],
)
def test_energy_is_the_plain_formula(points, shared):
    """Also of poses that stretch the object."""
    noise = noise_model(SENSOR, shared)
    poses = near_and_far()
    poses = Poses.joined([poses, Poses(1.5 * poses.numbers)])
    expected = plain_energies(noise, BOX_GRID, points=points, poses=poses)
    assert np.ptp(expected) > 1.5 * WRONG
    counted = min(len(points.known), INDEPENDENT)
    found = energy_of(points, noise).of(poses)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9 + TABLE_ERROR * counted)


@pytest.mark.parametrize("contacts", [3, 40])
@pytest.mark.parametrize("least", [0.0, 0.7])
def test_energy_with_normals_is_the_plain_formula(contacts, least):
    """Some points have no normal, one has a wrong one, and one lies on an edge of the box."""
    noise = replace(noise_model(SENSOR), least_normal_noise=least)
    edge = apply(TRUTH, 0.5 * BOX_SIDES * [[1.0, 1.0, 0.3]])
    known = np.concatenate([contacts_on(BOX, contacts), edge])
    gradients = BOX_GRID.at(apply(inverse(TRUTH), known), lookup="trilinear")[1]
    normals = gradients / np.linalg.norm(gradients, axis=1, keepdims=True) @ TRUTH[:3, :3].T
    normals[1] *= -1.0
    normals[2] = 0.0
    stated = np.where(np.arange(len(known)) == 2, 0.0, np.linspace(0.05, 0.5, len(known)))
    points = KnownPoints(free=FREE, known=known, normals=normals, normal_noise=stated)
    poses = near_and_far()
    expected = plain_energies(noise, BOX_GRID, points=points, poses=poses)
    without = plain_energies(
        noise, BOX_GRID, points=KnownPoints(free=FREE, known=known), poses=poses
    )
    assert np.abs(expected - without).max() > 5.0
    found = energy_of(points, noise).of(poses)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9 + TABLE_ERROR * contacts)
    points = replace(points, free=FREE[:4000])  # of more, a part is looked at
    expected = plain_energies(noise, BOX_GRID, points=points, poses=poses)
    judged = pose_energies(box_problem(points), poses, noise=noise)
    np.testing.assert_allclose(judged, expected, rtol=0.0, atol=1e-9)


def test_a_right_normal_has_the_density_of_the_formula_and_a_wrong_one_a_tenth_of_uniform():
    """Of normals at 10 degrees on a flat face, whose density on the sphere has the integral 1."""
    variance = np.full(20_001, 0.5 * np.radians(10.0) ** 2 + FACET**2)
    cosines = np.linspace(-1.0, 1.0, len(variance))
    factors = normal_factors(variance, cosines)
    assert np.trapezoid(factors, cosines) / 2.0 == pytest.approx(1.0, abs=1e-4)
    assert factors[0] == pytest.approx(0.1, rel=0.02)
    angle = np.arccos(cosines)
    inner = factors * (angle < 0.6)
    inner = inner - 0.1 * (angle < 0.6)
    mean_square = np.trapezoid(inner * angle**2, cosines) / np.trapezoid(inner, cosines)
    assert 1.2 * variance[0] < mean_square / 2.0 < 2.0 * variance[0]  # twice, but for the tails


@pytest.mark.parametrize("axis", range(3))
def test_free_points_count_up_to_the_ends_of_a_long_object(axis):
    sdf = SdfGrid.from_mesh(trimesh.creation.box(np.roll([0.5, 0.06, 0.05], axis)), 0.01)
    places = np.roll([[x, 0.028, 0.0] for x in np.linspace(-0.24, 0.24, 25)], axis, axis=1)
    poses = Poses.of(compose(np.tile(np.eye(3), (25, 1, 1)), places))
    points = KnownPoints(free=np.zeros((1, 3)))
    noise = noise_model(SENSOR)
    problem = RegistrationProblem(
        sdf=sdf,
        points=points,
        initial_set=np.eye(4)[None],
        workspace=WORKSPACE,
        free_resolution=0.03,
        key=StreamKey(0, 0),
    )
    found = Energy(problem, points, noise=noise).of(poses)
    np.testing.assert_allclose(
        found, plain_energies(noise, sdf, points=points, poses=poses), atol=1e-9
    )
    assert found.min() > 0.05
