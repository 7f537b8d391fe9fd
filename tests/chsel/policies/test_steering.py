"""Decision after decision: beliefs, surprises, and what a policy of somebody else may give."""

from dataclasses import replace

import numpy as np
import pytest

from chsel.errors import ChselError, SettingError
from chsel.next_probe.forecast import BeliefSettings, belief_after, belief_before, surprise
from chsel.policies import build_policy
from chsel.policies.policy import PolicySettings
from chsel.policies.steering import Steering
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import Hypotheses
from chsel.problem.streams import StreamKey
from tests.chsel.next_probe.decisions import (
    RADIUS,
    WORKSPACE,
    along_x,
    at,
    ball,
    ball_problem,
    box_hand,
)

NOWHERE = np.zeros((0, 3))
PLACES = [(-0.06, 0.0), (0.06, 0.0), (0.0, 0.0)]


def test_before_any_contact_the_object_stands_on_the_floor_outside_of_free_space():
    grid = np.stack(np.meshgrid(*[np.arange(-0.3, 0.31, 0.02)] * 3), axis=-1).reshape(-1, 3)
    left = KnownPoints(free=grid[grid[:, 0] < 0.1])
    settings = BeliefSettings(poses=40, floor=-0.1)
    belief = belief_before(ball(), left, WORKSPACE, StreamKey(3, 0), settings)
    centres = Poses.of(belief.object_from_world).origins
    np.testing.assert_allclose(centres[:, 2], RADIUS - 0.1, atol=0.004)
    apart = np.sqrt(((centres[:, None] - left.free) ** 2).sum(axis=-1))
    assert apart.min() > RADIUS - ball().resolution - 1e-4  # of all free points
    anywhere = belief_before(
        ball(), left, WORKSPACE, StreamKey(3, 0), replace(settings, floor=None)
    )
    assert np.ptp(Poses.of(anywhere.object_from_world).origins[:, 2]) > 0.3
    assert belief.weights.sum() == pytest.approx(1.0)


def test_after_a_registration_candidates_count_and_else_hypotheses():
    poses = at(*((0.01 * n, 0.0, 0.0) for n in range(30)))
    found = Hypotheses(
        poses[:3], np.zeros(3), np.array([False, True, False]), np.zeros(3, np.int64), poses
    )
    np.testing.assert_array_equal(
        belief_after(found, BeliefSettings()).object_from_world, poses[:3:2]
    )
    found = replace(found, candidates=poses)
    belief = belief_after(found, BeliefSettings(poses=10))
    np.testing.assert_array_equal(belief.object_from_world, poses[::3])


def felt(weights, contact, noise=0.002):
    """How surprising it is to touch a place with the action that meets the first of two balls."""
    poses = at((0.0, 0.0, 0.0), (0.0, 0.2, 0.2))
    problem = ball_problem(poses, along_x([(0.0, 0.0)]), weights=np.array(weights))
    decision = build_policy("grid", {"stop": {"spread": 0.0, "gain": 0.0}}).decide(problem)
    assert np.isnan(decision.contacts[1]).all()
    return surprise(problem, decision, noise, contact)


def test_surprise_is_minus_the_logarithm_of_the_chance_of_what_happened():
    here = np.array([-RADIUS, 0.0, 0.0])
    assert felt((1.0, 0.0), here) == pytest.approx(-np.log(0.95 + 0.0005), abs=0.05)
    assert felt((0.5, 0.5), None) == pytest.approx(-np.log(0.95 * 0.5), abs=0.01)
    assert felt((0.9, 0.1), here) < felt((0.1, 0.9), here) < felt((0.0, 1.0), here)
    assert felt((1.0, 0.0), here + 0.05 * np.eye(3)[0]) > 6.0  # no pose had a contact there
    assert felt((1.0, 0.0), None) > 6.0
    assert felt((1.0, 0.0), here + 0.01 * np.eye(3)[0], noise=0.01) < 1.0


def test_what_a_probe_touches_first_is_what_surprises():
    session = steering(_Somebody())
    decision = session.decide(0, KnownPoints(), None, np.ones(3, dtype=bool)).decision
    near = decision.contacts[np.isfinite(decision.contacts[:, 0])][0]
    surprises = []
    for contacts in ([near], [near, near + 5.0], [near + 5.0, near]):
        session.felt(np.array(contacts))
        surprises.append(session.surprise)
    assert surprises[0] == surprises[1] < surprises[2]


class _Somebody:
    """A policy of another package, which gives what it likes."""

    settings = PolicySettings()

    def __init__(self, **changes):
        self._changes = changes

    def decide(self, problem):
        stop = {"stop": {"spread": 0.0, "gain": 0.0}}
        return replace(build_policy("grid", stop).decide(problem), **self._changes)


def steering(policy):
    return Steering(policy, ball(), WORKSPACE, 0.01, along_x(PLACES), box_hand())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"chosen": 3}, "action 3 with stop ''"),
        ({"chosen": 1}, "action 1 with stop ''"),  # it is not available
        ({"chosen": -1}, "action -1 with stop ''"),
        ({"stop": "gain"}, "action 0 with stop 'gain'"),
        ({"score": np.zeros(2)}, r"shapes \[\(2,\), .*; accepted"),
        ({"contacts": NOWHERE}, r"\(0, 3\)\]; accepted"),
    ],
)
def test_what_is_no_decision_is_refused(changes, message):
    available = np.array([True, False, True])
    with pytest.raises(ChselError, match=message):
        steering(_Somebody(**changes)).decide(0, KnownPoints(), None, available)


def test_a_floor_above_the_workspace_is_an_error():
    session = steering(build_policy("grid", {"belief": {"floor": 7.0}}))
    with pytest.raises(
        SettingError, match=r"policy\.belief\.floor is 7, above .*; accepted: .* null"
    ):
        session.decide(0, KnownPoints(), None, np.ones(3, dtype=bool))


def test_an_outcome_follows_a_choice():
    session = steering(_Somebody())
    with pytest.raises(ChselError, match="no action was chosen"):
        session.felt(NOWHERE)
    session.decide(0, KnownPoints(), None, np.ones(3, dtype=bool))
    assert not session.felt(NOWHERE)
    assert 0.0 < session.surprise < 6.0
