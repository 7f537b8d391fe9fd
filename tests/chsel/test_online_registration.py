"""The loop of registrations: which problems follow from points and results."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from chsel import KnownPoints, OnlineRegistration, SdfGrid, Workspace, trust_in
from chsel.errors import ChselError, PoseError
from chsel.problem.online_registration import (
    OnlineSettings,
    Start,
    first_initial_set,
    updated_initial_set,
)
from chsel.problem.poses import axis_angle, compose, inverse, rotation_angle
from chsel.problem.streams import StreamKey
from tests.chsel.samples import hypotheses_at, pose_problem

GRID = SdfGrid.from_mesh(trimesh.creation.box((0.1, 0.06, 0.04)), 0.02)
WORKSPACE = Workspace((-0.1, -0.3, 0.0), (0.5, 0.3, 0.6))
SETTINGS = OnlineSettings(hypotheses=4)
PROBES = [KnownPoints(known=[[0.1 * step, 0.0, 0.1]]) for step in range(4)]
NOTHING = hypotheses_at(np.zeros((0, 4, 4)))


def session(**options):
    return OnlineRegistration(GRID, WORKSPACE, 0.01, SETTINGS, **options)


def starts_as_found(problem):
    """E_0 at ascending costs, the last pose first."""
    return hypotheses_at(problem.initial_set[::-1])


def test_every_problem_has_all_points_and_follows_from_the_result_before():
    points, previous = KnownPoints(free=[[0.3, 0.3, 0.3]]), None
    online = session(seed=7, points=points, sensor_noise=0.002)
    for step in online.steps(enumerate(PROBES), starts_as_found):
        points = points.merged(PROBES[step.step])
        key = StreamKey(7, step.step)
        expected = pose_problem(GRID, points, WORKSPACE, 0.01, key, SETTINGS, previous)
        assert step.problem.digest == expected.digest
        assert step.hypotheses is online.previous
        assert step.failure is None
        assert step.hypotheses.trust == trust_in(expected, starts_as_found(expected), 0.002)
        previous = step.hypotheses
    assert points.count == 5


@pytest.mark.parametrize(
    ("options", "registered"),
    [
        ({}, [0, 1, 2, 3]),
        ({"start": Start(contacts=2)}, [1, 2, 3]),
        ({"start": Start(step=3)}, [3]),
        ({"only": {0, 2}}, [0, 2]),
        ({"start": Start(contacts=3), "only": {0, 2}}, [2]),
    ],
)
def test_steps_before_the_start_and_those_not_chosen_register_nothing(options, registered):
    steps = list(session(**options).steps(enumerate(PROBES), starts_as_found))
    assert [step.step for step in steps] == [0, 1, 2, 3]
    assert [step.step for step in steps if step.problem is not None] == registered
    assert [step.step for step in steps if step.hypotheses is not None] == registered
    last = registered[-1]
    assert steps[last].problem.points.count == last + 1  # those of skipped steps, too


def test_nothing_is_registered_while_no_point_is_known():
    steps = session().steps(enumerate([KnownPoints(), PROBES[1]]), starts_as_found)
    assert [step.problem is not None for step in steps] == [False, True]


def test_an_error_ends_the_loop_unless_it_is_caught_and_the_last_result_is_followed():
    error = ChselError("nothing")

    def fails_at_1(problem):
        if problem.key.step == 1:
            raise error
        return starts_as_found(problem)

    for caught in ((), (PoseError,)):
        with pytest.raises(ChselError, match="nothing"):
            list(session().steps(enumerate(PROBES), fails_at_1, *caught))
    steps = list(session().steps(enumerate(PROBES), fails_at_1, ChselError))
    assert [step.failure for step in steps] == [None, error, None, None]
    assert steps[1].problem is not None
    assert steps[1].hypotheses is None
    np.testing.assert_array_equal(steps[2].problem.low_cost_set, steps[0].hypotheses.elites)


def test_without_a_method_problems_follow_from_what_is_remembered():
    key = StreamKey(0, 0)
    found = starts_as_found(pose_problem(GRID, PROBES[0], WORKSPACE, 0.01, key, SETTINGS, None))
    online, sets = session(), []
    for step in online.steps(enumerate(PROBES[:3])):
        assert step.hypotheses is None
        sets.append(len(step.problem.low_cost_set))
        if step.step == 1:
            online.remember(found)
    assert sets == [0, 0, len(found.elites)]


def test_a_result_without_poses_has_no_trust_and_cannot_be_followed():
    (step,) = session().steps([(0, PROBES[0])], lambda _: NOTHING)
    assert step.hypotheses.trust is None
    online = session(points=PROBES[0], previous=NOTHING)
    with pytest.raises(PoseError, match="has no hypotheses; accepted: at least one"):
        online.pose(1)
    (step,) = online.steps([(1, PROBES[1])], starts_as_found, PoseError)
    assert step.problem is None
    assert isinstance(step.failure, PoseError)


KEY = StreamKey(5, 2)
MANY = 100_000
TURNS = axis_angle(np.tile([0.0, 0.6, 0.8], (3, 1)), np.linspace(0.1, 2.0, 3))
POSES = compose(TURNS, np.linspace(0.0, 0.3, 9).reshape(3, 3))
RESULT = replace(hypotheses_at(POSES), elites=np.concatenate([POSES, inverse(POSES)]))


def test_first_of_the_updated_set_is_the_best_pose_to_the_bit():
    updated = updated_initial_set(RESULT, KEY, OnlineSettings())
    assert updated[0].tobytes() == POSES[0].tobytes()
    assert not (updated[1:] == updated[0]).all(axis=(1, 2)).any()


@pytest.mark.parametrize(
    ("law", "angle_rms"), [("axis_gauss", 0.3), ("rotvec_gauss", 0.3 * np.sqrt(3))]
)
def test_update_noise_has_the_set_deviations_and_its_axes_are_uniform_on_the_sphere(law, angle_rms):
    settings = OnlineSettings(hypotheses=MANY, rotation_law=law, keep_best=False)
    world = inverse(updated_initial_set(RESULT, KEY, settings))
    best = inverse(POSES[0])
    deviation = (world[:, :3, 3] - best[:3, 3]).std(axis=0)
    np.testing.assert_allclose(deviation, 0.05, rtol=0.01)
    turn = world[:, :3, :3] @ best[:3, :3].T
    assert np.sqrt((rotation_angle(turn) ** 2).mean()) == pytest.approx(angle_rms, rel=0.02)
    skew = turn - np.swapaxes(turn, 1, 2)
    vector = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]])
    axis = vector / np.sqrt((vector**2).sum(axis=0))
    np.testing.assert_allclose(np.cov(axis), np.eye(3) / 3, atol=0.01)


def first_set(points=None, **changes):
    settings = OnlineSettings(**changes)
    return inverse(first_initial_set(WORKSPACE, points or KnownPoints(), KEY, settings))


def test_first_set_is_uniform_in_workspace_and_rotations():
    world, (lower, upper) = first_set(hypotheses=MANY), WORKSPACE.bounds
    places = world[:, :3, 3]
    assert (places >= lower).all()
    assert (places <= upper).all()
    np.testing.assert_allclose(places.mean(axis=0), (lower + upper) / 2, atol=0.005)
    np.testing.assert_allclose(places.std(axis=0), (upper - lower) / np.sqrt(12), rtol=0.02)
    # Uniform on SO(3): every column is uniform on the sphere, and E[angle] = pi/2 + 2/pi.
    np.testing.assert_allclose(np.cov(world[:, :3, 0].T), np.eye(3) / 3, atol=0.01)
    assert rotation_angle(world[:, :3, :3]).mean() == pytest.approx(np.pi / 2 + 2 / np.pi, abs=0.01)


def test_upright_starts_turn_about_the_vertical_alone():
    world = first_set(hypotheses=500, initial="upright")
    np.testing.assert_allclose(world[:, 2, 2], 1.0, atol=1e-15)
    assert np.ptp(np.arctan2(world[:, 1, 0], world[:, 0, 0])) > 6.0


def test_centroid_starts_lie_around_the_mean_contact_whatever_else_is_known():
    known = [[0.1, 0.2, 0.3], [0.3, 0.2, 0.3], [1.5, 1.5, 1.5]]
    points = KnownPoints(free=np.full((9, 3), 2.0), known=known, known_sdf=[0.0, 0.0, 0.4])
    world = first_set(points, hypotheses=500, initial="contact_centroid")
    assert np.abs(world[:, :3, 3] - [0.2, 0.2, 0.3]).max() <= 0.05 + 1e-12


@pytest.mark.parametrize(("choice", "count"), [("elites", 6), ("estimates", 3), ("none", 0)])
def test_low_cost_set_is_what_is_chosen(choice, count):
    settings = OnlineSettings(low_cost_set=choice)
    problem = pose_problem(GRID, PROBES[0], WORKSPACE, 0.01, KEY, settings, RESULT)
    np.testing.assert_array_equal(problem.low_cost_set, RESULT.elites[:count])
    assert problem.initial_set.shape == (30, 4, 4)
