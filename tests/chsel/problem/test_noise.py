"""The noise of contacts and the share of outliers, from distances at the best pose."""

from __future__ import annotations

import numpy as np
import pytest

from chsel.problem.noise import PRIOR_CONTACTS, PRIOR_OUTLIERS, estimate_noise

SENSOR = 0.0005


@pytest.mark.parametrize("sigma", [0.001, 0.006])
@pytest.mark.parametrize("foreign", [0, 60])
def test_many_distances_tell_the_noise_and_the_share_of_outliers(
    sigma: float, foreign: int
) -> None:
    random = np.random.default_rng(3)
    distances = np.concatenate([random.normal(0.0, sigma, 600), random.uniform(0.05, 0.2, foreign)])
    noise = estimate_noise(random.permutation(distances), SENSOR)
    assert noise.sigma == pytest.approx(sigma, rel=0.06)
    assert noise.outliers == pytest.approx(foreign / len(distances), abs=0.003)


@pytest.mark.parametrize("count", [0, 1, 3, 6])
def test_few_distances_that_a_fit_makes_small_leave_the_noise_of_the_sensor(count: int) -> None:
    noise = estimate_noise(np.full(count, 1e-5), SENSOR)
    assert noise.sigma == pytest.approx(SENSOR, rel=1e-3)
    expected = PRIOR_CONTACTS * PRIOR_OUTLIERS / (PRIOR_CONTACTS + count)
    assert noise.outliers == pytest.approx(expected)


def test_it_is_never_less_than_the_sensor_s() -> None:
    assert estimate_noise(np.full(100, 1e-6), SENSOR).sigma == SENSOR


def test_one_contact_far_off_among_five_is_an_outlier() -> None:
    distances = np.array([0.0003, -0.0004, 0.05, 0.0002, -0.0001])
    noise = estimate_noise(distances, SENSOR)
    assert noise.sigma < 2.0 * SENSOR
    assert noise.outliers == pytest.approx((1.0 + PRIOR_CONTACTS * PRIOR_OUTLIERS) / 9.0)


def test_neither_order_nor_sign_matters() -> None:
    distances = np.random.default_rng(1).normal(0.0, 0.003, 40)
    assert estimate_noise(distances, SENSOR) == estimate_noise(-distances[::-1], SENSOR)
