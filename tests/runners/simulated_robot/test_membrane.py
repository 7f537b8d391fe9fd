"""The membrane: its shape untouched, and what gives way where."""

import numpy as np
import pytest

from runners.simulated_robot.cabinet import CAP, CAP_BASE
from runners.simulated_robot.pads import TAUTNESS, Membrane
from runners.simulated_robot.settings import BubbleSettings

CAMERA = BubbleSettings().pinhole
APEX = CAP_BASE + CAP[2]


@pytest.fixture(scope="module")
def membrane():
    return Membrane(CAMERA)


def test_the_untouched_membrane_is_half_an_ellipsoid(membrane):
    x, y = CAMERA.directions()[..., :2].transpose(2, 0, 1)
    points = np.stack([x * membrane.rest, y * membrane.rest, membrane.rest - CAP_BASE], axis=-1)
    soft = membrane.rest > CAP_BASE
    assert np.allclose(((points[soft] / CAP) ** 2).sum(axis=-1), 1.0, atol=1e-12)
    assert membrane.rest.max() == pytest.approx(APEX, abs=1e-6)
    beside = points[~soft]
    assert (((beside[:, :2] / CAP[:2]) ** 2).sum(axis=-1) >= 1.0 - 1e-12).all()
    assert 0.7 < soft.mean() < 0.8  # an ellipse in its rectangle: pi / 4


def test_a_plane_flattens_what_it_reaches(membrane):
    plane = APEX - 0.005
    depth = membrane.pressed(np.full(membrane.rest.shape, plane))
    reached = membrane.rest > plane
    deep = membrane.rest > plane + 0.002
    assert np.allclose(depth[deep], plane, atol=1e-12)
    # Where a taut sheet leaves a plane it does so without a kink, a little before the plane does.
    assert (depth[reached] <= plane + 1e-12).all()
    assert (depth[reached] > plane - 0.001).all()
    assert (depth <= membrane.rest).all()
    assert (depth[~reached] < membrane.rest[~reached]).any()


def test_no_object_goes_through_the_base(membrane):
    depth = membrane.pressed(np.full(membrane.rest.shape, 0.02))
    assert (depth >= np.minimum(membrane.rest, CAP_BASE)).all()
    assert (depth[membrane.rest <= CAP_BASE] == CAP_BASE).all()


@pytest.mark.parametrize("width", [224, 112])
def test_beside_a_straight_edge_the_dent_falls_as_that_of_a_taut_sheet(width):
    camera = BubbleSettings(width=width).pinhole
    wide = Membrane(camera)
    beyond = np.full(wide.rest.shape, 1.0)
    beyond[:, : width // 2] = wide.rest[:, : width // 2] - 0.004
    dent = (wide.rest - wide.pressed(beyond))[camera.height // 2]
    pitch = APEX / camera.fx
    away = round(TAUTNESS / pitch)
    edge = width // 2 - 1
    assert dent[edge] == pytest.approx(0.004, abs=1e-12)
    expected = 0.004 * np.exp(-away * pitch / TAUTNESS)
    assert dent[edge + away] == pytest.approx(expected, rel=0.05)
