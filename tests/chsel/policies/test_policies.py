"""Scores of policies by worlds in which they are known, and when a session ends."""

from dataclasses import replace

import numpy as np
import pytest

from chsel.errors import SettingError
from chsel.next_probe.decision_problem import Actions
from chsel.next_probe.first_contact import touched_points
from chsel.next_probe.forecast import Forecast
from chsel.policies import POLICIES, build_policy
from chsel.policies.policy import StopSettings
from chsel.policies.voxel_entropy import filled_points, occupancy_entropy, voxel_box
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import apply, axis_angle, compose, inverse
from chsel.problem.registration_problem import VERDICTS
from tests.chsel.next_probe.decisions import (
    RADIUS,
    WORKSPACE,
    along_x,
    at,
    ball,
    ball_problem,
    facing,
)

# Two places of the ball, apart in y and in depth; of the third action both are in the way, at
# different depths, the fourth misses both.
TWO = at((0.0, -0.03, 0.0), (0.15, 0.03, 0.0))
PLACES = [(-0.06, 0.0), (0.06, 0.0), (0.0, 0.0), (0.25, 0.25)]


@pytest.mark.parametrize(
    ("name", "scores"),
    [
        ("grid", [0.0, -1.0, -2.0, -3.0]),
        ("hit_chance", [0.5, 0.5, 1.0, 0.0]),
        ("hypothesis_pruning", [0.5, 0.5, 0.5, 0.0]),
        ("information", [np.log(2.0)] * 3 + [0.0]),
        ("expected_loss", None),  # d / 2, all of it; the spread of two poses is d / sqrt(2)
    ],
)
def test_scores_of_two_places(name, scores):
    decision = build_policy(name).decide(ball_problem(TWO, along_x(PLACES)))
    scores = scores or [decision.spread / np.sqrt(2.0)] * 3 + [0.0]
    assert decision.score == pytest.approx(scores, rel=0.06, abs=1e-12)
    assert decision.chosen == np.argmax(decision.score)


@pytest.mark.parametrize(
    "name", ["hypothesis_pruning", "information", "expected_loss", "voxel_entropy"]
)
def test_what_all_poses_agree_on_is_worth_nothing(name):
    agreed = build_policy(name).decide(ball_problem(TWO[[0, 0]], along_x(PLACES)))
    assert agreed.score == pytest.approx(np.zeros(4), abs=1e-12)


def test_the_nearest_way_is_to_the_mean_and_ends_where_the_action_ends():
    policy = build_policy("nearest_mean")
    between = policy.decide(ball_problem(TWO, along_x(PLACES)))
    assert between.score == pytest.approx([-0.06, -0.06, 0.0, -np.hypot(0.25, 0.25)], abs=3e-3)
    problem = ball_problem(at((0.2, 0.0, 0.0)), along_x([(0.0, 0.0), (0.05, 0.0)]))
    assert policy.decide(problem).score == pytest.approx([0.0, -0.05], abs=3e-3)
    short = ball_problem(at((0.2, 0.0, 0.0)), along_x([(0.0, 0.0), (0.05, 0.0)], length=0.2))
    assert policy.decide(short).score == pytest.approx([-0.3, -np.hypot(0.3, 0.05)], abs=3e-3)


def test_the_nearest_way_is_to_the_centre_of_an_object_whose_origin_is_beside_it():
    """The ball's centre is 5 cm from its origin; turned and moved, it is at the world's origin."""
    quarter = axis_angle(np.array([0.0, 0.0, 1.0]), np.array(0.5 * np.pi))
    pose = inverse(compose(quarter, np.array([0.0, -0.05, 0.0])))
    problem = ball_problem(pose[None], along_x([(0.0, 0.0), (0.06, 0.0)]))
    sdf = replace(problem.sdf, origin=np.add(problem.sdf.origin, [0.05, 0.0, 0.0]))
    decision = build_policy("nearest_mean").decide(replace(problem, sdf=sdf))
    assert decision.score == pytest.approx([0.0, -0.06], abs=3e-3)


def test_random_takes_every_available_action_as_often():
    policy = build_policy("random", {"probes": 1000, "stop": {"gain": 0.0}})
    available = np.array([True, False, True, True])
    problem = ball_problem(TWO, along_x(PLACES), available=available)
    keys = [replace(problem.key, step=step) for step in range(600)]
    counts = np.bincount(
        [policy.decide(replace(problem, key=key)).chosen for key in keys], minlength=4
    )
    assert counts[1] == 0
    assert counts[[0, 2, 3]].min() > 150


@pytest.mark.parametrize("name", POLICIES)
def test_gains_are_a_second_and_other_ratings_are_not(name):
    actions = along_x(PLACES)
    seconds = np.array([1.0, 2.0, 4.0, 1.0])
    timed = Actions(actions.world_from_hand, actions.length, seconds=seconds)
    usual = build_policy(name).decide(ball_problem(TWO, actions))
    decision = build_policy(name).decide(ball_problem(TWO, timed))
    divisor = 1.0 if name in ("grid", "random", "nearest_mean") else seconds
    assert np.array_equal(decision.score, usual.score / divisor)


def test_no_gain_is_promised_by_an_action_that_cannot_be_taken():
    """The last action misses both places of the ball, the first tells them apart."""
    policy = build_policy("information")
    actions = along_x(PLACES)
    for available, chosen, stop in (([3], -1, "gain"), ([0, 3], 0, "")):
        flags = np.isin(np.arange(4), available)
        decision = policy.decide(ball_problem(TWO, actions, available=flags))
        assert (decision.chosen, decision.stop) == (chosen, stop)


@pytest.mark.parametrize(
    ("spread", "verdict", "stop"),
    [
        (None, "", "spread"),  # 3 % of the diameter
        (None, "determined", "spread"),
        (None, "several modes", ""),
        (None, "wide", ""),
        (None, "nothing fits", ""),
        (0.05, "wide", ""),
        (0.05, "determined", "spread"),
        (0.05, "", "spread"),
        (0.0, "determined", ""),
        (1e-4, "determined", ""),
    ],
)
def test_a_session_ends_by_the_spread_where_the_result_is_determined_alone(spread, verdict, stop):
    """Two places of a ball 2 mm apart."""
    policy = build_policy("information", {"stop": {"spread": spread, "gain": 0.0}})
    problem = ball_problem(at((0.0, 0.0, 0.0), (0.002, 0.0, 0.0)), along_x([(0.0, 0.0)]))
    assert policy.decide(replace(problem, verdict=verdict)).stop == stop


@pytest.mark.parametrize("scale", [0.3, 1.0, 3.0])
def test_rules_to_stop_grow_with_the_object(scale):
    rules = StopSettings()
    diameter = 0.2 * scale
    assert rules.is_narrow(0.0299 * diameter, diameter, verdict="")
    assert not rules.is_narrow(0.0301 * diameter, diameter, verdict="")
    assert rules.is_narrow(0.1, diameter, verdict="determined")  # the verdict itself is relative
    assert rules.is_useless(0.00099 * diameter, diameter)
    assert not rules.is_useless(0.00101 * diameter, diameter)
    recorded = StopSettings(spread=0.010, gain=0.0005)
    assert recorded.is_narrow(0.0099, diameter, verdict="")
    assert recorded.is_useless(0.00049, diameter)
    assert not recorded.is_narrow(0.0101, diameter, verdict="")


def test_an_unknown_verdict_is_refused():
    problem = ball_problem(TWO, along_x(PLACES))
    with pytest.raises(SettingError, match="verdict is 'sure'; accepted: "):
        replace(problem, verdict="sure")
    judged = [replace(problem, verdict=verdict).digest for verdict in ("", *VERDICTS)]
    assert judged[0] == problem.digest
    assert len(set(judged)) == 5


def test_rules_that_are_switched_off_end_no_session():
    """Of some numbers of poses the rounding of what a miss leaves of the spread is above it."""
    policy = build_policy("information", {"stop": {"spread": 0.0, "gain": 0.0}})
    for count in range(2, 12):
        poses = at(*((0.01 * n, 0.0, 0.0) for n in range(count)))
        assert policy.decide(ball_problem(poses, along_x([(0.25, 0.25)]))).stop == ""


def test_names_and_settings_that_do_not_exist_are_refused():
    with pytest.raises(SettingError, match="policy is 'greedy'; accepted: grid, random"):
        build_policy("greedy")
    with pytest.raises(SettingError, match=r"policy.prob does not exist; did you mean probes"):
        build_policy("random", {"prob": 3})


SIDE = 0.02
VOLUME = 4.0 / 3.0 * np.pi * RADIUS**3


def some_problem(points=None):
    """Five balls of unequal weight, and actions from several sides."""
    stream = np.random.default_rng(5)
    poses = at(*stream.uniform(-0.12, 0.12, (5, 3)).tolist())
    starts = stream.uniform(-0.1, 0.1, (12, 3))
    ahead = np.repeat([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.6, -0.8, 0.0]], 4, axis=0)
    hands = [facing(s - 0.3 * a, a) for s, a in zip(starts, ahead, strict=True)]
    actions = Actions(np.array(hands), stream.uniform(0.2, 0.6, 12))
    weights = np.array([0.4, 0.3, 0.2, 0.1, 0.0])
    return ball_problem(poses, actions, weights=weights, points=points)


def swept_by_definition(problem):
    """Of each action: sum over voxels that it sweeps of entropy times the chance to get there."""
    box = voxel_box(problem.workspace, SIDE)
    poses, weights = problem.belief.object_from_world, problem.belief.weights
    filled = np.zeros((len(poses), *box.counts), dtype=bool)
    for k, world_from_object in enumerate(inverse(poses)):
        points = apply(world_from_object, filled_points(problem.sdf, SIDE))
        x, y, z = np.floor((points - box.lower) / SIDE).astype(int).T
        filled[k, x, y, z] = True
    chance = np.einsum("k,k...->...", weights, filled)
    with np.errstate(all="ignore"):
        entropy = -chance * np.log(chance) - (1.0 - chance) * np.log(1.0 - chance)
    entropy = np.nan_to_num(entropy)
    points = problem.points
    for point in np.concatenate([points.free, points.occupied, points.known]):
        entropy[tuple(np.floor((point - box.lower) / SIDE).astype(int))] = 0.0
    travel = Forecast(problem, 0.005).first.travel
    front = problem.hand.front
    swept = np.zeros(len(problem.actions))
    for voxel in np.argwhere(entropy > 1e-12):
        centre = box.lower + (voxel + 0.5) * SIDE
        for a, hand in enumerate(problem.actions.world_from_hand):
            x, y, z = apply(inverse(hand), centre[None])[0]
            near = np.floor(([x, y] - front.lower) / front.cell).astype(int)
            lower = np.maximum(near - 5, 0)
            upper = np.maximum(near + 6, 0)
            depth = z - front.heights[lower[0] : upper[0], lower[1] : upper[1]].max(initial=-np.inf)
            if 0.0 <= depth <= problem.actions.length[a]:
                swept[a] += entropy[tuple(voxel)] * weights[travel[:, a] >= depth].sum()
    return swept


@pytest.mark.parametrize("known", [False, True])
def test_the_entropy_swept_is_that_of_the_definition(known):
    places = np.random.default_rng(1).uniform(-0.2, 0.2, (300, 3))
    points = KnownPoints(places[:100], places[100:200], known=places[200:]) if known else None
    problem = some_problem(points)
    policy = build_policy("voxel_entropy", {"voxel": SIDE})
    rated = policy.rate(problem, Forecast(problem, 0.005))
    expected = swept_by_definition(problem)
    assert (expected > 1.0).sum() >= 6
    assert rated == pytest.approx(expected, rel=1e-9)


def test_voxels_hold_what_is_between_their_sides():
    box = voxel_box(Workspace((0.0, -0.5, 1.0), (0.5, 0.25, 2.25)), 0.25)
    assert (box.side, box.counts.tolist()) == (0.25, [2, 3, 5])
    steps = np.stack(np.meshgrid(*[np.arange(-2.0, 12.0) / 2.0] * 3), axis=-1).reshape(-1, 3)
    inside = ((steps >= 0.0) & (steps < (2, 3, 5))).all(axis=1)
    held = box.holding(box.lower + 0.25 * steps)
    np.testing.assert_array_equal(np.stack(held, axis=1), np.floor(steps[inside]))
    for upper, side, counts in (((1, 1, 1), 0.01, [100] * 3), ((1, 1, 2), 1 / 64, [64, 64, 128])):
        box = voxel_box(Workspace((0, 0, 0), upper), 0.01)
        assert (box.side, box.counts.tolist()) == (pytest.approx(side), counts)


def test_an_object_is_filled_at_nodes_half_a_voxel_apart():
    sdf = ball()
    nodes = np.argwhere(sdf.values <= 0.0)
    nodes = nodes[(nodes % 2 == 0).all(axis=1)]
    expected = [*touched_points(sdf).points, *(sdf.origin + nodes * sdf.resolution)]
    np.testing.assert_allclose(filled_points(sdf, 4.5 * sdf.resolution), expected)


def test_voxels_that_half_of_the_belief_fills_count_ln_2():
    problem = ball_problem(at((-0.1, 0.0, 0.0), (0.1, 0.0, 0.0)), along_x([(0.0, 0.0)]))
    entropy = occupancy_entropy(problem, voxel_box(WORKSPACE, 0.01))
    assert np.unique(entropy) == pytest.approx([0.0, np.log(2.0)])
    volume = (entropy > 0.0).sum() * 0.01**3
    assert 2.0 * VOLUME < volume < 2.0 * VOLUME * 1.6  # voxels that the surface enters count too


@pytest.mark.parametrize(
    ("workspace", "voxel"),
    [
        (Workspace((5.0, 5.0, 5.0), (5.1, 5.1, 5.1)), 0.02),  # without the object
        (WORKSPACE, 1e-6),
    ],
)
def test_any_workspace_and_voxel_take_bounded_memory(workspace, voxel):
    problem = replace(some_problem(), workspace=workspace)
    assert np.prod(voxel_box(workspace, voxel).counts) <= 1e6
    decision = build_policy("voxel_entropy", {"voxel": voxel}).decide(problem)
    assert np.isfinite(decision.score[problem.available & (decision.blocked_chance <= 0.05)]).all()
