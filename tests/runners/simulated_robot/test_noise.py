"""Noise whose size is known: where it is small, and how much worse it is at edges."""

import numpy as np
import pytest

from chsel.problem.streams import Purpose, StreamKey
from runners.simulated_robot.noise import (
    BASELINE,
    BUBBLE_NOISE,
    LOST,
    NOISE,
    bubble_depth,
    stereo_depth,
)
from runners.simulated_robot.settings import CameraSettings

PINHOLE = CameraSettings(width=320).pinhole
NEAR, FAR = 0.5, 0.9
LEFT, RIGHT = 120, 200  # columns of a bar before a wall


def stream(index=0):
    return StreamKey(7, 0).stream(Purpose.SENSOR_NOISE, index)


@pytest.fixture(scope="module")
def bar():
    """True depths of a bar before a wall, metres, and measured ones, millimetres."""
    depth = np.full((PINHOLE.height, PINHOLE.width), FAR)
    depth[:, LEFT:RIGHT] = NEAR
    return depth, stereo_depth(depth, PINHOLE, stream())


@pytest.mark.parametrize("distance", [0.5, 1.0, 2.0])
def test_noise_away_from_edges_grows_with_the_depth_squared(distance):
    measured = stereo_depth(np.full((PINHOLE.height, PINHOLE.width), distance), PINHOLE, stream())
    assert measured.dtype == np.uint16
    error = measured[measured > 0] / 1000.0 - distance
    expected = np.sqrt((NOISE * distance**2) ** 2 + 0.001**2 / 12.0)  # and rounding
    assert error.std() == pytest.approx(expected, rel=0.02)
    assert abs(error.mean()) < 1e-4
    assert (measured == 0).mean() == pytest.approx(LOST, rel=0.2)


def test_edges_are_where_the_camera_is_worst(bar):
    depth, measured = bar
    wrong = (measured > 0) & (np.abs(measured / 1000.0 - depth) > 0.05)
    columns = np.arange(PINHOLE.width)
    band = (np.abs(columns - LEFT) < 3) | (np.abs(columns - RIGHT) < 3)
    far_off = (np.abs(columns - LEFT) > 40) & (np.abs(columns - RIGHT) > 40)
    assert wrong[:, band].mean() > 0.1
    assert (measured[:, band] == 0).mean() > 0.2
    assert wrong[:, far_off].mean() == 0.0
    assert (measured[:, far_off] == 0).mean() < 0.01
    # Some pixels at edges float between both sides.
    between = (measured > 1000 * (NEAR + 0.05)) & (measured < 1000 * (FAR - 0.05))
    assert between.sum() > PINHOLE.height / 4
    assert not between[:, (np.abs(columns - LEFT) >= 12) & (np.abs(columns - RIGHT) >= 12)].any()


def test_the_shadow_of_the_second_eye_is_as_wide_as_geometry_says(bar):
    _, measured = bar
    width = PINHOLE.fx * BASELINE * (1.0 / NEAR - 1.0 / FAR)
    lost = (measured == 0).mean(axis=0)
    inside = lost[round(LEFT - width) + 3 : LEFT - 3]
    assert (inside > 0.6).all()
    assert lost[round(LEFT - width) - 8] < 0.1
    assert lost[RIGHT + 8] < 0.1  # only on the left, as the second eye is on the right


def test_a_bubble_camera_is_noisy_by_what_it_says():
    measured = bubble_depth(np.full((171, 224), 0.07), stream())
    assert measured.dtype == np.float32
    good = measured[measured > 0]
    assert good.std() == pytest.approx(np.sqrt(BUBBLE_NOISE**2 + 0.0001**2 / 12), rel=0.02)
    assert good.mean() == pytest.approx(0.07, abs=1e-5)
    assert 0 < (measured == 0).sum() < 0.003 * measured.size
