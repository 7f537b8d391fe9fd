"""Clearances of voxels against the definition."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from chsel.methods.medial_constraint.medial_balls import squared_clearances
from chsel.numerics.arrays import BoolArray, IntArray


def clearances(inside: BoolArray) -> IntArray:
    squared = np.full(inside.shape, -7, dtype=np.int64)
    squared_clearances(inside, squared)
    return squared


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    shape=st.sampled_from([(12, 12, 12), (1, 9, 4), (7, 1, 1), (3, 16, 5)]),
    share=st.sampled_from([0.0, 0.5, 0.9, 0.99]),
)
def test_clearances_are_those_of_brute_force(
    seed: int, shape: tuple[int, int, int], share: float
) -> None:
    random = np.random.default_rng(seed)
    inside = random.random(shape) < share
    inside[tuple(random.integers(0, shape))] = False
    apart = np.abs(np.indices(shape).reshape(3, -1).T[:, None] - np.argwhere(~inside)[None])
    squares = (np.maximum(2 * apart - 1, 0) ** 2).sum(axis=2)
    np.testing.assert_array_equal(clearances(inside).reshape(-1), squares.min(axis=1))


def test_a_slab_is_half_as_wide_as_its_clearance_in_the_middle() -> None:
    inside = np.ones((11, 3, 3), dtype=bool)
    inside[[0, -1]] = False
    expected = [0, 1, 9, 25, 49, 81, 49, 25, 9, 1, 0]
    np.testing.assert_array_equal(clearances(inside)[:, 1, 1], expected)
