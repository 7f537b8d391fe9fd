"""Balls of free space against brute force on small grids."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chsel.errors import SettingError
from chsel.methods.medial_constraint import Balls, medial_balls
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.numerics.cell_set import squared_clearances
from chsel.problem.points import Workspace

SIDE = 0.025
ORIGIN = np.array([0.3, -0.2, 0.011])
WORKSPACE = Workspace((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))


def centres(voxels: IntArray) -> FloatArray:
    return ORIGIN + SIDE * voxels


def free_voxels(seed: int, share: float) -> BoolArray:
    """Voxels of a 12^3 grid within random balls, some left out."""
    random = np.random.default_rng(seed)
    places = np.indices((12, 12, 12)).reshape(3, -1).T
    middles, radii = random.uniform(0.0, 12.0, (5, 3)), random.uniform(1.0, 6.0, 5)
    apart = np.sqrt(((places[:, None] - middles[None]) ** 2).sum(axis=2))
    inside = (apart < radii).any(axis=1) & (random.random(len(places)) < share)
    return inside.reshape(12, 12, 12)


def clearance(free: BoolArray) -> FloatArray:
    """Distance of every free voxel's centre to the nearest cube that is not free, in metres."""
    around = np.pad(free, 1)
    apart = np.abs(np.argwhere(free)[:, None] + 1 - np.argwhere(~around)[None])
    squares = (np.maximum(apart - 0.5, 0.0) ** 2).sum(axis=2)
    return SIDE * np.sqrt(squares.min(axis=1))


def of_brute_force(free: BoolArray, inflation: float) -> Balls:
    """The largest medial ball that none of the chosen ones covers, again and again."""
    voxels, radii = np.argwhere(free), clearance(free)
    apart = SIDE * np.sqrt(((voxels[:, None] - voxels[None]) ** 2).sum(axis=2))
    neighbours = np.abs(voxels[:, None] - voxels[None]).max(axis=2) == 1
    held = neighbours & (apart + radii[:, None] <= radii[None] + 1e-3 * SIDE)
    left = np.flatnonzero(~held.any(axis=1))
    chosen: list[int] = []
    while len(left):
        best = left[np.argmax(np.round(radii[left], 12))]
        chosen.append(int(best))
        left = left[apart[best, left] + radii[left] > radii[best] + inflation + 1e-12]
    return Balls(centres(voxels[chosen]), radii[chosen])


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    share=st.sampled_from([0.5, 0.95, 1.0]),
    inflation=st.sampled_from([0.0, 0.0213, 0.0413, 0.1037]),  # no sums of sides: these may tie
)
def test_balls_are_those_of_brute_force(seed: int, share: float, inflation: float) -> None:
    free = free_voxels(seed, share)
    if not free.any():
        return
    found = medial_balls(centres(np.argwhere(free)), WORKSPACE, SIDE, inflation)
    expected = of_brute_force(free, inflation)
    np.testing.assert_allclose(found.centres, expected.centres, atol=1e-12)
    np.testing.assert_allclose(found.radii, expected.radii, rtol=1e-12)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), inflation=st.sampled_from([0.0, 0.02, 0.06]))
def test_balls_lie_within_free_cubes_and_cover_them_but_for_inflation(
    seed: int, inflation: float
) -> None:
    free = free_voxels(seed, 0.98)
    if not free.any():
        return
    balls = medial_balls(centres(np.argwhere(free)), WORKSPACE, SIDE, inflation)
    blocked = centres(np.argwhere(~np.pad(free, 1)) - 1)
    sideways = np.maximum(np.abs(balls.centres[:, None] - blocked[None]) - SIDE / 2.0, 0.0)
    gaps = np.sqrt((sideways**2).sum(axis=2)).min(axis=1)
    np.testing.assert_allclose(gaps, balls.radii, rtol=1e-9)
    voxels = centres(np.argwhere(free))
    apart = np.sqrt(((voxels[:, None] - balls.centres[None]) ** 2).sum(axis=2))
    outside = (apart - balls.radii[None]).min(axis=1)
    # What a ball covers is within its inflated self, centres by their own radius at least; the
    # medial tolerance adds up along a way of a dozen voxels.
    assert outside.max() <= inflation - SIDE / 2.0 + 0.02 * SIDE


def test_one_cube_of_free_space_is_one_ball() -> None:
    voxels = np.argwhere(np.ones((5, 5, 5), dtype=bool))
    balls = medial_balls(centres(voxels), WORKSPACE, SIDE, 0.1)
    np.testing.assert_allclose(balls.centres, [centres(np.array([2, 2, 2]))])
    np.testing.assert_allclose(balls.radii, [2.5 * SIDE])


def test_the_order_of_points_and_points_off_the_lattice_change_nothing() -> None:
    random = np.random.default_rng(0)
    points = centres(np.argwhere(free_voxels(0, 1.0)))
    expected = medial_balls(points, WORKSPACE, SIDE, 0.02)
    lowest = points.min(axis=0)
    corners = [points[points[:, axis] == lowest[axis]][:1] for axis in range(3)]
    shifted = points + random.uniform(-0.3 * SIDE, 0.3 * SIDE, points.shape)
    scattered = np.concatenate([np.maximum(shifted, lowest), *corners])
    for others in (points[random.permutation(len(points))], scattered):
        found = medial_balls(others, WORKSPACE, SIDE, 0.02)
        np.testing.assert_array_equal(found.centres, expected.centres)
        np.testing.assert_array_equal(found.radii, expected.radii)


def test_what_is_beyond_the_workspace_is_not_free() -> None:
    voxels = np.argwhere(np.ones((9, 5, 5), dtype=bool))
    half = Workspace(tuple(ORIGIN - 0.1 * SIDE), tuple(ORIGIN + SIDE * np.array([4.0, 9.0, 9.0])))
    found = medial_balls(centres(voxels), half, SIDE, 0.02)
    expected = medial_balls(centres(voxels[voxels[:, 0] <= 4]), WORKSPACE, SIDE, 0.02)
    np.testing.assert_array_equal(found.centres, expected.centres)
    far = Workspace((3.0, 3.0, 3.0), (4.0, 4.0, 4.0))
    assert len(medial_balls(centres(voxels), far, SIDE, 0.02)) == 0
    assert len(medial_balls(np.zeros((0, 3)), WORKSPACE, SIDE, 0.02)) == 0


def test_points_over_too_many_voxels_are_an_error_that_says_so() -> None:
    points = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    with pytest.raises(SettingError, match=r"span 1\.0e\+09 voxels of 0\.001 m; accepted"):
        medial_balls(points, WORKSPACE, 0.001, 0.02)


def clearances(inside: BoolArray) -> IntArray:
    squared = np.full(inside.shape, -7, dtype=np.int64)
    squared_clearances(inside, squared, 1)
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
