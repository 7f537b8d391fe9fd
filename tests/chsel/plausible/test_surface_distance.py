"""Distances between surfaces, plausible diversity and calibration, where the answer is known."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from chsel.errors import EvaluationError, PoseError, SettingError
from chsel.numerics.threads import threads
from chsel.plausible.pose_metrics import cheapest, plausible_diversity, true_pose_rank
from chsel.plausible.surface_distance import (
    METHODS,
    DistanceSettings,
    SurfaceDistance,
    surface_points,
)
from chsel.problem.poses import compose, inverse, random_rotations, rotation_vector
from chsel.problem.sdf_grid import SdfGrid, mesh_sdf
from chsel.problem.streams import StreamKey

RADIUS = 0.1
SIDES = np.array([0.08, 0.12, 0.2])


@pytest.fixture(scope="module")
def ball():
    """A ball of radius 0.1 m, round to 5e-6 m."""
    mesh = trimesh.creation.icosphere(5, RADIUS)
    return SdfGrid.from_mesh(mesh, 0.005), mesh


@pytest.fixture(scope="module")
def box():
    mesh = trimesh.creation.box(SIDES)
    return SdfGrid.from_mesh(mesh, 0.005), mesh


def distance_of(thing, count=200, **values):
    sdf, mesh = thing
    by = replace(DistanceSettings(), **values)
    return SurfaceDistance(
        sdf, mesh, points=surface_points(mesh, count, key=StreamKey(0, 0)), settings=by
    )


def poses(seed, count, *, spread=0.03, angle=0.3):
    stream = np.random.default_rng(seed)
    turns = rotation_vector(stream.normal(0.0, angle, (count, 3)))
    return compose(turns, stream.normal(0.0, spread, (count, 3)))


@pytest.mark.parametrize("method", METHODS)
def test_a_ball_may_turn_as_it_likes_and_a_shift_costs_a_third_of_its_square(ball, method):
    """For a shift t much less than the radius: | |r n + t| - r | = |n . t|, whose mean square
    over directions n is t^2 / 3.
    """
    distance = distance_of(ball, 4000, method=method)
    stream = np.random.default_rng(0)
    turned = compose(random_rotations(stream, 4), np.zeros((4, 3)))
    shifted = compose(
        random_rotations(stream, 3), np.array([[0.002, 0, 0], [0, 0.004, 0], [0] * 3])
    )
    found = distance.between(inverse(turned), shifted)
    grid_error = 0.02 if method == "grid" else 1e-3
    np.testing.assert_allclose(
        found, np.tile([4.0 / 3.0, 16.0 / 3.0, 0.0], (4, 1)), rtol=0.05, atol=grid_error
    )


@pytest.mark.parametrize("method", METHODS)
def test_a_box_shifted_along_a_side_costs_what_its_faces_move(box, method):
    """For a shift d: one end comes out by d; the other goes in by d, but is nearer to a side in
    a frame of width d; the sides slide along themselves, but for a strip beyond the edge.
    """
    shift, count = 0.01, 20_000
    a, b, c = SIDES
    ends = 2.0 * a * b * shift**2
    frame = 4.0 * (a + b) * shift**3 / 3.0 - 2.0 * shift**4
    strips = 2.0 * (a + b) * shift**3 / 3.0
    expected = 1e6 * (ends - frame + strips) / (2.0 * (a * b + b * c + c * a))
    moved = compose(np.eye(3)[None], np.array([[0.0, 0.0, shift]]))
    found = distance_of(box, count, method=method).between(np.eye(4)[None], moved)
    np.testing.assert_allclose(found, expected, rtol=0.03)


def test_methods_agree_where_the_metrics_look(box):
    estimates = inverse(poses(1, 12))
    members = poses(2, 25)
    exact = distance_of(box, method="exact").between(estimates, members)
    nearest = distance_of(box, method="nearest").between(estimates, members)
    grid = distance_of(box, method="grid").between(estimates, members)
    np.testing.assert_array_equal(nearest.min(axis=0), exact.min(axis=0))
    np.testing.assert_array_equal(nearest.min(axis=1), exact.min(axis=1))
    assert 0 < (nearest == exact).sum() < exact.size
    np.testing.assert_allclose(grid, exact, rtol=0.1, atol=1.0)
    points = surface_points(box[1], 200, key=StreamKey(0, 0))
    seen = (estimates[3] @ members[4])[:3]
    signed = mesh_sdf(box[1], points @ seen[:, :3].T + seen[:, 3])[0]
    assert exact[3, 4] == pytest.approx(1e6 * (signed**2).mean())


def test_coverage_and_plausibility_are_the_means_of_the_nearest():
    metrics = plausible_diversity(np.array([[1.0, 8.0, 3.0], [4.0, 5.0, 9.0]]))
    assert metrics.coverage == pytest.approx((1.0 + 5.0 + 3.0) / 3.0)
    assert metrics.plausibility == pytest.approx((1.0 + 4.0) / 2.0)
    assert metrics.diversity == pytest.approx(5.5)
    assert metrics.root == pytest.approx(5.5**0.5)


def test_precision_and_recall_count_poses_within_10_mm():
    """Of three hypotheses two are near a plausible pose; of four of these one is near none."""
    squares = np.array([[100.0, 900.0, 101.0, 4.0], [400.0, 0.0, 900.0, 900.0], [101.0] * 4])
    metrics = plausible_diversity(squares)
    assert metrics.precision == pytest.approx(2.0 / 3.0)
    assert metrics.recall == pytest.approx(3.0 / 4.0)


def test_threads_change_nothing(box):
    distance = distance_of(box)
    estimates = inverse(poses(11, 9))
    members = poses(12, 8)
    alone = distance.between(estimates, members)
    with threads(2):
        np.testing.assert_array_equal(distance.between(estimates, members), alone)


def test_surface_points_lie_on_the_surface_and_are_uniform_by_area(box):
    points = surface_points(box[1], 20_000, key=StreamKey(4, 0))
    assert np.abs(mesh_sdf(box[1], points)[0]).max() < 1e-12
    a, b, c = SIDES
    on_top = (points[:, 2] > c / 2.0 - 1e-9).mean()
    assert on_top == pytest.approx(a * b / (2.0 * (a * b + b * c + c * a)), abs=0.01)
    np.testing.assert_array_equal(points, surface_points(box[1], 20_000, key=StreamKey(4, 0)))
    assert (points != surface_points(box[1], 20_000, key=StreamKey(5, 0))).any()


def test_the_cheapest_share_of_hypotheses_is_told_by_cost():
    costs = np.array([4.0, 1.0, 3.0, 2.0])
    assert cheapest(costs, 0.5).tolist() == [False, True, True, True]
    assert cheapest(costs, 1.0).all()
    with pytest.raises(SettingError, match="quantile is 0"):
        cheapest(costs, 0.0)


def test_a_truth_far_from_all_hypotheses_is_outside_of_their_spread(box):
    estimates = inverse(poses(13, 30, spread=0.01, angle=0.1))
    distance = distance_of(box, method="exact")
    away = np.eye(4)
    assert true_pose_rank(distance, estimates, world_from_object=away) > 0.5
    away[0, 3] = 0.15
    assert true_pose_rank(distance, estimates, world_from_object=away) == pytest.approx(1.0 / 31.0)


def test_the_rank_of_a_truth_drawn_like_the_hypotheses_is_uniform(box):
    distance = distance_of(box, 30, method="grid")
    drawn = poses(14, 80 * 10, spread=0.02, angle=0.2).reshape(80, 10, 4, 4)
    ranks = [
        true_pose_rank(distance, inverse(some[1:]), world_from_object=some[0]) for some in drawn
    ]
    counts = np.bincount(np.rint(10.0 * np.array(ranks)).astype(int), minlength=11)[1:]
    assert counts.sum() == 80
    assert ((counts - 8.0) ** 2 / 8.0).sum() < 23.6  # chi square, 9 degrees, 0.5 %


def test_what_cannot_be_measured_is_named(box):
    broken = poses(0, 2)
    broken[1, 0, 3] = np.nan
    with pytest.raises(PoseError, match="pose 1 is not finite"):
        distance_of(box).between(broken, poses(0, 2))
    with pytest.raises(SettingError, match="method exact needs a mesh"):
        SurfaceDistance(
            box[0], None, points=np.zeros((1, 3)), settings=DistanceSettings(method="exact")
        )
    with pytest.raises(EvaluationError, match="the rank among 1 hypotheses"):
        true_pose_rank(distance_of(box), poses(0, 1), world_from_object=np.eye(4))
    with pytest.raises(EvaluationError, match="distances have shape"):
        plausible_diversity(np.zeros((0, 3)))
