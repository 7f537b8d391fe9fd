"""Axes of drawings."""

from __future__ import annotations

import numpy as np
import pytest

from replay.rerun.plane import Frame, ticks


@pytest.mark.parametrize(
    ("lower", "upper", "expected"),
    [
        (-0.35, 0.35, [-0.2, 0.0, 0.2]),
        (0.0, 100.0, [0.0, 25.0, 50.0, 75.0, 100.0]),
        (-3.2, 3.2, [-2.0, 0.0, 2.0]),
        (5.0, 5.0, [5.0]),
        (0.301, 0.302, [0.301, 0.30125, 0.3015, 0.30175, 0.302]),
    ],
)
def test_ticks_are_round_and_few(lower: float, upper: float, expected: list[float]) -> None:
    np.testing.assert_allclose(ticks(lower, upper), expected, atol=1e-12)


def test_fractions_run_to_the_right_and_upwards() -> None:
    frame = Frame(40.0, 20.0)
    assert (frame.x(0.25), frame.y(0.25)) == (10.0, 15.0)
    assert np.ptp(frame.outline()[0], axis=0).tolist() == [40.0, 20.0]
