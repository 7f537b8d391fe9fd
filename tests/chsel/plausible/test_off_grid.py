"""Modes that the grid passes by, on a ball: three contacts leave it one place on either side."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from chsel.errors import SdfError, SettingError
from chsel.numerics.threads import threads
from chsel.plausible.evaluation_cost import EvaluationCost
from chsel.plausible.plausible_set import plausible_set, stepped
from chsel.plausible.plausible_settings import (
    EvaluationCostSettings,
    ModeSearchSettings,
    Offsets,
    PlausibleSettings,
    PoseGridSettings,
)
from chsel.problem.points import KnownPoints
from chsel.problem.poses import inverse
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.settings import build_settings
from chsel.problem.streams import StreamKey
from tests.chsel.plausible.scenes import WORKSPACE, ball
from tests.chsel.samples import random_poses

OTHER = np.array([0.0, 0.0, -0.16])  # where the ball may be as well
# The positions nearest to it are 8 mm off, along z.
NEAR = Offsets(((0.0, 0.0, 1),), ((0.0, 0.0, 1),), z=((-0.168, -0.168, 1), (0.0, 0.0, 1)))
FAR = replace(NEAR, z=((-0.19, -0.19, 1), (0.0, 0.0, 1)))
PLAIN = PlausibleSettings(
    epsilon=0.004,
    cost=EvaluationCostSettings(lookup="trilinear"),
    grid=PoseGridSettings(NEAR, rotations=40, upright=0, extra="none"),
    fill_to=20,
)
SEARCH = replace(PLAIN, modes=ModeSearchSettings(starts=30))


def touched_ball(free=None, seed=7):
    """A ball of radius 0.1 m around the origin, with three contacts 8 cm below its centre."""
    angles = np.arange(3) * (2.0 * np.pi / 3.0)
    ring = np.stack([0.06 * np.cos(angles), 0.06 * np.sin(angles), np.full(3, -0.08)], axis=1)
    points = KnownPoints(known=ring, free=np.zeros((0, 3)) if free is None else free)
    start = np.eye(4)[None]
    return RegistrationProblem(
        sdf=ball(),
        points=points,
        initial_set=start,
        workspace=WORKSPACE,
        free_resolution=0.03,
        key=StreamKey(seed, 2),
    )


def below(found):
    """The members (N, 4, 4) in the other mode."""
    return found.world_from_object[found.world_from_object[:, 2, 3] < -0.08]


def test_a_mode_between_the_poses_of_the_grid_is_found_and_filled():
    problem = touched_ball()
    truth = np.eye(4)
    plain, found = (plausible_set(problem, truth, settings=by) for by in (PLAIN, SEARCH))
    assert len(below(plain)) == 0
    members = below(found)
    assert len(members) >= 3
    np.testing.assert_allclose(members[:, :3, 3] - OTHER, 0.0, atol=0.012)
    costs = EvaluationCost(problem, PLAIN.cost).evaluate(inverse(found.world_from_object))
    np.testing.assert_array_equal(costs, found.cost)
    assert (found.cost < found.true_cost + PLAIN.epsilon).all()
    np.testing.assert_array_equal(found.index, plain.index)
    np.testing.assert_array_equal(found.truth, truth)
    # All of the grid are kept, as there is room, and what was added is said to be off the grid.
    on_grid = found.world_from_object[~found.local]
    np.testing.assert_array_equal(on_grid, plain.world_from_object[~plain.local])
    assert found.local[found.world_from_object[:, 2, 3] < -0.08].all()


def test_modes_are_far_from_all_members_and_from_each_other():
    """Two contacts leave the ball a circle of places, three of which are 8 mm from the grid's."""
    problem = touched_ball()
    truth = np.eye(4)
    contacts = KnownPoints(known=[[0.06, 0.0, -0.08], [-0.06, 0.0, -0.08]])
    offsets = replace(NEAR, y=((-0.088, 0.088, 3),), z=((-0.168, -0.08, 2), (0.0, 0.0, 1)))
    by = replace(SEARCH, grid=replace(SEARCH.grid, offsets=offsets), fill_to=0)
    found = plausible_set(replace(problem, points=contacts), truth, settings=by)
    places = found.world_from_object[found.local, :3, 3]
    assert len(places) >= 3
    drawn = np.random.default_rng(0).normal(size=(4000, 3))
    surface = 0.1 * drawn / np.sqrt((drawn**2).sum(axis=1))[:, None]
    for n, place in enumerate(places):
        others = np.concatenate([np.delete(places, n, axis=0), truth[None, :3, 3]])
        moved = surface + place - others[:, None]
        apart = np.sqrt((moved**2).sum(axis=2)) - 0.1
        assert np.sqrt((apart**2).mean(axis=1)).min() > 0.9 * 0.01  # the separation


def test_steps_move_poses_and_turn_them_about_their_origins():
    stream = np.random.default_rng(1)
    poses, shifts, turns = random_poses(stream, 20, reach=2.0), *stream.normal(size=(2, 20, 3))
    turns[7] = 0.0
    found = stepped(poses, shifts, turns=turns)
    expected = Rotation.from_rotvec(turns) * Rotation.from_matrix(poses[:, :3, :3])
    np.testing.assert_allclose(found[:, :3, :3], expected.as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(found[:, :3, 3], poses[:, :3, 3] + shifts)


def test_a_mode_that_is_ruled_out_is_not_found():
    """By one free point in it; or as it is farther outside of the grid than the separation."""
    seen_through = touched_ball(free=OTHER[None])
    assert len(below(plausible_set(seen_through, np.eye(4), settings=SEARCH))) == 0
    above = replace(SEARCH, grid=replace(SEARCH.grid, offsets=replace(NEAR, z=((-0.145, 0.0, 2),))))
    reached = replace(above, modes=ModeSearchSettings(30, distance=0.015, separation=0.02))
    assert len(below(plausible_set(touched_ball(), np.eye(4), settings=reached))) > 0
    outside = replace(above, modes=ModeSearchSettings(30, distance=0.015, separation=0.005))
    assert len(below(plausible_set(touched_ball(), np.eye(4), settings=outside))) == 0


def test_without_a_pose_to_climb_from_nothing_changes():
    by = replace(SEARCH, grid=replace(SEARCH.grid, offsets=FAR))
    plain = replace(by, modes=None)
    problem = touched_ball()
    truth = np.eye(4)
    truth[0, 3] = 0.001  # no pose of the grid is the true one
    found, other = (plausible_set(problem, truth, settings=one) for one in (by, plain))
    assert found.digest == other.digest


def test_points_that_its_neighbours_violate_do_not_hide_a_mode():
    """A layer of free points around the other ball: the pose 8 mm off it is in some of them."""
    away = np.random.default_rng(0).normal(size=(300, 3))
    layer = OTHER + 0.105 * away / np.sqrt((away**2).sum(axis=1))[:, None]
    problem = touched_ball(free=layer[np.sqrt((layer**2).sum(axis=1)) > 0.12])
    strict = replace(SEARCH, cost=replace(PLAIN.cost, tolerance=0.0))
    poses = np.stack([np.eye(4)] * 3)
    poses[:, 2, 3] = 0.0, OTHER[2], NEAR.z[0][0]
    costs = EvaluationCost(problem, strict.cost).evaluate(inverse(poses))
    assert (costs[:2] < PLAIN.epsilon).all()
    assert costs[2] > 10.0 * strict.cost.violation / len(problem.points.free)
    assert len(below(plausible_set(problem, np.eye(4), settings=strict))) > 0
    shallow = replace(strict, modes=ModeSearchSettings(30, depth=1e-6))
    assert len(below(plausible_set(problem, np.eye(4), settings=shallow))) == 0


def test_the_search_depends_on_the_problem_and_the_seed_alone():
    alone = plausible_set(touched_ball(), np.eye(4), settings=SEARCH)
    with threads(2):
        assert plausible_set(touched_ball(), np.eye(4), settings=SEARCH).digest == alone.digest
    assert plausible_set(touched_ball(seed=8), np.eye(4), settings=SEARCH).digest != alone.digest


def test_modes_take_the_places_of_others_where_there_are_too_many():
    """All 40 rotations of a ball are members; 10 are kept."""
    few = replace(SEARCH, members=10, fill_to=10)
    found = plausible_set(touched_ball(), np.eye(4), settings=few)
    assert len(found.index) == 40
    assert len(found.cost) == 10
    assert len(below(found)) == found.local.sum() > 0
    np.testing.assert_array_equal(found.truth, np.eye(4))


def test_an_object_without_a_surface_is_one_clear_error():
    """All of the grid is outside, and the points are known to be, too."""
    problem = touched_ball()
    sdf, known = problem.sdf, problem.points.known
    lifted = SdfGrid(sdf.origin, sdf.resolution, values=sdf.values + 0.15, gradients=sdf.gradients)
    points = KnownPoints(known=known, known_sdf=np.full(len(known), 0.15))
    with pytest.raises(SdfError, match="no node"):
        plausible_set(replace(problem, sdf=lifted, points=points), np.eye(4), settings=SEARCH)


def test_a_setting_that_cannot_be_is_named():
    with pytest.raises(SettingError, match=r"definition\.modes: starts is 0"):
        build_settings(PlausibleSettings, {"modes": {"starts": 0}}, where="definition")
