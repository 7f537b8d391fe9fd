"""Decision after decision: what surprises, and what a policy of somebody else may give."""

from dataclasses import replace

import numpy as np
import pytest

from chsel.errors import ChselError, SettingError
from chsel.policies import build_policy
from chsel.policies.policy import PolicySettings
from chsel.policies.steering import Steering
from chsel.problem.points import KnownPoints
from tests.chsel.next_probe.decisions import WORKSPACE, along_x, ball, box_hand

NOWHERE = np.zeros((0, 3))
PLACES = [(-0.06, 0.0), (0.06, 0.0), (0.0, 0.0)]


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
