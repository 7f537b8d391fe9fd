"""The decisions of a steered session, for other programs."""

from __future__ import annotations

from typing import Any

import numpy as np

from replay.arguments import chosen_steps
from replay.content.export_files import Exported, require_any
from replay.events import Decided
from replay.mcap.reader import Recording

_OF_DECISIONS = ("score", "hit_chance", "blocked_chance", "expected_spread", "contacts")
_OF_THE_CHOSEN = ("score", "hit_chance", "blocked_chance", "expected_spread")


def exported_decisions(recording: Recording, steps: str | None) -> Exported:
    """The decisions of a steered session, one after each step, -1 for that before the first probe.

    npz: `steps` (S,); `actions/world_from_hand` (A, 4, 4), `actions/length` (A,), metres, and
    where it is known `actions/seconds` (A,); `step_K/chosen`, the index of the action taken, -1
    for none, `step_K/stop`, why, `step_K/spread`, metres, `step_K/surprise`, nats, of the outcome
    of probe K; `step_K/poses` (P, 4, 4), object_from_world, and `step_K/weights` (P,) of the
    belief; `step_K/available` (A,), `step_K/score` (A,), `step_K/hit_chance` (A,),
    `step_K/blocked_chance` (A,), `step_K/expected_spread` (A,), metres; `step_K/contacts` (P, 3),
    where the chosen action meets the object in each pose, NaN where it does not. csv: a row a
    decision; x, y, z (metres) are the start of the chosen action, dx, dy, dz its direction.
    """
    require_any(recording, "decision", recording.decision_steps)
    offered = recording.offered
    assert offered is not None  # as there is a decision
    chosen = chosen_steps(steps, recording.decision_steps)
    config = recording.start.config.get("policy")
    policy = str(config.get("name", "")) if isinstance(config, dict) else ""
    decided = [recording.decision(step) for step in chosen]
    actions = {
        "world_from_hand": offered.actions.world_from_hand,
        "length": offered.actions.length,
    }
    if offered.actions.seconds is not None:
        actions["seconds"] = offered.actions.seconds
    arrays: dict[str, Any] = {"steps": np.array(chosen, dtype=np.int64)}
    arrays |= {f"actions/{name}": array for name, array in actions.items()}
    listed = []
    for each in decided:
        parts = _parts(each)
        arrays |= {f"step_{each.step}/{name}": np.asarray(part) for name, part in parts.items()}
        listed.append({"step": each.step, **parts})
    document = {"policy": policy, "actions": actions, "decisions": listed}
    names = ("x", "y", "z", "dx", "dy", "dz")
    named = ("step", "policy", "chosen", *names, *_OF_THE_CHOSEN)
    header = (*named, "spread", "surprise", "stop")
    rows = (_row(each, policy) for each in decided)
    return Exported(arrays.items(), document, header, rows)


def _parts(each: Decided) -> dict[str, Any]:
    problem, decision = each.problem, each.decision
    return {
        "chosen": decision.chosen,
        "stop": decision.stop,
        "spread": decision.spread,
        "surprise": each.surprise,
        "poses": problem.belief.object_from_world,
        "weights": problem.belief.weights,
        "available": problem.available,
        **{name: getattr(decision, name) for name in _OF_DECISIONS},
    }


def _row(each: Decided, policy: str) -> tuple[Any, ...]:
    """Empty cells for the action of a decision that takes none."""
    decision = each.decision
    cells: list[Any] = [None] * (6 + len(_OF_THE_CHOSEN))
    if decision.chosen >= 0:
        pose = each.problem.actions.world_from_hand[decision.chosen]
        numbers = [float(getattr(decision, name)[decision.chosen]) for name in _OF_THE_CHOSEN]
        cells = [*pose[:3, 3].tolist(), *pose[:3, 2].tolist(), *numbers]
    ends = (decision.spread, each.surprise, decision.stop)
    return (each.step, policy, decision.chosen, *cells, *ends)
