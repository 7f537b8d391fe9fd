"""What policies decide on the same recorded problems of a steered session."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from chsel.errors import ChselError, RecordingError
from chsel.next_probe.decision_problem import Actions, Decision
from chsel.policies.policy import Policy
from replay.comparing.choices import Choice
from replay.mcap.reader import Recording

_POSE = ("x_m", "y_m", "z_m", "dx", "dy", "dz")
_OF_ACTIONS = ("score", "hit_chance", "blocked_chance", "expected_spread")


def policy_decisions(
    recording: Recording, policies: Sequence[Choice[Policy]], steps: Sequence[int]
) -> Iterator[dict[str, Any]]:
    """A row of a table for each step and policy, the recorded decision first; with their units.

    step, label, failure, changes (to the settings, with "; " between), chosen (action), stop,
    spread_m, then of the chosen action, where there is one, start (x_m to z_m), direction (dx to
    dz) and forecasts, and as_recorded, whether it is the recorded one.
    """
    built = [(choice, choice.build()) for choice in policies]
    group = recording.start.config.get("policy")
    name = group.get("name") if isinstance(group, dict) else None
    for step in steps:
        decided = recording.decision(step)
        actions, recorded = decided.problem.actions, decided.decision
        first = {"step": step, "label": f"recorded: {name}", "failure": "", "changes": ""}
        yield first | _cells(actions, recorded) | {"as_recorded": None}
        for choice, policy in built:
            row = first | {"label": choice.label, "changes": "; ".join(choice.changes)}
            try:
                decision = policy.decide(decided.problem)
            except ChselError as error:
                yield row | {"failure": str(error)}
            else:
                same = decision.chosen == recorded.chosen
                yield row | _cells(actions, decision) | {"as_recorded": same}


def require_steered(recording: Recording) -> None:
    """Raise RecordingError unless a recording has decisions."""
    if not recording.decision_steps:
        raise RecordingError(
            f"recording {recording.path} has no actions to choose from; accepted: a recording of "
            "a steered session"
        )


def _cells(actions: Actions, decision: Decision) -> dict[str, Any]:
    chosen = decision.chosen
    row = {"chosen": chosen, "stop": decision.stop, "spread_m": decision.spread}
    if chosen >= 0:
        pose = actions.world_from_hand[chosen]
        row |= dict(zip(_POSE, [*pose[:3, 3], *pose[:3, 2]], strict=True))
        values = {name: float(getattr(decision, name)[chosen]) for name in _OF_ACTIONS}
        row |= values | {"expected_spread_m": values.pop("expected_spread")}
    return row
