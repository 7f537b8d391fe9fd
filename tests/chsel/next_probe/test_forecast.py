"""What actions are worth: formulas and closed forms; and what is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest

from chsel.errors import PoseError, SettingError
from chsel.next_probe.decision_problem import (
    Belief,
    HandShape,
)
from chsel.next_probe.forecast import Forecast
from chsel.policies import POLICIES, build_policy
from tests.chsel.next_probe.decisions import RADIUS, along_x, at, ball_problem, box_hand

NOISE = 0.005
PLACES = [(0.0, 0.0), (0.06, 0.0), (-0.05, 0.03), (0.0, -0.1), (0.28, 0.28)]


def some_problem(seed, count, reach):
    """Poses around the middle of the workspace, some of weight 0."""
    stream = np.random.default_rng(seed)
    poses = at(*stream.uniform(-reach, reach, (count, 3)).tolist())
    weights = stream.integers(0, 4, count) + 1e-3 * (np.arange(count) == 0)
    return ball_problem(poses, along_x(PLACES), weights=weights / weights.sum())


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


@pytest.mark.parametrize(("seed", "count", "reach"), [(3, 10, 0.06), (0, 1, 0.0), (5, 25, 0.15)])
def test_gains_are_those_of_the_formulas(seed, count, reach):
    problem = some_problem(seed, count, reach)
    forecast, weights = Forecast(problem, NOISE), problem.belief.weights
    first, distances, gains = forecast.first, forecast.distances, forecast.gains
    hit = np.isfinite(first.travel)
    squared = ((first.contact[:, None] - first.contact[None]) ** 2).sum(axis=-1)  # (K, K, A)
    both, neither = hit[:, None] & hit[None], ~hit[:, None] & ~hit[None]
    alike = np.where(both, np.exp(-squared / (8.0 * NOISE**2)), np.where(neither, 1.0, 0.01))
    with np.errstate(divide="ignore"):
        inner = np.log(np.einsum("j,ija->ia", weights, alike))
    expected = -np.einsum("i,ia->a", weights, np.where(weights[:, None] > 0.0, inner, 0.0))
    left = weights[:, None] * alike**2 / np.einsum("j,ija->ia", weights, alike**2)[:, None]
    loss, squares = (np.einsum("i,ija,ij->a", weights, left, distances**n) for n in (1, 2))
    surviving = np.einsum("i,ija,j->a", weights, alike**2, weights)
    assert forecast.hit_chance == pytest.approx(weights @ hit, abs=1e-12)
    assert (expected > 0.5).sum() >= 2 or count == 1
    assert (gains.information >= 0.0).all()
    assert gains.information == pytest.approx(expected, abs=1e-9)
    assert gains.surviving == pytest.approx(surviving, abs=1e-9)
    assert gains.expected_spread == pytest.approx(np.sqrt(squares), abs=1e-9)
    assert gains.loss == pytest.approx(loss, abs=1e-9)


def test_a_start_behind_the_object_is_blocked():
    problem = ball_problem(at((-0.35, 0.0, 0.0), (0.1, 0.0, 0.0)), along_x([(0.0, 0.0)]))
    assert Forecast(problem, NOISE).blocked_chance == pytest.approx([0.5])
    assert build_policy("information").decide(problem).stop == "actions"


@pytest.mark.parametrize("name", POLICIES)
def test_one_pose_or_one_action_is_decided(name):
    problem = some_problem(1, 20, 0.1)
    sure = replace(problem, belief=Belief(at((0.0, 0.0, 0.0)), np.ones(1)))
    assert build_policy(name).decide(sure).stop == "spread"
    single = ball_problem(problem.belief.object_from_world, along_x([(0.0, 0.0)]))
    decision = build_policy(name).decide(single)
    assert (decision.chosen, decision.stop) == (0, "")


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Belief(at((1e300, 0.0, 0.0)), np.ones(1)), PoseError, "belief[0] is beyond 1e+06"),
        (lambda: Belief(2.0 * at((0.0, 0.0, 0.0)), np.ones(1)), PoseError, "not a rigid transform"),
        (lambda: Belief(at((0.0, 0.0, 0.0)), np.array([0.9])), SettingError, "a distribution"),
        (lambda: along_x([(0.0, 0.0)], length=0.0), SettingError, "length of actions has 0.0"),
        (lambda: HandShape(np.eye(3) * 50.0, [[0, 1, 2]]), SettingError, "the hand reaches 50 m"),
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
