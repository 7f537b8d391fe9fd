"""Errors of BOP, where the right values follow from the geometry."""

import numpy as np
import pytest

from chsel.errors import SettingError
from chsel.plausible.bop_errors import bop_errors, declared_symmetries
from chsel.problem.poses import compose, inverse, rotation_vector

CAMERA = np.array([[600.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
SIDES = np.array([0.1, 0.06, 0.2])
CORNERS = 0.5 * SIDES * (np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1.0)
TRUTH = compose(rotation_vector(np.array([0.4, -0.2, 0.9])), np.array([0.05, -0.02, 0.8]))
IDENTITY = np.eye(4)[None]


def errors(estimates, symmetries=IDENTITY, truth=TRUTH, vertices=CORNERS):
    return bop_errors(estimates, truth, vertices=vertices, symmetries=symmetries, camera=CAMERA)


def turned(angle):
    """The true pose after a turn about the object's z axis."""
    return TRUTH @ compose(rotation_vector(np.array([0.0, 0.0, angle])), np.zeros(3))


def test_a_shift_costs_its_length_and_a_turn_the_chord_of_the_farthest_corner():
    shift = compose(np.eye(3), np.array([0.003, 0.004, 0.0]))
    found = errors(np.stack([TRUTH, shift @ TRUTH, turned(0.5)]))
    radius = 0.5 * np.hypot(SIDES[0], SIDES[1])
    np.testing.assert_allclose(found.surface, [0.0, 0.005, 2 * radius * np.sin(0.25)], atol=1e-12)
    there = CORNERS @ TRUTH[:3, :3].T + TRUTH[:3, 3]
    nearest = there[:, 2].min()
    assert found.projection[0] == 0.0
    assert found.projection[1] == pytest.approx(np.hypot(600 * 0.003, 500 * 0.004) / nearest)


def test_a_declared_half_turn_and_only_that_is_no_error():
    half = compose(np.diag([-1.0, -1.0, 1.0]), np.array([0.002, 0.0, 0.0]))
    millimetres = half.copy()
    millimetres[:3, 3] *= 1000.0
    symmetries = declared_symmetries({"symmetries_discrete": [millimetres.ravel().tolist()]})
    assert symmetries.shape == (2, 4, 4)
    estimates = np.stack([TRUTH @ half, turned(np.pi / 2)])
    found = errors(estimates, symmetries)
    np.testing.assert_allclose(found.surface[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(found.projection[0], 0.0, atol=1e-9)
    assert found.surface[1] > 0.05


def test_a_can_may_turn_about_its_declared_axis():
    """Off by at most half a step of 2 pi / 315, of which a vertex moves by a chord."""
    info = {"symmetries_continuous": [{"axis": [0, 0, 2], "offset": [10, 0, 0]}]}
    symmetries = declared_symmetries(info)
    assert len(symmetries) == 315  # ceil(pi / 0.01)
    about = compose(np.eye(3), np.array([0.01, 0.0, 0.0]))
    angles = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, 20)
    turns = compose(rotation_vector(np.outer(angles, [0.0, 0.0, 1.0])), np.zeros((20, 3)))
    found = errors(TRUTH @ about @ turns @ inverse(about), symmetries)
    radius = np.hypot(CORNERS[:, 0] - 0.01, CORNERS[:, 1]).max()
    assert found.surface.max() <= 2.0 * radius * np.sin(0.5 * np.pi / 315) + 1e-12
    both = {**info, "symmetries_discrete": [np.diag([1.0, -1, -1, 1]).ravel().tolist()]}
    assert len(declared_symmetries(both)) == 630


def test_what_is_behind_the_camera_has_no_projection():
    behind = TRUTH.copy()
    behind[2, 3] = -0.8
    found = errors(behind[None])
    assert found.projection[0] == np.inf
    assert found.surface[0] == pytest.approx(1.6)


@pytest.mark.parametrize(
    "info",
    [
        {"symmetries_discrete": [[1, 2, 3]]},
        {"symmetries_continuous": [{"axis": [0, 0, 1]}]},
        {"symmetries_continuous": 3},
        {"symmetries_continuous": [{"axis": [0, 0, 0], "offset": [0, 0, 0]}]},
    ],
)
def test_symmetries_that_cannot_be_read_are_one_line(info):
    with pytest.raises(SettingError, match="symmetries"):
        declared_symmetries(info)
