"""Actions and decisions of a steered session as the values of messages, both ways."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from chsel.errors import RecordingError
from chsel.next_probe.decision_problem import Actions, Belief, Decision, DecisionProblem, HandShape
from chsel.numerics.arrays import digest
from chsel.problem.points import KnownPoints
from chsel.problem.streams import StreamKey
from replay.events import ActionsOffered, Decided, SessionStarted
from replay.mcap.encoding import shared_arguments, shared_values
from replay.mcap.validation import check_digest


def offered_values(event: ActionsOffered) -> dict[str, Any]:
    """The message `Actions`."""
    return shared_values("Actions", event.actions) | {
        "step": event.step,
        "hand_vertices": event.hand.vertices,
        "hand_faces": event.hand.faces.astype(np.int32),
        "digest": _digest_of(event),
    }


def offered_from(values: Mapping[str, Any]) -> ActionsOffered:
    """The actions in a message; RecordingError unless they have their digest."""
    actions = Actions(**shared_arguments(Actions, values))
    hand = HandShape(values["hand_vertices"], values["hand_faces"])
    event = ActionsOffered(values["step"], actions, hand)
    check_digest("the actions offered", _digest_of(event), values["digest"])
    return event


def decision_values(event: Decided) -> dict[str, Any]:
    """The message `Decision`."""
    problem = event.problem
    return shared_values("Decision", event.decision) | {
        "step": event.step,
        "poses": problem.belief.object_from_world,
        "weights": problem.belief.weights,
        "available": problem.available,
        "key_seed": problem.key.seed,
        "key_step": problem.key.step,
        "problem_digest": problem.digest,
        "surprise": float(event.surprise),
    }


@dataclass(frozen=True, eq=False)
class RecordedDecision:
    """A decision without what its problem has of the events before it."""

    topic: ClassVar[str] = Decided.topic

    values: Mapping[str, Any]  # of the message `Decision`
    decision: Decision
    surprise: float  # nats

    @property
    def step(self) -> int:
        """Which it follows."""
        return int(self.values["step"])

    def check_actions(self, offered: ActionsOffered) -> None:
        """Raise RecordingError unless the decision is about as many actions as are offered."""
        about, count = len(self.values["score"]), len(offered.actions)
        if about != count:
            raise RecordingError(
                f"the decision of step {self.step} is about {about} actions, not the {count} "
                "offered"
            )

    def completed(
        self, start: SessionStarted, offered: ActionsOffered, points: KnownPoints
    ) -> Decided:
        """With its problem, from all points so far; RecordingError unless that was recorded."""
        self.check_actions(offered)
        values = self.values
        problem = DecisionProblem(
            sdf=start.sdf,
            points=points,
            workspace=start.workspace,
            free_resolution=start.free_resolution,
            belief=Belief(values["poses"], values["weights"]),
            actions=offered.actions,
            available=values["available"],
            hand=offered.hand,
            key=StreamKey(values["key_seed"], values["key_step"]),
        )
        what = f"the problem of the decision of step {self.step}"
        check_digest(what, problem.digest, values["problem_digest"])
        return Decided(self.step, problem, self.decision, self.surprise)


def decision_from(values: Mapping[str, Any]) -> RecordedDecision:
    """The decision in a message; RecordingError unless it has its digest."""
    step = values["step"]
    decision = Decision(**shared_arguments(Decision, values))
    check_digest(f"the decision of step {step}", decision.digest, values["digest"])
    return RecordedDecision(values, decision, values["surprise"])


def _digest_of(event: ActionsOffered) -> str:
    texts = event.actions.digest + event.hand.digest
    return digest(np.frombuffer(texts.encode(), dtype=np.uint8))
