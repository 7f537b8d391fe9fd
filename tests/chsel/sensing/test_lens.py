"""Lens distortion undone in depth images, where the scene is known."""

import numpy as np
import pytest

from chsel.errors import SettingError
from chsel.sensing.depth_camera import PinholeCamera
from chsel.sensing.lens import LensDistortion

CAMERA = PinholeCamera(160, 120, fx=120.0, fy=125.0, cx=78.0, cy=61.0)
LENSES = {
    "plumb_bob": LensDistortion("plumb_bob", (-0.28, 0.07, 0.001, -0.002, 0.01)),
    "rational": LensDistortion(
        "rational_polynomial", (0.4, -2.1, 0.0008, -0.0004, 1.3, 0.3, -1.9, 1.2)
    ),
    "prism": LensDistortion(
        "rational_polynomial", (0.1, 0, 0, 0, 0, 0, 0, 0, 0.01, 0.002, -0.02, 0.003)
    ),
    "fisheye": LensDistortion("equidistant", (-0.03, 0.01, 0.002, -0.001)),
}


def pinhole_rays(lens):
    """x and y (H, W) that the lens shows at each pixel's centre, by Newton's method."""
    wanted = np.stack(np.meshgrid(CAMERA.columns, CAMERA.rows))
    place = wanted.copy()
    for _ in range(50):
        here = np.stack(lens.distorted(*place))
        step = 1e-6
        along_x = (np.stack(lens.distorted(place[0] + step, place[1])) - here) / step
        along_y = (np.stack(lens.distorted(place[0], place[1] + step)) - here) / step
        a, c = along_x
        b, d = along_y
        off = here - wanted
        place -= np.stack([d * off[0] - b * off[1], a * off[1] - c * off[0]]) / (a * d - b * c)
    assert np.abs(np.stack(lens.distorted(*place)) - wanted).max() < 1e-12
    return place


def plane_depth(x, y):
    """Depth of the plane 0.4 x - 0.3 y + z = 0.6, metres."""
    return 0.6 / (0.4 * x - 0.3 * y + 1.0)


@pytest.mark.parametrize("name", LENSES)
def test_a_plane_is_flat_to_20_micrometres(name):
    lens = LENSES[name]
    seen = plane_depth(*pinhole_rays(lens))
    found = lens.undistorted(seen, CAMERA)
    measured = found > 0.0
    assert measured[20:100, 20:140].all()
    off = CAMERA.back_project(found) @ [0.4, -0.3, 1.0] - 0.6
    assert np.abs(off[measured]).max() < 2e-5
    as_pinhole = CAMERA.back_project(seen) @ [0.4, -0.3, 1.0] - 0.6
    assert np.abs(as_pinhole).max() > 1e-3


def test_depths_of_two_surfaces_are_not_mixed():
    seen = np.where(np.arange(160) < 80, 0.5, 0.9) * np.ones((120, 1))
    seen[:, 30] = 0.0
    found = LENSES["plumb_bob"].undistorted(seen, CAMERA)
    assert set(np.unique(np.round(found, 12))) == {0.0, 0.5, 0.9}
    seen[:, 30] = np.nan
    np.testing.assert_array_equal(found, LENSES["plumb_bob"].undistorted(seen, CAMERA))


def test_a_mask_moves_as_the_depths_do():
    lens = LENSES["plumb_bob"]
    mask = np.zeros((120, 160), dtype=bool)
    mask[30:80, 50:110] = True
    moved = lens.undistorted_mask(mask, CAMERA)
    depths = lens.undistorted(np.where(mask, 0.5, 0.9), CAMERA)
    assert (moved == (np.abs(depths - 0.5) < 1e-9)).mean() > 0.999
    assert moved.sum() > 1.04 * mask.sum()  # a barrel makes what is off the centre smaller


def test_the_model_is_that_of_opencv():
    """Term by term as its manual has it, at one place."""
    x, y = 0.3, -0.2
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = 0.1 + 0.01 * np.arange(12)
    r2 = x**2 + y**2
    factor = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x**2) + s1 * r2 + s2 * r2**2
    v = y * factor + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y + s3 * r2 + s4 * r2**2
    all_terms = tuple((0.1 + 0.01 * np.arange(12)).tolist())
    lens = LensDistortion("rational_polynomial", all_terms)
    np.testing.assert_allclose(lens.distorted(np.array(x), np.array(y)), [u, v], rtol=1e-15)
    angle = np.arctan(r2**0.5)
    moved = angle + 0.1 * angle**3 + 0.2 * angle**5 + 0.3 * angle**7 + 0.4 * angle**9
    fish = LensDistortion("fisheye", (0.1, 0.2, 0.3, 0.4))
    found = fish.distorted(np.array([x, 0.0]), np.array([y, 0.0]))
    np.testing.assert_allclose(found, np.outer([x, y], [moved / r2**0.5, 0.0]), rtol=1e-14)


def test_where_the_polynomial_turns_back_nothing_is_seen():
    """x - x^3 turns back at 0.58: what is further out would be shown a second time."""
    lens = LensDistortion("plumb_bob", (-1.0, 0.0, 0.0, 0.0))
    found = lens.undistorted(np.ones((120, 160)), CAMERA)
    x, y = np.meshgrid(CAMERA.columns, CAMERA.rows)
    radius = np.sqrt(x * x + y * y)
    assert (found[radius > 0.585] == 0.0).all()
    np.testing.assert_allclose(found[radius < 0.3], 1.0, rtol=1e-15)


@pytest.mark.parametrize(
    ("model", "coefficients", "message"),
    [
        (
            "",
            (0.1, 0, 0, 0, 0),
            "distortion model is '', accepted|distortion model is ''; accepted",
        ),
        ("plumb_bob", (0.1,), r"has coefficients \[0\.1\]; accepted: finite ones, 4 or 5 or 8"),
        ("plumb_bob", (np.nan, 0, 0, 0), "accepted: finite ones"),
        ("equidistant", (0.1, 0, 0, 0, 0), "accepted: finite ones, 4 of them"),
        ("rational_polynomial", (0,) * 12 + (0.1, 0), "tilted sensor"),
    ],
)
def test_a_model_that_is_not_known_is_one_line(model, coefficients, message):
    with pytest.raises(SettingError, match=message):
        LensDistortion(model, coefficients)
