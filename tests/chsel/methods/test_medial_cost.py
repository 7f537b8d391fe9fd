"""The compiled Medial Constraint cost against its equation."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from chsel.cost.objective import costs_of
from chsel.methods.medial_constraint import Balls, MedialCost, MedialCostSettings
from chsel.numerics.arrays import FloatArray
from chsel.numerics.threads import threads
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import Poses, apply, compose
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import LOOKUPS, OUTSIDE
from chsel.problem.streams import StreamKey
from tests.chsel.samples import ball_grid, random_poses

RADIUS = 0.1
IDENTITY = Poses.of(np.eye(4)[None])


GRID = ball_grid(RADIUS, 0.01, 15)


def problem(points: KnownPoints) -> RegistrationProblem:
    workspace = Workspace((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    return RegistrationProblem(GRID, points, IDENTITY.matrices, workspace, 0.025, StreamKey(0, 0))


def contacts(count: int = 7) -> KnownPoints:
    random = np.random.default_rng(1)
    return KnownPoints(known=random.uniform(-0.2, 0.2, (count, 3)))


def some_balls(count: int = 40) -> Balls:
    random = np.random.default_rng(2)
    return Balls(random.uniform(-0.4, 0.4, (count, 3)), random.uniform(0.01, 0.3, count))


def poses(count: int = 50) -> FloatArray:
    return random_poses(np.random.default_rng(3), count, 0.1)


def test_a_ball_of_1_m_around_the_centre_of_a_sphere_of_10_cm_costs_1_21() -> None:
    balls = Balls(np.zeros((1, 3)), np.ones(1))
    cost = MedialCost(problem(KnownPoints(known=[[RADIUS, 0.0, 0.0]])), balls=balls)
    np.testing.assert_allclose(cost.evaluate(IDENTITY), 1.21, rtol=1e-12)


def test_costs_are_means_of_squares_in_square_metres() -> None:
    points = KnownPoints(known=[[0.13, 0, 0], [0, 0.08, 0], [0, 0, 0.1]], known_sdf=[0, 0, -0.01])
    balls = Balls(np.array([[0.0, 0.12, 0.0], [0.0, 0.0, 0.9]]), np.array([0.05, 0.05]))
    ball_mean = 0.03**2 / 2.0  # the second is beyond the grid and misses
    known_mean = (0.03**2 + 0.02**2 + 0.01**2) / 3.0
    cost = MedialCost(problem(points), balls=balls)
    np.testing.assert_allclose(cost.evaluate(IDENTITY), ball_mean + known_mean, rtol=1e-9)
    scaled = MedialCost(problem(points), MedialCostSettings(known_scale=3.0), balls=balls)
    np.testing.assert_allclose(scaled.evaluate(IDENTITY), ball_mean + 3.0 * known_mean, rtol=1e-9)


def test_a_missing_set_costs_nothing() -> None:
    alone = MedialCost(problem(KnownPoints(occupied=np.zeros((1, 3)))))
    np.testing.assert_array_equal(alone.evaluate(Poses.of(poses())), 0.0)
    no_balls = MedialCost(problem(contacts()), MedialCostSettings(known_scale=0.0))
    np.testing.assert_array_equal(no_balls.evaluate(Poses.of(poses())), 0.0)


@pytest.mark.parametrize("outside", OUTSIDE)
@pytest.mark.parametrize("lookup", LOOKUPS)
def test_costs_are_those_of_the_equation(lookup: str, outside: str) -> None:
    balls, points = some_balls(), contacts()
    cost = MedialCost(
        problem(points), MedialCostSettings(lookup=lookup, outside=outside), balls=balls
    )

    def distances(of: FloatArray) -> FloatArray:
        moved = apply(poses(), of)
        s, _ = GRID.at(moved.reshape(-1, 3), lookup=lookup, outside=outside)
        return s.reshape(moved.shape[:2])

    depth = np.maximum(balls.radii - distances(balls.centres), 0.0)
    expected = (depth**2).mean(axis=1) + (distances(points.known) ** 2).mean(axis=1)
    assert (depth > 0.0).any()
    assert (depth == 0.0).any()
    np.testing.assert_allclose(cost.evaluate(Poses.of(poses())), expected, rtol=1e-9)


@numba.njit
def search(model, space, vectors, costs, work):  # type: ignore[no-untyped-def]
    costs_of(model, space, vectors, costs, work)


@pytest.mark.parametrize("lookup", LOOKUPS)
def test_searches_go_by_the_same_costs(lookup: str) -> None:
    for balls in (some_balls(), Balls(np.zeros((0, 3)), np.zeros(0))):
        cost = MedialCost(problem(contacts()), MedialCostSettings(lookup=lookup), balls=balls)
        vectors = cost.space.encode(Poses.of(poses(80)))
        vectors[-2:, 8] = 40.0, np.nan  # far away, and not finite
        found = np.empty(len(vectors))
        search(cost.model, cost.space_arrays, vectors, found, cost.work())
        np.testing.assert_array_equal(np.isinf(found), np.arange(80) == 79)
        np.testing.assert_allclose(found, cost.costs(vectors), rtol=1e-12)


def test_the_true_pose_among_balls_of_its_own_free_space_costs_almost_nothing() -> None:
    lattice = 0.025 * np.indices((21, 21, 21)).reshape(3, -1).T - 0.25
    free = lattice[np.sqrt((lattice**2).sum(axis=1)) > RADIUS + 0.025]
    cost = MedialCost(problem(KnownPoints(free=free, known=[[RADIUS, 0.0, 0.0]])))
    assert len(cost.balls) > 100
    away = compose(np.eye(3)[None], np.array([[0.05, 0.0, 0.0]]))
    assert cost.evaluate(IDENTITY)[0] < 1e-7
    assert cost.evaluate(Poses.of(away))[0] > 1e-4
    ignored = MedialCost(cost_problem(free), MedialCostSettings(ball_scale=0.0))
    np.testing.assert_allclose(ignored.evaluate(Poses.of(away)), 0.05**2, rtol=1e-9)


def cost_problem(free: FloatArray) -> RegistrationProblem:
    return problem(KnownPoints(free=free, known=[[RADIUS, 0.0, 0.0]]))


def test_poses_that_are_not_finite_cost_infinitely_much() -> None:
    bad = poses(3)
    bad[0, 0, 3], bad[1, 1, 1] = np.inf, np.nan
    cost = MedialCost(problem(contacts()), balls=some_balls()).evaluate(Poses.of(bad))
    np.testing.assert_array_equal(np.isinf(cost), [True, True, False])


def test_costs_do_not_depend_on_threads_or_on_the_batch() -> None:
    cost = MedialCost(problem(contacts()), balls=some_balls())
    many = poses(700)
    together = cost.evaluate(Poses.of(many))
    with threads(2):
        np.testing.assert_array_equal(cost.evaluate(Poses.of(many)), together)
    np.testing.assert_array_equal(cost.evaluate(Poses.of(many[41:42])), together[41:42])
