"""The decisions of a recorded session, made again, and how they differ from the recorded ones."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from chsel.errors import ChselError
from chsel.next_probe.decision_problem import Belief, Decision, DecisionProblem
from chsel.policies.steering import Choice, Steering
from chsel.problem.registration_problem import Hypotheses
from replay.comparing.differences import ulps
from replay.comparing.policies import recorded_policy
from replay.comparing.results import ResultDifferences
from replay.events import Decided, Probe
from replay.mcap.reader import Recording

_OF_ACTIONS = {
    "score": "score",
    "hit_chance": "hit chance",
    "blocked_chance": "chance of being blocked",
    "expected_spread": "expected spread",
}
"""Fields of a decision with a number for each action, and how reports name them."""


class DecisionsAgain:
    """Goes through the probes and decisions of a recording, with its policy.

    name: of the policy. surprise: of the outcome of the last probe, nats; None if it cannot be
    known, as the decision before it is lost. Raises RecordingError if the policy is not installed.
    """

    def __init__(self, recording: Recording) -> None:
        named, start, offered = recorded_policy(recording), recording.start, recording.offered
        assert offered is not None  # as every decision is about them
        self.name = named.name
        self.surprise: float | None = 0.0
        self._steering = Steering(
            named.policy,
            start.sdf,
            start.workspace,
            start.free_resolution,
            offered.actions,
            offered.hand,
        )
        self._before: Decided | None = None

    def remember(self, decided: Decided) -> None:
        """Let the next probe be the outcome of this decision."""
        self._before = decided
        self._steering.last = Choice(decided.problem, decided.decision)

    def probed(self, probe: Probe) -> int:
        """Take note of an outcome. How many times larger a first registration follows; else 0."""
        before, self.surprise = self._before, None
        if before is None or before.step != probe.step - 1:
            return 0
        forecast = len(before.decision.contacts) == len(before.problem.belief)
        if before.decision.chosen < 0 or not forecast:  # a stop, or of a policy without forecasts
            return 0
        afresh = self._steering.felt(probe.contacts)
        self.surprise = self._steering.surprise
        return int(self._steering.policy.settings.surprise.larger) if afresh else 0

    def belief(self, problem: DecisionProblem, hypotheses: Hypotheses | None) -> Belief:
        """What a decision weighs up after a result; None before there was one."""
        return self._steering.belief(problem.points, hypotheses, problem.key)

    def decide(self, problem: DecisionProblem) -> Decision:
        """The decision of today."""
        return self._steering.policy.decide(problem)

    def again(self, decided: Decided, hypotheses: Hypotheses | None) -> Decided:
        """A decision with today's belief, choice and surprise; hypotheses: the last result."""
        belief = self.belief(decided.problem, hypotheses)
        problem = dataclasses.replace(decided.problem, belief=belief)
        felt = decided.surprise if self.surprise is None else self.surprise
        return Decided(decided.step, problem, self.decide(problem), felt)

    def differences(
        self, decided: Decided, hypotheses: Hypotheses | None, *, known: bool
    ) -> ResultDifferences:
        """How a recorded decision differs from that made again of its problem.

        hypotheses: of the last registration, run again. known: whether it was.
        """
        problem = decided.problem
        try:
            belief = self.belief(problem, hypotheses) if known else problem.belief
            again = self.decide(problem)
        except ChselError as error:
            found = ResultDifferences()
            found.fail("deciding", f"the decision cannot be made again: {error}")
            return found
        felt = decided.surprise if self.surprise is None else self.surprise
        return decision_differences(decided, belief, again, felt)


def decision_differences(
    recorded: Decided, belief: Belief, again: Decision, surprise: float
) -> ResultDifferences:
    """How a recorded decision differs from another in belief, decision and surprise."""
    found, decision = ResultDifferences(), recorded.decision
    _add_belief(found, recorded.problem.belief, belief)
    found.add("the spread", {"spread": decision.spread}, {"spread": again.spread})
    for field, name in _OF_ACTIONS.items():
        _add_numbers(found, name, getattr(decision, field), getattr(again, field))
    for field, name in (("chosen", "the choice"), ("stop", "the reason to stop")):
        found.add(name, {field: getattr(decision, field)}, {field: getattr(again, field)})
    found.add("the contacts", {"contacts": decision.contacts}, {"contacts": again.contacts})
    found.add("the surprise", {"surprise": recorded.surprise}, {"surprise": surprise})
    return found


def _add_belief(found: ResultDifferences, recorded: Belief, again: Belief) -> None:
    one, other = (
        {"poses of the belief": belief.object_from_world, "weights": belief.weights}
        for belief in (recorded, again)
    )
    found.add("the belief", one, other)


def _add_numbers(found: ResultDifferences, name: str, recorded: Any, again: Any) -> None:
    """The numbers of all actions: a line names the first action whose number differs."""
    if recorded.shape != again.shape:
        text = f"{name} of {len(again)} actions, recorded of {len(recorded)}"
        found.fail(f"the {name}", text)
        return
    steps = ulps(recorded, again)
    differing = np.flatnonzero(steps)
    if len(differing) == 0:
        found.add_stage(f"the {name}", equal=True)
        return
    first = int(differing[0])
    now, then = _told_apart(float(again[first]), float(recorded[first]))
    more = f"; {len(differing) - 1} more differ" if len(differing) > 1 else ""
    line = f"{name} of action {first} is {now}, recorded {then}{more}"
    found.fail(f"the {name} of action {first}", line)
    found.largest_ulps = max(found.largest_ulps, int(steps.max()))


def _told_apart(one: float, other: float) -> tuple[str, str]:
    """Two numbers with as many digits as it takes to see that they differ."""
    for digits in (3, 6, 12):
        texts = f"{one:.{digits}g}", f"{other:.{digits}g}"
        if texts[0] != texts[1]:
            return texts
    return repr(one), repr(other)
