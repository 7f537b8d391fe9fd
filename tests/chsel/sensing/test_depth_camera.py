"""The pinhole camera, by hand; pixels that count, and edges where depth jumps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from chsel.errors import PointsError, SettingError
from chsel.sensing.depth_camera import PinholeCamera, occlusion_edges, valid_pixels

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


def test_only_depths_within_the_range_are_valid() -> None:
    depth = np.array([0.0, -1.0, np.nan, np.inf, -np.inf, 0.19, 0.2, 1.0, 5.0, 5.1])
    valid = valid_pixels(depth, nearest=0.2, furthest=5.0)
    assert valid.tolist() == [False] * 6 + [True] * 3 + [False]
    assert not valid_pixels(np.array([0.0, np.inf]), nearest=0.0, furthest=np.inf).any()


def test_edges_are_both_sides_of_every_jump_between_valid_neighbours() -> None:
    stream = np.random.default_rng(0)
    depth = np.where(stream.random((12, 15)) < 0.1, 1.0, 0.5) + stream.uniform(0.0, 0.02, (12, 15))
    depth[stream.random(depth.shape) < 0.2] = np.nan
    valid = np.isfinite(depth) & (stream.random(depth.shape) < 0.9)
    edges = occlusion_edges(depth, valid, 0.05)
    assert 0 < edges.sum() < valid.sum()
    for row, column in np.ndindex(depth.shape):
        around = np.s_[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        jumps = np.abs(depth[around] - depth[row, column])[valid[around]]
        expected = valid[row, column] and bool((jumps > 0.05).any())
        assert edges[row, column] == expected


def test_a_slope_is_no_edge() -> None:
    depth = np.tile(np.linspace(0.5, 1.5, 50), (20, 1))
    assert not occlusion_edges(depth, np.ones(depth.shape, bool), 0.05).any()


def test_a_longer_reach_looks_across_a_gap() -> None:
    depth = np.full((5, 9), 0.5)
    depth[:, 5:] = 1.0
    valid = np.ones(depth.shape, dtype=bool)
    valid[:, 4] = False
    assert not occlusion_edges(depth, valid, 0.05).any()
    across = occlusion_edges(depth, valid, 0.05, reach=2)
    np.testing.assert_array_equal(np.flatnonzero(across.any(axis=0)), [3, 5])


@pytest.mark.parametrize(("shape", "reach"), [((40, 57), 5), ((40, 57), 2), ((3, 4), 9)])
def test_edges_are_those_of_the_filters_of_scipy(shape: tuple[int, int], reach: int) -> None:
    stream = np.random.default_rng(reach)
    depth, valid = stream.random(shape), stream.random(shape) < 0.8
    depth[~valid] = np.nan
    nearest = minimum_filter(np.where(valid, depth, np.inf), 2 * reach + 1, mode="nearest")
    furthest = maximum_filter(np.where(valid, depth, -np.inf), 2 * reach + 1, mode="nearest")
    jumps = np.maximum(furthest - depth, depth - nearest)
    limit = float(np.quantile(jumps[valid], 0.5))
    expected = valid & (jumps > limit)
    assert 0 < expected.sum() < valid.sum()
    np.testing.assert_array_equal(occlusion_edges(depth, valid, limit, reach=reach), expected)
