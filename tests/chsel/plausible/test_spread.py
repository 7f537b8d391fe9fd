"""The spread of a set of hypotheses."""

from __future__ import annotations

import numpy as np
import pytest

from chsel.plausible.pose_metrics import spread
from chsel.problem.poses import axis_angle, compose, inverse
from chsel.problem.registration_problem import Hypotheses

CENTRE = np.array([0.5, 0.0, 0.0])
TURN = axis_angle(np.array([0.0, 0.0, 1.0]), np.pi / 2)


def hypotheses(world_from_object: np.ndarray, duplicate: list[bool]) -> Hypotheses:
    count = len(duplicate)
    return Hypotheses(
        object_from_world=inverse(world_from_object),
        cost=np.zeros(count),
        duplicate=np.array(duplicate, dtype=bool),
        cell=np.full(count, -1),
        elites=np.zeros((0, 4, 4)),
    )


def test_turning_about_the_centre_spreads_rotations_alone() -> None:
    turned = compose(TURN, CENTRE - TURN @ CENTRE)
    half_turned = compose(TURN @ TURN, CENTRE - TURN @ TURN @ CENTRE)
    found = spread(hypotheses(np.stack([np.eye(4), turned, half_turned]), [False] * 3), CENTRE)
    assert found is not None
    assert found.position == pytest.approx(0.0, abs=1e-12)
    assert found.rotation == pytest.approx(0.75 * np.pi)  # a quarter and a half turn


def test_positions_are_those_of_the_centre_in_the_world() -> None:
    poses = compose(np.stack([np.eye(3), TURN]), np.zeros((2, 3)))
    found = spread(hypotheses(poses, [False, False]), CENTRE)
    assert found is not None
    assert found.position == pytest.approx(np.sqrt(0.5) / 2)  # from (0.5, 0) to (0, 0.5)


def test_duplicates_do_not_count() -> None:
    poses = compose(np.tile(np.eye(3), (3, 1, 1)), np.array([[0, 0, 0], [0.2, 0, 0], [9, 0, 0]]))
    found = spread(hypotheses(poses, [False, False, True]), CENTRE)
    assert found is not None
    assert found.position == pytest.approx(0.1)


def test_one_hypothesis_has_no_spread_and_none_has_none() -> None:
    assert spread(hypotheses(np.eye(4)[None], [False]), CENTRE) == (0.0, 0.0)
    assert spread(hypotheses(np.zeros((0, 4, 4)), []), CENTRE) is None
