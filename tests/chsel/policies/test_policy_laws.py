"""Laws of decisions: which actions are taken, and what another order, frame or seed may change."""

from dataclasses import replace

import numpy as np

from chsel.next_probe.decision_problem import STOPS, Actions, WeightedPoses
from chsel.policies import build_policy
from chsel.problem.poses import apply, compose, inverse
from tests.chsel.laws import every_policy
from tests.chsel.next_probe.decisions import along_x, at, ball_problem, facing

PLACES = [
    (-0.0613, 0.0021),
    (0.0617, 0.0013),
    (0.0011, 0.0007),
    (0.2507, 0.2503),
    (-0.0207, 0.0311),
]
BY_ORDER = ("grid", "random")
"""Policies that rate actions by their place in the list."""


def problem(actions=None, **changes):
    """Balls at three places of unequal weight, and five actions that meet one, two or none."""
    poses = at((0.0017, -0.0419, 0.0123), (0.1513, 0.0527, 0.0031), (0.0537, 0.0019, -0.0311))
    weights = np.array([0.5, 0.3, 0.2])
    return ball_problem(poses, actions or along_x(PLACES), weights=weights, **changes)


def decided(name, problem):
    return build_policy(name).decide(problem)


def chosen_of(actions, which):
    return Actions(actions.world_from_hand[which], actions.length[which])


@every_policy
def test_an_available_action_of_the_highest_score_is_taken_or_a_reason_given(name):
    for available in ([0, 1, 2, 3, 4], [1, 3], [4], []):
        flags = np.isin(np.arange(5), available)
        decision = decided(name, problem(available=flags))
        assert np.isneginf(decision.score[~flags]).all()
        assert np.isfinite(decision.score[flags]).all()
        assert decision.stop in STOPS
        if decision.stop:
            assert decision.chosen == -1
            assert decision.contacts.shape == (0, 3)
        else:
            assert decision.chosen == np.argmax(decision.score)
            assert flags[decision.chosen]
        assert (decision.stop == "actions") == (not available)


@every_policy
def test_contacts_of_a_decision_are_on_the_object_where_it_is_hit(name):
    decision = decided(name, problem())
    met = np.isfinite(decision.contacts[:, 0])
    weights, poses = problem().belief.weights, problem().belief.object_from_world
    assert weights[met].sum() == decision.hit_chance[decision.chosen]
    for pose, contact in zip(poses[met], decision.contacts[met], strict=True):
        assert abs(np.linalg.norm(apply(pose, contact[None])[0]) - 0.05) < 1e-3


@every_policy
def test_scores_go_with_their_actions_in_whatever_order(name):
    order = np.array([3, 0, 4, 2, 1])
    usual = decided(name, problem())
    other = decided(name, problem(chosen_of(along_x(PLACES), order)))
    if name in BY_ORDER:
        assert np.array_equal(other.score, usual.score)
    else:
        assert np.array_equal(other.score, usual.score[order])
    for part in ("hit_chance", "blocked_chance", "expected_spread"):
        assert np.array_equal(getattr(other, part), getattr(usual, part)[order])
    assert other.spread == usual.spread


@every_policy
def test_of_an_action_that_is_offered_twice_the_first_is_taken(name):
    best = decided(name, problem()).chosen
    twice = decided(name, problem(chosen_of(along_x(PLACES), np.array([best, best, *range(5)]))))
    assert twice.chosen == (0 if name != "random" else np.argmax(twice.score))
    assert np.array_equal(twice.hit_chance[:2], twice.hit_chance[[best + 2] * 2])
    if name not in BY_ORDER:
        assert np.array_equal(twice.score[:2], twice.score[[best + 2] * 2])


@every_policy
def test_a_decision_turns_with_the_world_about_the_vertical(name):
    """By a quarter turn, which takes the workspace and its voxels onto themselves."""
    turn = compose(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
    usual = decided(name, problem())
    before = problem()
    actions = Actions(turn @ before.actions.world_from_hand, before.actions.length)
    belief = WeightedPoses(before.belief.object_from_world @ inverse(turn), before.belief.weights)
    found = decided(name, replace(before, actions=actions, belief=belief))
    assert found.chosen == usual.chosen
    np.testing.assert_allclose(found.score, usual.score, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.expected_spread, usual.expected_spread, rtol=1e-9)
    np.testing.assert_allclose(found.contacts, apply(turn, usual.contacts), atol=1e-9)


@every_policy
def test_seeds_and_steps_change_what_is_drawn_alone(name):
    usual = decided(name, problem())
    assert decided(name, problem()).digest == usual.digest
    for other in (problem(seed=8), problem(step=1)):
        same = decided(name, other).digest == usual.digest
        assert same is (name != "random")


@every_policy
def test_the_budget_a_narrow_belief_and_blocked_starts_end_a_session(name):
    budget = build_policy(name, {"probes": 4})
    assert budget.decide(problem(step=3)).stop == ""
    assert budget.decide(problem(step=4)).stop == "budget"
    narrow = replace(problem(), belief=WeightedPoses(at((0.0, 0.0, 0.0)), np.ones(1)))
    assert decided(name, narrow).stop == "spread"
    within = [facing((0.0, -0.04, 0.01), (1.0, 0.0, 0.0))]  # a start inside of the first ball
    blocked = decided(name, problem(Actions(np.array(within), np.array([0.5]))))
    assert (blocked.stop, blocked.blocked_chance.tolist()) == ("actions", [0.5])
    assert decided(name, replace(problem(), verdict="determined")).stop == "spread"
