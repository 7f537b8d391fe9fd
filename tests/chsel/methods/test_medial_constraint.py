"""Medial Constraint: balls against brute force, costs against their equation, and the methods."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chsel.cost.objective import costs_of
from chsel.errors import SettingError
from chsel.methods import preset_settings
from chsel.methods.medial_constraint import (
    Balls,
    CmaEsSettings,
    MedialConstraint,
    MedialConstraintCmaMe,
    MedialCost,
    MedialCostSettings,
    medial_balls,
)
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import Poses, apply, compose
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import LOOKUPS, OUTSIDE
from chsel.problem.streams import StreamKey
from tests.chsel.methods.scene import posed
from tests.chsel.samples import ball_grid, random_poses

SIDE = 0.025
ORIGIN = np.array([0.3, -0.2, 0.011])
WORKSPACE = Workspace((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))


def centres(voxels):
    return ORIGIN + SIDE * voxels


def free_voxels(seed, share):
    """Voxels of a 12^3 grid within random balls, some left out."""
    random = np.random.default_rng(seed)
    places = np.indices((12, 12, 12)).reshape(3, -1).T
    middles = random.uniform(0.0, 12.0, (5, 3))
    radii = random.uniform(1.0, 6.0, 5)
    apart = np.sqrt(((places[:, None] - middles[None]) ** 2).sum(axis=2))
    inside = (apart < radii).any(axis=1) & (random.random(len(places)) < share)
    return inside.reshape(12, 12, 12)


def clearance(free):
    """Distance of every free voxel's centre to the nearest cube that is not free, in metres."""
    around = np.pad(free, 1)
    apart = np.abs(np.argwhere(free)[:, None] + 1 - np.argwhere(~around)[None])
    squares = (np.maximum(apart - 0.5, 0.0) ** 2).sum(axis=2)
    return SIDE * np.sqrt(squares.min(axis=1))


def of_brute_force(free, inflation):
    """The largest medial ball that none of the chosen ones covers, again and again."""
    voxels = np.argwhere(free)
    radii = clearance(free)
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
def test_balls_are_those_of_brute_force(seed, share, inflation):
    free = free_voxels(seed, share)
    if not free.any():
        return
    found = medial_balls(
        centres(np.argwhere(free)), WORKSPACE, resolution=SIDE, inflation=inflation
    )
    expected = of_brute_force(free, inflation)
    np.testing.assert_allclose(found.centres, expected.centres, atol=1e-12)
    np.testing.assert_allclose(found.radii, expected.radii, rtol=1e-12)


def test_the_order_of_points_and_points_off_the_lattice_change_nothing():
    random = np.random.default_rng(0)
    points = centres(np.argwhere(free_voxels(0, 1.0)))
    expected = medial_balls(points, WORKSPACE, resolution=SIDE, inflation=0.02)
    lowest = points.min(axis=0)
    corners = [points[points[:, axis] == lowest[axis]][:1] for axis in range(3)]
    shifted = points + random.uniform(-0.3 * SIDE, 0.3 * SIDE, points.shape)
    scattered = np.concatenate([np.maximum(shifted, lowest), *corners])
    for others in (points[random.permutation(len(points))], scattered):
        found = medial_balls(others, WORKSPACE, resolution=SIDE, inflation=0.02)
        np.testing.assert_array_equal(found.centres, expected.centres)
        np.testing.assert_array_equal(found.radii, expected.radii)


def test_what_is_beyond_the_workspace_is_not_free():
    voxels = np.argwhere(np.ones((9, 5, 5), dtype=bool))
    half = Workspace(tuple(ORIGIN - 0.1 * SIDE), tuple(ORIGIN + SIDE * np.array([4.0, 9.0, 9.0])))
    found = medial_balls(centres(voxels), half, resolution=SIDE, inflation=0.02)
    expected = medial_balls(
        centres(voxels[voxels[:, 0] <= 4]), WORKSPACE, resolution=SIDE, inflation=0.02
    )
    np.testing.assert_array_equal(found.centres, expected.centres)
    far = Workspace((3.0, 3.0, 3.0), (4.0, 4.0, 4.0))
    for points, where in ((centres(voxels), far), (np.zeros((0, 3)), WORKSPACE)):
        assert len(medial_balls(points, where, resolution=SIDE, inflation=0.02).radii) == 0


def test_points_over_too_many_voxels_are_an_error_that_says_so():
    points = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    with pytest.raises(SettingError, match=r"span 1\.0e\+09 voxels of 0\.001 m; accepted"):
        medial_balls(points, WORKSPACE, resolution=0.001, inflation=0.02)


RADIUS = 0.1
IDENTITY = Poses.of(np.eye(4)[None])


GRID = ball_grid(RADIUS, 0.01, half=15)


def problem(points):
    workspace = Workspace((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    return RegistrationProblem(
        sdf=GRID,
        points=points,
        initial_set=IDENTITY.matrices,
        workspace=workspace,
        free_resolution=0.025,
        key=StreamKey(0, 0),
    )


def contacts(count=7):
    random = np.random.default_rng(1)
    return KnownPoints(known=random.uniform(-0.2, 0.2, (count, 3)))


def some_balls(count=40):
    random = np.random.default_rng(2)
    return Balls(random.uniform(-0.4, 0.4, (count, 3)), random.uniform(0.01, 0.3, count))


def poses(count=50):
    return random_poses(np.random.default_rng(3), count, reach=0.1)


def test_a_ball_of_1_m_around_the_centre_of_a_sphere_of_10_cm_costs_1_21():
    balls = Balls(np.zeros((1, 3)), np.ones(1))
    cost = MedialCost(problem(KnownPoints(known=[[RADIUS, 0.0, 0.0]])), balls=balls)
    np.testing.assert_allclose(cost.evaluate(IDENTITY), 1.21, rtol=1e-12)


def test_costs_are_means_of_squares_in_square_metres():
    points = KnownPoints(known=[[0.13, 0, 0], [0, 0.08, 0], [0, 0, 0.1]], known_sdf=[0, 0, -0.01])
    balls = Balls(np.array([[0.0, 0.12, 0.0], [0.0, 0.0, 0.9]]), np.array([0.05, 0.05]))
    ball_mean = 0.03**2 / 2.0  # the second is beyond the grid and misses
    known_mean = (0.03**2 + 0.02**2 + 0.01**2) / 3.0
    cost = MedialCost(problem(points), balls=balls)
    np.testing.assert_allclose(cost.evaluate(IDENTITY), ball_mean + known_mean, rtol=1e-9)
    scales = MedialCostSettings(ball_scale=2.0, known_scale=3.0)
    scaled = MedialCost(problem(points), scales, balls=balls).evaluate(IDENTITY)
    np.testing.assert_allclose(scaled, 2.0 * ball_mean + 3.0 * known_mean, rtol=1e-9)


def test_a_missing_set_costs_nothing():
    alone = MedialCost(problem(KnownPoints(occupied=np.zeros((1, 3)))))
    np.testing.assert_array_equal(alone.evaluate(Poses.of(poses())), 0.0)
    no_balls = MedialCost(problem(contacts()), MedialCostSettings(known_scale=0.0))
    np.testing.assert_array_equal(no_balls.evaluate(Poses.of(poses())), 0.0)


@pytest.mark.parametrize("outside", OUTSIDE)
@pytest.mark.parametrize("lookup", LOOKUPS)
def test_costs_are_those_of_the_equation(lookup, outside):
    balls, points = some_balls(), contacts()
    cost = MedialCost(
        problem(points), MedialCostSettings(lookup=lookup, outside=outside), balls=balls
    )

    def distances(of):
        moved = apply(poses(), of)
        s, _ = GRID.at(moved.reshape(-1, 3), lookup=lookup, outside=outside)
        return s.reshape(moved.shape[:2])

    depth = np.maximum(balls.radii - distances(balls.centres), 0.0)
    expected = (depth**2).mean(axis=1) + (distances(points.known) ** 2).mean(axis=1)
    assert (depth > 0.0).any()
    assert (depth == 0.0).any()
    np.testing.assert_allclose(cost.evaluate(Poses.of(poses())), expected, rtol=1e-9)


@numba.njit
def search(model, space, vectors, costs, work):
    costs_of(model, space, vectors, costs, work)


@pytest.mark.parametrize("lookup", LOOKUPS)
def test_searches_go_by_the_same_costs(lookup):
    for balls in (some_balls(), Balls(np.zeros((0, 3)), np.zeros(0))):
        cost = MedialCost(problem(contacts()), MedialCostSettings(lookup=lookup), balls=balls)
        vectors = cost.space.encode(Poses.of(poses(80)))
        vectors[-2:, 8] = 40.0, np.nan  # far away, and not finite
        found = np.empty(len(vectors))
        search(cost.model, cost.space_arrays, vectors, found, cost.work())
        np.testing.assert_array_equal(np.isinf(found), np.arange(80) == 79)
        np.testing.assert_allclose(found, cost.costs(vectors), rtol=1e-12)


def test_the_true_pose_among_balls_of_its_own_free_space_costs_almost_nothing():
    lattice = 0.025 * np.indices((21, 21, 21)).reshape(3, -1).T - 0.25
    free = lattice[np.sqrt((lattice**2).sum(axis=1)) > RADIUS + 0.025]
    cost = MedialCost(problem(KnownPoints(free=free, known=[[RADIUS, 0.0, 0.0]])))
    assert len(cost.balls.radii) > 100
    away = compose(np.eye(3)[None], np.array([[0.05, 0.0, 0.0]]))
    assert cost.evaluate(IDENTITY)[0] < 1e-7
    assert cost.evaluate(Poses.of(away))[0] > 1e-4


def plain(generations):
    cma_es = CmaEsSettings(generations=generations)
    return MedialConstraint(replace(preset_settings("medial_constraint"), cma_es=cma_es))


def test_the_search_only_lowers_the_best_cost_of_cma_es():
    settings = preset_settings("medial_constraint_cma_me")
    method = MedialConstraintCmaMe(
        replace(settings, cma_es=replace(settings.cma_es, generations=12))
    )
    problem = posed(method)
    before = plain(12).register(problem).cost[0]
    assert method.register(problem).cost[0] <= before * (1.0 + 1e-9)
