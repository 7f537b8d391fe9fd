"""Decision after decision: what a session does next, and how far it was surprised."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field
from typing import NamedTuple

import numpy as np

from chsel.errors import ChselError, SettingError, quoted, require_instance
from chsel.next_probe.decision_problem import Actions, Belief, Decision, DecisionProblem, HandShape
from chsel.next_probe.forecast import belief_after, belief_before, surprise
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.policies.policy import Policy
from chsel.problem.points import KnownPoints, Workspace, require_parts
from chsel.problem.registration_problem import Hypotheses
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey


class Choice(NamedTuple):
    """A decision with what determines it."""

    problem: DecisionProblem
    decision: Decision


@dataclass(eq=False, repr=False)
class Steering:
    """Chooses the actions of one session, by what its registrations find."""

    policy: Policy
    sdf: SdfGrid
    workspace: Workspace
    free_resolution: float  # voxel side of free space, metres
    actions: Actions
    hand: HandShape
    _: KW_ONLY
    seed: int = 0  # of the random streams
    last: Choice | None = field(default=None, init=False)  # the last decision
    surprise: float = field(default=0.0, init=False)  # of the last outcome, nats

    def __post_init__(self) -> None:
        if not callable(getattr(self.policy, "decide", None)):
            given = quoted(self.policy)
            raise SettingError(f"policy is {given}; accepted: chsel.build_policy(name)")
        require_parts(sdf=self.sdf, workspace=self.workspace)
        require_instance("actions", self.actions, Actions, "chsel.Actions(world_from_hand, length)")
        require_instance("hand", self.hand, HandShape, "chsel.HandShape.of(mesh)")

    def decide(
        self, done: int, points: KnownPoints, hypotheses: Hypotheses | None, available: BoolArray
    ) -> Choice:
        """What to do after so many probes, by the last result; None before there was one.

        points: all that are known. available (A,): the actions that can be taken now. Raises
        ChselError if the policy, of another package, gives something else than a decision.
        """
        require_parts(points=points)
        key = StreamKey(self.seed, done)
        belief = self.belief(points, hypotheses, key)
        trust = None if hypotheses is None else hypotheses.trust
        verdict = "" if trust is None else trust.verdict
        problem = DecisionProblem(
            self.sdf,
            points,
            workspace=self.workspace,
            free_resolution=self.free_resolution,
            belief=belief,
            actions=self.actions,
            available=available,
            hand=self.hand,
            key=key,
            verdict=verdict,
        )
        decision = self.policy.decide(problem)
        _check(problem, decision)
        self.last = Choice(problem, decision)
        return self.last

    def belief(self, points: KnownPoints, hypotheses: Hypotheses | None, key: StreamKey) -> Belief:
        """The poses that a decision weighs up.

        Raises SettingError before any registration if the floor is above the workspace.
        """
        settings = self.policy.settings.belief
        if hypotheses is None or len(hypotheses.cost) == 0:
            top = self.workspace.upper[2]
            if settings.floor is not None and settings.floor > top:
                raise SettingError(
                    f"policy.belief.floor is {settings.floor:g}, above the workspace; accepted: a "
                    f"height below its top at {top:g} m, or null"
                )
            return belief_before(self.sdf, points, self.workspace, key, settings)
        return belief_after(hypotheses, settings)

    def felt(self, contacts: FloatArray) -> bool:
        """Take note of the outcome of the chosen action; whether it starts registration afresh.

        contacts (C, 3): where the hand has met the object, the first one first; world frame. Raises
        ChselError if there was no action.
        """
        if self.last is None or self.last.decision.chosen < 0:
            raise ChselError("no action was chosen; accepted: an outcome after `decide` chose one")
        contact = np.asarray(contacts[0]) if len(contacts) else None
        settings = self.policy.settings
        self.surprise = surprise(*self.last, settings.noise, contact)
        return bool(self.surprise > settings.surprise.limit)


def _check(problem: DecisionProblem, decision: Decision) -> None:
    """Raise ChselError unless a decision is about this problem."""
    count, chosen = len(problem.actions), decision.chosen
    stops = decision.stop != "" and chosen == -1
    taken = decision.stop == "" and 0 <= chosen < count and bool(problem.available[chosen])
    arrays = "score", "hit_chance", "blocked_chance", "expected_spread", "contacts"
    shapes = [np.shape(getattr(decision, name)) for name in arrays]
    contacts = (len(problem.belief) if taken else 0, 3)
    if not (stops or taken) or shapes != [*[(count,)] * 4, contacts]:
        raise ChselError(
            f"the policy decided on action {chosen} with stop {decision.stop!r} and arrays of "
            f"shapes {shapes}; accepted: an available action, or -1 with a reason to stop, arrays "
            f"of shape ({count},) and contacts of shape {contacts}"
        )
