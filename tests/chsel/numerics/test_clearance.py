"""Distances between voxels, by their definition."""

from __future__ import annotations

import numpy as np
import pytest

from chsel.numerics.clearance import squared_clearances, squared_gaps


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 20, 70), (40, 2, 33), (21, 22, 32)])
@pytest.mark.parametrize("outside", [0, 1, 5, 400])
def test_distances_of_voxels_are_those_to_the_nearest_that_is_not_inside(
    shape: tuple[int, int, int], outside: int
) -> None:
    rng = np.random.default_rng(outside)
    inside = np.ones(shape, dtype=bool)
    inside.reshape(-1)[rng.permutation(inside.size)[:outside]] = False
    gaps, clearances = np.empty(shape, dtype=np.uint8), np.empty(shape, dtype=np.int64)
    squared_gaps(inside, gaps)
    squared_clearances(inside, clearances, 1)

    voxels, others = np.indices(shape).reshape(3, -1, 1), np.argwhere(~inside).T[:, None]
    steps = np.abs(voxels - others)
    between = (np.maximum(steps - 1, 0) ** 2).sum(axis=0).min(axis=1, initial=225)
    np.testing.assert_array_equal(gaps.reshape(-1), between)
    to_centre = (np.maximum(2 * steps - 1, 0) ** 2).sum(axis=0).min(axis=1, initial=2**60)
    np.testing.assert_array_equal(np.minimum(clearances.reshape(-1), 2**60), to_centre)
