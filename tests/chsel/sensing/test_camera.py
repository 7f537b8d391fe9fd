"""The pinhole camera, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from chsel.errors import PointsError, SettingError
from chsel.sensing.depth_camera import PinholeCamera

CAMERA = PinholeCamera(4, 3, 2.0, 4.0, 1.0, 1.5)


def test_points_project_back_onto_their_pixels() -> None:
    depth = np.array([[1.0, 2.0, 3.0, 4.0], [0.5, 0.5, 0.5, 0.5], [1.0, 1.0, 1.0, 8.0]])
    points = CAMERA.back_project(depth)
    np.testing.assert_array_equal(points[2, 3], [8.0, 1.0, 8.0])
    u, v = 2.0 * points[..., 0] / points[..., 2] + 1.0, 4.0 * points[..., 1] / points[..., 2] + 1.5
    np.testing.assert_allclose(u, np.tile([0.0, 1.0, 2.0, 3.0], (3, 1)), atol=1e-12)
    np.testing.assert_allclose(v, np.tile([[0.0], [1.0], [2.0]], (1, 4)), atol=1e-12)


def test_directions_are_points_at_depth_one() -> None:
    directions = CAMERA.directions()
    np.testing.assert_array_equal(directions[..., 2], 1.0)
    np.testing.assert_array_equal(directions[0, 3], [1.0, -0.375, 1.0])


def test_depths_that_are_no_numbers_give_no_points() -> None:
    depth = np.ones((3, 4))
    depth[0, 0], depth[1, 1] = np.nan, np.inf
    finite = np.isfinite(CAMERA.back_project(depth)).all(axis=-1)
    np.testing.assert_array_equal(finite, np.isfinite(depth))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((0, 3, 1.0, 1.0, 0.0, 0.0), "camera width is 0; accepted"),
        ((4, 3.5, 1.0, 1.0, 0.0, 0.0), "camera height is 3.5; accepted: a whole number"),
        ((4, 10**9, 1.0, 1.0, 0.0, 0.0), "camera height is 1000000000; accepted: at most 100_000"),
        ((4, 3, 0.0, 1.0, 0.0, 0.0), "camera fx is 0.0; accepted"),
        ((4, 3, 1.0, float("nan"), 0.0, 0.0), "camera fy is nan; accepted"),
        ((4, 3, 1.0, 1.0, float("inf"), 0.0), "camera cx is inf; accepted: a finite number"),
    ],
)
def test_what_no_camera_has_is_refused(values: tuple[float, ...], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        PinholeCamera(*values)  # type: ignore[arg-type]


def test_an_image_of_another_size_is_refused() -> None:
    with pytest.raises(PointsError, match=r"depth has shape \(4, 3\); accepted: \(3, 4\)"):
        CAMERA.back_project(np.ones((4, 3)))
