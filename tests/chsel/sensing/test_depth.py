"""Pixels that count, and edges where depth jumps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from chsel.sensing.depth_camera import occlusion_edges, valid_pixels


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
