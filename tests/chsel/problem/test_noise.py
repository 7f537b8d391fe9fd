"""What points are off: estimated at the best pose, and the likelihood of poses by it."""

import numpy as np
import pytest

from chsel.problem.noise import LEVELS, PRIOR_CONTACTS, PRIOR_OUTLIERS, estimate_noise, noise_model
from tests.chsel.samples import plain_energy

SENSOR = 0.0005


@pytest.mark.parametrize(("sigma", "foreign"), [(0.001, 0), (0.006, 60)])
def test_many_distances_tell_the_noise_and_the_share_of_outliers(sigma, foreign):
    random = np.random.default_rng(3)
    distances = np.concatenate([random.normal(0.0, sigma, 600), random.uniform(0.05, 0.2, foreign)])
    noise = estimate_noise(random.permutation(distances), SENSOR)
    assert noise.sigma == pytest.approx(sigma, rel=0.06)
    assert noise.outliers == pytest.approx(foreign / len(distances), abs=0.003)
    assert estimate_noise(-distances[::-1], SENSOR) == noise  # neither order nor sign matters


@pytest.mark.parametrize("count", [0, 1, 6, 100])
def test_distances_that_a_fit_makes_small_leave_the_noise_of_the_sensor(count):
    noise = estimate_noise(np.full(count, 1e-5), SENSOR)
    assert SENSOR <= noise.sigma < 1.001 * SENSOR
    expected = PRIOR_CONTACTS * PRIOR_OUTLIERS / (PRIOR_CONTACTS + count)
    assert noise.outliers == pytest.approx(expected)


def test_one_contact_far_off_among_five_is_an_outlier():
    distances = np.array([0.0003, -0.0004, 0.05, 0.0002, -0.0001])
    noise = estimate_noise(distances, SENSOR)
    assert noise.sigma < 2.0 * SENSOR
    assert noise.outliers == pytest.approx((1.0 + PRIOR_CONTACTS * PRIOR_OUTLIERS) / 9.0)


@pytest.mark.parametrize(("known", "shared"), [(0, 0.0), (3, 0.0), (12, 0.004), (50, 0.0)])
def test_energies_are_the_formula(known, shared):
    """Of contacts, one of which is 30 cm off, and of 40 voxels: none, some or most are wrong."""
    random, noise = np.random.default_rng(known), noise_model(SENSOR, shared)
    residuals = random.normal(0.0, 0.004, (9, known))
    residuals[4:, :1] = 0.3
    depths = random.normal(np.repeat([-0.03, -0.003, 0.01], 3)[:, None], 0.004, (9, 40))
    expected = [plain_energy(noise, *row) for row in zip(residuals, depths, strict=True)]
    np.testing.assert_allclose(noise.energies(residuals, depths), expected, rtol=1e-12, atol=1e-12)


def test_levels_of_noise_are_those_of_the_sensor_and_of_all_else():
    one, other = noise_model(0.0), noise_model(0.003)
    assert len(one.sigmas) == LEVELS
    assert sum(one.weights) == pytest.approx(1.0)
    squares = np.square(other.sigmas) - np.square(one.sigmas)
    np.testing.assert_allclose(squares, 0.003**2)
    ratios = np.diff(np.log(one.sigmas))
    np.testing.assert_allclose(ratios, ratios[0])
    assert one.sigmas[0] < 0.001 < 0.005 < one.sigmas[-1]
