"""The loop of Algorithm 2, E_0 and E_l."""

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
    pose_problem,
    updated_initial_set,
)
from chsel.problem.poses import axis_angle, compose, inverse, rotation_angle
from chsel.problem.streams import StreamKey
from tests.chsel.samples import hypotheses_at

GRID = SdfGrid.from_mesh(trimesh.creation.box((0.1, 0.06, 0.04)), 0.02)
WORKSPACE = Workspace((-0.1, -0.3, 0.0), (0.5, 0.3, 0.6))
SETTINGS = OnlineSettings(hypotheses=4)
PROBES = [KnownPoints(known=[[0.1 * step, 0.0, 0.1]]) for step in range(4)]


def starts_as_found(problem):
    """E_0 at ascending costs, the last pose first."""
    return hypotheses_at(problem.initial_set[::-1])


class FailsAt:
    def __init__(self, step, error):
        self.step, self.error = step, error

    def __call__(self, problem):
        if problem.key.step == self.step:
            raise self.error
        return starts_as_found(problem)


def test_every_problem_has_all_points_and_follows_from_the_result_before():
    first = KnownPoints(free=[[0.3, 0.3, 0.3]])
    online = OnlineRegistration(GRID, WORKSPACE, 0.01, SETTINGS, seed=7, points=first)
    previous, points = None, first
    for step in online.steps(enumerate(PROBES), starts_as_found):
        points = points.merged(PROBES[step.step])
        key = StreamKey(7, step.step)
        expected = pose_problem(GRID, points, WORKSPACE, 0.01, key, SETTINGS, previous)
        assert step.problem is not None
        assert step.problem.digest == expected.digest
        assert step.hypotheses is online.previous
        assert step.failure is None
        previous = step.hypotheses
    assert points.count == 5


def test_results_say_how_far_to_trust_them():
    online = OnlineRegistration(GRID, WORKSPACE, 0.01, SETTINGS, sensor_noise=0.002)
    for step in online.steps(enumerate(PROBES[:2]), starts_as_found):
        assert step.problem is not None
        assert step.hypotheses is not None
        expected = trust_in(step.problem, starts_as_found(step.problem), 0.002)
        assert step.hypotheses.trust == expected
    nothing = OnlineRegistration(GRID, WORKSPACE, 0.01, SETTINGS)
    (step,) = nothing.steps([(0, PROBES[0])], lambda _: hypotheses_at(np.zeros((0, 4, 4))))
    assert step.hypotheses is not None
    assert step.hypotheses.trust is None


@pytest.mark.parametrize(
    ("start", "only", "registered"),
    [
        (Start(), None, [0, 1, 2, 3]),
        (Start(contacts=2), None, [1, 2, 3]),
        (Start(step=3), None, [3]),
        (Start(), {0, 2}, [0, 2]),
        (Start(contacts=3), {0, 2}, [2]),
    ],
)
def test_steps_before_the_start_and_those_not_chosen_register_nothing(start, only, registered):
    online = OnlineRegistration(GRID, WORKSPACE, 0.01, SETTINGS, start=start, only=only)
    steps = list(online.steps(enumerate(PROBES), starts_as_found))
    assert [step.step for step in steps] == [0, 1, 2, 3]
    assert [step.step for step in steps if step.problem is not None] == registered
    assert [step.step for step in steps if step.hypotheses is not None] == registered
    problem = steps[registered[-1]].problem
    assert problem is not None
    assert problem.points.count == registered[-1] + 1  # those of skipped steps, too


def test_nothing_is_registered_while_no_point_is_known():
    online = OnlineRegistration(GRID, WORKSPACE, 0.01, SETTINGS)
    steps = online.steps(enumerate([KnownPoints(), PROBES[1]]), starts_as_found)
    assert [step.problem is not None for step in steps] == [False, True]


def test_an_error_ends_the_loop_unless_it_is_to_be_caught():
    failing = FailsAt(1, ChselError("nothing"))
    online = OnlineRegistration(GRID, WORKSPACE, 0.01, SETTINGS)
    with pytest.raises(ChselError, match="nothing"):
        list(online.steps(enumerate(PROBES), failing))
    with pytest.raises(ChselError, match="nothing"):
        list(online.steps(enumerate(PROBES), failing, PoseError))


def test_after_a_failure_the_next_problem_follows_from_the_last_result():
    error = ChselError("nothing")
    online = OnlineRegistration(GRID, WORKSPACE, 0.01, SETTINGS)
    steps = list(online.steps(enumerate(PROBES), FailsAt(1, error), ChselError))
    assert [step.failure for step in steps] == [None, error, None, None]
    assert steps[1].problem is not None
    assert steps[1].hypotheses is None
    first, third = steps[0].hypotheses, steps[2].problem
    assert first is not None
    assert third is not None
    assert third.low_cost_set.tobytes() == first.elites.tobytes()


def test_without_a_method_problems_follow_from_what_is_remembered():
    found = starts_as_found(
        pose_problem(GRID, PROBES[0], WORKSPACE, 0.01, StreamKey(0, 0), SETTINGS, None)
    )
    online = OnlineRegistration(GRID, WORKSPACE, 0.01, SETTINGS)
    sets = []
    for step in online.steps(enumerate(PROBES[:3])):
        assert step.problem is not None
        assert step.hypotheses is None
        sets.append(len(step.problem.low_cost_set))
        if step.step == 1:
            online.remember(found)
    assert sets == [0, 0, len(found.elites)]


def test_a_result_without_poses_cannot_be_followed():
    nothing = hypotheses_at(np.zeros((0, 4, 4)))
    online = OnlineRegistration(GRID, WORKSPACE, 0.01, SETTINGS, points=PROBES[0], previous=nothing)
    with pytest.raises(PoseError, match="has no hypotheses; accepted: at least one"):
        online.pose(1)
    (step,) = online.steps([(1, PROBES[1])], starts_as_found, PoseError)
    assert step.problem is None
    assert isinstance(step.failure, PoseError)


KEY = StreamKey(5, 2)
MANY = 100_000


def result(count=3):
    rotation = axis_angle(np.tile([0.0, 0.6, 0.8], (count, 1)), np.linspace(0.1, 2.0, count))
    poses = compose(rotation, np.linspace(0.0, 0.3, 3 * count).reshape(count, 3))
    return replace(hypotheses_at(poses), elites=np.concatenate([poses, inverse(poses)]))


def test_first_of_the_updated_set_is_the_best_pose_to_the_bit():
    previous = result()
    updated = updated_initial_set(previous, KEY, OnlineSettings())
    assert updated[0].tobytes() == previous.object_from_world[0].tobytes()
    assert not (updated[1:] == updated[0]).all(axis=(1, 2)).any()


@pytest.mark.parametrize(
    ("law", "angle_rms"), [("axis_gauss", 0.3), ("rotvec_gauss", 0.3 * np.sqrt(3))]
)
def test_update_noise_has_the_set_deviations(law, angle_rms):
    previous = result()
    settings = OnlineSettings(hypotheses=MANY, rotation_law=law, keep_best=False)
    world = inverse(updated_initial_set(previous, KEY, settings))
    best = inverse(previous.object_from_world[0])
    deviation = (world[:, :3, 3] - best[:3, 3]).std(axis=0)
    np.testing.assert_allclose(deviation, 0.05, rtol=0.01)
    angle = rotation_angle(world[:, :3, :3] @ best[:3, :3].T)
    assert np.sqrt((angle**2).mean()) == pytest.approx(angle_rms, rel=0.02)


def test_axis_of_axis_gauss_is_uniform_on_the_sphere():
    settings = OnlineSettings(hypotheses=MANY, rotation_law="axis_gauss", translation_noise=0.0)
    world = inverse(updated_initial_set(result(), KEY, settings))[1:, :3, :3]
    turn = world @ inverse(result().object_from_world[0])[:3, :3].T
    vector = np.stack(
        [
            turn[:, 2, 1] - turn[:, 1, 2],
            turn[:, 0, 2] - turn[:, 2, 0],
            turn[:, 1, 0] - turn[:, 0, 1],
        ]
    )
    axis = vector / np.sqrt((vector**2).sum(axis=0))
    np.testing.assert_allclose(np.cov(axis), np.eye(3) / 3, atol=0.01)


def test_first_set_is_uniform_in_workspace_and_rotations():
    settings = OnlineSettings(hypotheses=MANY)
    world = inverse(first_initial_set(WORKSPACE, KnownPoints(), KEY, settings))
    lower, upper = WORKSPACE.bounds
    assert (world[:, :3, 3] >= lower).all()
    assert (world[:, :3, 3] <= upper).all()
    np.testing.assert_allclose(world[:, :3, 3].mean(axis=0), (lower + upper) / 2, atol=0.005)
    np.testing.assert_allclose(
        world[:, :3, 3].std(axis=0), (upper - lower) / np.sqrt(12), rtol=0.02
    )
    # Uniform on SO(3): every column is uniform on the sphere, and E[angle] = pi/2 + 2/pi.
    np.testing.assert_allclose(np.cov(world[:, :3, 0].T), np.eye(3) / 3, atol=0.01)
    assert rotation_angle(world[:, :3, :3]).mean() == pytest.approx(np.pi / 2 + 2 / np.pi, abs=0.01)


def test_upright_starts_turn_about_the_vertical_alone():
    settings = OnlineSettings(hypotheses=500, initial="upright")
    world = inverse(first_initial_set(WORKSPACE, KnownPoints(), KEY, settings))
    np.testing.assert_allclose(world[:, 2, 2], 1.0, atol=1e-15)
    assert np.ptp(np.arctan2(world[:, 1, 0], world[:, 0, 0])) > 6.0


def test_centroid_starts_lie_around_the_mean_contact_whatever_else_is_known():
    settings = OnlineSettings(hypotheses=500, initial="contact_centroid")
    points = KnownPoints(
        free=np.full((9, 3), 2.0),
        known=[[0.1, 0.2, 0.3], [0.3, 0.2, 0.3], [1.5, 1.5, 1.5]],
        known_sdf=[0.0, 0.0, 0.4],
    )
    world = inverse(first_initial_set(WORKSPACE, points, KEY, settings))
    assert np.abs(world[:, :3, 3] - [0.2, 0.2, 0.3]).max() <= 0.05 + 1e-12


@pytest.mark.parametrize(("choice", "count"), [("elites", 6), ("estimates", 3), ("none", 0)])
def test_low_cost_set_is_what_is_chosen(choice, count):
    grid = SdfGrid.from_mesh(trimesh.creation.box((0.1, 0.06, 0.04)), 0.02)
    points = KnownPoints(known=[[0.0, 0.0, 0.0]])
    settings = OnlineSettings(low_cost_set=choice)
    problem = pose_problem(grid, points, WORKSPACE, 0.01, KEY, settings, result())
    np.testing.assert_array_equal(problem.low_cost_set, result().elites[:count])
    assert problem.initial_set.shape == (30, 4, 4)


def test_every_step_draws_the_same_numbers_whatever_ran_before():
    settings = OnlineSettings()
    first = first_initial_set(WORKSPACE, KnownPoints(), StreamKey(1, 4), settings)
    first_initial_set(WORKSPACE, KnownPoints(), StreamKey(1, 3), settings)
    again = first_initial_set(WORKSPACE, KnownPoints(), StreamKey(1, 4), settings)
    other = first_initial_set(WORKSPACE, KnownPoints(), StreamKey(2, 4), settings)
    assert first.tobytes() == again.tobytes()
    assert (first != other).any(axis=(1, 2)).all()
