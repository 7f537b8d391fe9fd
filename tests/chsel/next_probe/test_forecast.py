"""What actions are worth: bounds, closed forms, and what must not matter; and hostile problems."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from chsel.errors import PoseError, SettingError
from chsel.next_probe.decision_problem import (
    Belief,
    HandShape,
)
from chsel.next_probe.forecast import Forecast
from chsel.policies import POLICIES, build_policy
from chsel.problem.points import KnownPoints
from tests.chsel.next_probe.decisions import RADIUS, along_x, at, ball_problem, box_hand

NOISE = 0.005
PLACES = [(0.0, 0.0), (0.06, 0.0), (-0.05, 0.03), (0.0, -0.1), (0.28, 0.28)]


def some_problem(seed, count, reach):
    """Poses around the middle of the workspace, some of weight 0."""
    stream = np.random.default_rng(seed)
    poses = at(*stream.uniform(-reach, reach, (count, 3)).tolist())
    weights = stream.integers(0, 4, count) + 1e-3 * (np.arange(count) == 0)
    return ball_problem(poses, along_x(PLACES), weights=weights / weights.sum())


def entropy(weights):
    """Of a distribution, nats."""
    weights = weights[weights > 0.0]
    return float(-(weights * np.log(weights)).sum())


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 25), st.sampled_from([0.0, 0.003, 0.03, 0.15]))
def test_gains_stay_within_their_bounds(seed, count, reach):
    forecast = Forecast(some_problem(seed, count, reach), NOISE)
    weights, gains = forecast.problem.belief.weights, forecast.gains
    assert (gains.information >= 0.0).all()
    assert (gains.information <= entropy(weights) + 1e-12).all()
    assert (gains.surviving <= 1.0 + 1e-12).all()
    assert (gains.surviving >= (weights**2).sum() - 1e-12).all()
    assert (gains.expected_spread >= 0.0).all()
    assert (gains.expected_spread <= forecast.distances.max() + 1e-12).all()
    misses = forecast.hit_chance == 0.0
    assert misses.any()
    assert not gains.information[misses].max() > 1e-12
    assert gains.expected_spread[misses] == pytest.approx(forecast.spread, abs=1e-12)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6))
def test_the_order_of_poses_and_those_without_weight_do_not_matter(seed):
    problem = some_problem(seed, 12, 0.05)
    order = np.random.default_rng(seed).permutation(12)
    belief = problem.belief
    order = order[belief.weights[order] > 0.0]
    few = Belief(belief.object_from_world[order], belief.weights[order])
    here, there = Forecast(problem, NOISE), Forecast(replace(problem, belief=few), NOISE)
    assert there.hit_chance == pytest.approx(here.hit_chance, abs=1e-12)
    assert there.gains.information == pytest.approx(here.gains.information, abs=1e-12)
    assert there.gains.surviving == pytest.approx(here.gains.surviving, abs=1e-12)
    assert there.gains.expected_spread == pytest.approx(here.gains.expected_spread, abs=1e-9)


def test_the_spread_is_the_root_mean_square_distance_of_surfaces():
    """Of two balls of radius r, d apart: the mean square of |r - |x + d|| over |x| = r."""
    apart, weight = 0.02, 0.25
    cosines = np.linspace(-1.0, 1.0, 20_001)
    between = np.sqrt(RADIUS**2 + apart**2 + 2.0 * RADIUS * apart * cosines) - RADIUS
    squares = 2.0 * weight * (1.0 - weight) * (between**2).mean()
    poses = at((0.0, 0.0, 0.0), (0.0, apart, 0.0))
    aside = along_x([(0.25, 0.25)])  # which misses both
    problem = ball_problem(poses, aside, weights=np.array([weight, 1.0 - weight]))
    decision = build_policy("expected_loss").decide(problem)
    assert decision.spread == pytest.approx(math.sqrt(squares), rel=0.05)
    assert decision.expected_spread == pytest.approx([decision.spread])


def test_information_is_that_of_the_formula():
    problem = some_problem(3, 10, 0.06)
    first, weights = Forecast(problem, NOISE).first, problem.belief.weights
    hit = np.isfinite(first.travel)
    squared = ((first.contact[:, None] - first.contact[None]) ** 2).sum(axis=-1)  # (K, K, A)
    both, neither = hit[:, None] & hit[None], ~hit[:, None] & ~hit[None]
    alike = np.where(both, np.exp(-squared / (8.0 * NOISE**2)), np.where(neither, 1.0, 0.01))
    with np.errstate(divide="ignore"):
        inner = np.log(np.einsum("j,ija->ia", weights, alike))
    expected = -np.einsum("i,ia->a", weights, np.where(weights[:, None] > 0.0, inner, 0.0))
    left = weights[:, None] * alike**2 / np.einsum("j,ija->ia", weights, alike**2)[:, None]
    distances = Forecast(problem, NOISE).distances
    loss, squares = (np.einsum("i,ija,ij->a", weights, left, distances**n) for n in (1, 2))
    surviving = np.einsum("i,ija,j->a", weights, alike**2, weights)
    gains = Forecast(problem, NOISE).gains
    assert (expected > 0.5).sum() >= 2
    assert gains.information == pytest.approx(expected, abs=1e-9)
    assert gains.surviving == pytest.approx(surviving, abs=1e-9)
    assert gains.expected_spread == pytest.approx(np.sqrt(squares), abs=1e-9)
    assert gains.loss == pytest.approx(loss, abs=1e-9)


@pytest.mark.parametrize("weight", [0.5, 0.9, 1.0])
def test_two_poses_that_an_outcome_splits(weight):
    poses = at((0.0, -0.2, 0.0), (0.0, 0.2, 0.0))
    weights = np.array([weight, 1.0 - weight])
    problem = ball_problem(poses, along_x([(0.2, 0.0)]), weights=weights)
    forecast = Forecast(problem, NOISE)
    assert forecast.hit_chance == pytest.approx([1.0 - weight])
    assert forecast.gains.information == pytest.approx([entropy(weights)], abs=0.03)
    # A sensor errs: what an outcome rules out keeps 0.01^2 of its weight.
    left = forecast.distances[0, 1] * (0.01 if weight < 1.0 else 0.0)
    assert forecast.gains.expected_spread == pytest.approx([left], rel=1e-3)
    assert forecast.gains.surviving == pytest.approx([(weights**2).sum()], abs=1e-4)


def test_a_start_behind_the_object_is_blocked():
    problem = ball_problem(at((-0.35, 0.0, 0.0), (0.1, 0.0, 0.0)), along_x([(0.0, 0.0)]))
    assert Forecast(problem, NOISE).blocked_chance == pytest.approx([0.5])
    assert build_policy("information").decide(problem).stop == "actions"


def finely_made_hand():
    """A hand of more than 80 000 faces."""
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.04)
    return HandShape.of(ball)


@pytest.mark.parametrize("name", POLICIES)
@pytest.mark.parametrize("case", ["one pose", "one action", "no action left", "large", "fine hand"])
def test_problems_of_any_size_are_decided(name, case):
    stream = np.random.default_rng(1)
    problem = some_problem(1, 20, 0.1)
    if case == "one pose":
        problem = replace(problem, belief=Belief(at((0.0, 0.0, 0.0)), np.ones(1)))
    elif case == "one action":
        problem = ball_problem(problem.belief.object_from_world, along_x([(0.0, 0.0)]))
    elif case == "no action left":
        problem = replace(problem, available=np.zeros(len(PLACES), dtype=bool))
    elif case == "large":
        actions = along_x(stream.uniform(-0.2, 0.2, (500, 2)).tolist())
        points = KnownPoints(free=stream.uniform(-0.3, 0.3, (100_000, 3)))
        problem = ball_problem(problem.belief.object_from_world, actions, points=points)
    else:
        problem = replace(problem, hand=finely_made_hand())
    decision = build_policy(name).decide(problem)
    assert decision.chosen < len(problem.actions)
    assert (decision.chosen >= 0) == (decision.stop == "")
    assert not np.isnan(decision.score).any()
    if case in ("one pose", "no action left"):
        assert decision.stop == {"one pose": "spread", "no action left": "actions"}[case]


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Belief(at((1e300, 0.0, 0.0)), np.ones(1)), PoseError, "belief[0] is beyond 1e+06"),
        (lambda: Belief(np.zeros((0, 4, 4)), np.zeros(0)), PoseError, "has no poses"),
        (lambda: Belief(2.0 * at((0.0, 0.0, 0.0)), np.ones(1)), PoseError, "not a rigid transform"),
        (lambda: Belief(at((0.0, 0.0, 0.0)), np.array([0.9])), SettingError, "a distribution"),
        (lambda: along_x([(0.0, 0.0)], length=0.0), SettingError, "length of actions has 0.0"),
        (lambda: HandShape(np.zeros((3, 3)), [[0, 1, 3]]), SettingError, "has no faces"),
        (lambda: HandShape(np.eye(3) * 50.0, [[0, 1, 2]]), SettingError, "the hand reaches 50 m"),
        (lambda: replace(some_problem(1, 2, 0.1), free_resolution=0.0), SettingError, "free_res"),
    ],
)
def test_what_is_no_problem_is_refused(make, error, message):
    with pytest.raises(error) as caught:
        make()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_hand_of_one_flat_face_still_touches():
    sheet = HandShape([[-0.02, -0.01, 0.0], [0.02, -0.01, 0.0], [0.0, 0.02, 0.0]], [[0, 1, 2]])
    problem = replace(some_problem(1, 5, 0.01), hand=sheet)
    assert np.isfinite(Forecast(problem, NOISE).first.travel[:, 0]).all()
    assert (sheet.front.heights > -np.inf).any()
    assert box_hand().front.heights.max() == 0.0
