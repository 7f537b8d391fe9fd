"""What policies decide on the same recorded problems, as values, tables and CSV."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np
from rich.table import Table

from chsel.errors import ChselError, RecordingError, SettingError
from chsel.next_probe.decision_problem import Actions, Decision, DecisionProblem
from chsel.policies import POLICIES, policy_settings
from chsel.policies.steering import Steering
from chsel.problem.settings import settings_mapping
from chsel.problem.streams import StreamKey
from replay.comparing.contenders import changes_by_label
from replay.comparing.policies import NamedPolicy, other_policy, recorded_policy
from replay.console import plain_table
from replay.files import new_file
from replay.mcap.reader import Recording
from replay.registration import recorded_method

POLICIES_HELP = "NAME or NAME#MARK; the mark tells equal ones apart"
_LABEL = re.compile(r"(?P<name>[\w.-]+)(#(?P<mark>[\w.+-]+))?")


@dataclass(frozen=True, eq=False)
class PolicyContender:
    """A policy that takes part, with the changes that apply to it."""

    label: str
    named: NamedPolicy
    changes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class PolicyChoice:
    """What one policy, or the recording, decides after a step."""

    step: int
    label: str
    decision: Decision | None
    failure: str = ""  # why there is none
    as_recorded: bool | None = None  # whether the choice is that recorded; None if none was


def policy_contenders(
    recording: Recording, labels: Sequence[str], changes: Sequence[str] = ()
) -> tuple[PolicyContender, ...]:
    """Policies by their labels, such as "information" or "information#wide".

    A change "KEY=VALUE" applies to every policy that has the setting, "LABEL:KEY=VALUE" to one.
    Raises SettingError for a label or change that does not exist, or fits no policy.
    """
    names = {}
    for label in labels:
        match = _LABEL.fullmatch(label)
        if match is None or labels.count(label) > 1:
            what = "is not a policy" if match is None else "is named twice"
            raise SettingError(f"{label!r} {what}; accepted: {POLICIES_HELP}")
        names[label] = match["name"]
    if not names:
        raise SettingError(f"no policy is named; accepted: {', '.join(POLICIES)}")
    settings = {label: settings_mapping(policy_settings(name)) for label, name in names.items()}
    return tuple(
        PolicyContender(label, other_policy(recording, names[label], texts), tuple(texts))
        for label, texts in changes_by_label(labels, changes, settings, "policy").items()
    )


def decision_problem(recording: Recording, step: int) -> DecisionProblem:
    """The problem of the decision that follows a step.

    Where none was recorded, the belief is that of the step's registration, run again, and all
    actions are available that no recorded decision has chosen before. Raises RecordingError for a
    session that was not steered, and a step with neither a decision nor a registration.
    """
    if recording.offered is None:
        raise RecordingError(
            f"recording {recording.path} has no actions to choose from; accepted: a recording of "
            "a steered session"
        )
    if step in recording.decision_steps:
        return recording.decision(step).problem
    recording.checked_steps([step])
    posed, policy = recording.problem(step), recorded_policy(recording).policy
    hypotheses = recorded_method(recording).method.register(posed)
    actions, hand = recording.offered.actions, recording.offered.hand
    given = (posed.sdf, posed.workspace, posed.free_resolution)
    key = StreamKey(recording.seed, step + 1)
    belief = Steering(policy, *given, actions, hand).belief(posed.points, hypotheses, key)
    available = np.ones(len(actions), dtype=bool)
    for before in recording.decision_steps:
        chosen = recording.decision(before).decision.chosen
        if before < step and chosen >= 0:
            available[chosen] = False
    return DecisionProblem(
        posed.sdf,
        posed.points,
        posed.workspace,
        posed.free_resolution,
        belief,
        actions,
        available,
        hand,
        key,
    )


def policy_choices(
    recording: Recording, policies: Sequence[PolicyContender], steps: Sequence[int]
) -> Iterator[PolicyChoice]:
    """Choices step by step: the recorded one, then one of each policy in turn."""
    for step in steps:
        problem, recorded = decision_problem(recording, step), None
        if step in recording.decision_steps:
            recorded = recording.decision(step).decision
            label = f"recorded: {recorded_policy_name(recording)}"
            yield PolicyChoice(step, label, recorded)
        for policy in policies:
            try:
                made = policy.named.policy.decide(problem)
            except ChselError as error:
                yield PolicyChoice(step, policy.label, None, str(error))
                continue
            same = None if recorded is None else made.chosen == recorded.chosen
            yield PolicyChoice(step, policy.label, made, as_recorded=same)


def recorded_policy_name(recording: Recording) -> str:
    """The name of the policy that steered a session, whether or not it is installed."""
    config = recording.start.config.get("policy")
    return str(config.get("name", "unknown")) if isinstance(config, dict) else "unknown"


def choice_table(actions: Actions, choices: Sequence[PolicyChoice], title: str) -> Table:
    """A row for each choice: the action with start and direction, and what it promises."""
    numbers = ("action", "start, mm\nalong", "score", "hit\nchance", "then\nmm")
    table = plain_table(title, texts=["step", "policy"], numbers=numbers)
    table.columns[0].no_wrap = True
    for choice in choices:
        label, _, recorded = choice.label.partition(": ")
        style = "dim" if recorded else ""
        cells = _cells(actions, choice.decision) if choice.decision else ["failed", *[""] * 4]
        table.add_row(str(choice.step), label, *cells, style=style)
    table.caption = "then: spread of the belief, expected after the action; as it is at a stop"
    return table


def median_table(choices: Sequence[PolicyChoice]) -> Table:
    """A row for each policy, over all steps."""
    numbers = ("steps", "as\nrecorded", "stops", "hit\nchance", "then\nmm")
    table = plain_table("medians of the chosen actions", texts=["policy"], numbers=numbers)
    for label in dict.fromkeys(choice.label for choice in choices):
        of_label = [choice for choice in choices if choice.label == label]
        made = [choice.decision for choice in of_label if choice.decision is not None]
        chosen = [decision for decision in made if decision.chosen >= 0]
        known = [choice.as_recorded for choice in of_label if choice.as_recorded is not None]
        hits = [float(one.hit_chance[one.chosen]) for one in chosen]
        spreads = [1000.0 * float(one.expected_spread[one.chosen]) for one in chosen]
        table.add_row(
            label,
            str(len(made)),
            f"{sum(known)} of {len(known)}" if known else "",
            str(len(made) - len(chosen)),
            f"{median(hits):.2f}" if hits else "-",
            f"{median(spreads):.1f}" if spreads else "-",
        )
    return table


def write_choices(
    path: Path,
    actions: Actions,
    choices: Sequence[PolicyChoice],
    policies: Sequence[PolicyContender],
) -> None:
    """Write a new CSV file: a row for each step and policy; names end in their unit.

    x_m to z_m are the start of the chosen action, dx to dz its direction, empty where none is.
    """
    changes = {policy.label: "; ".join(policy.changes) for policy in policies}
    names = ("x_m", "y_m", "z_m", "dx", "dy", "dz")
    values = ("score", "hit_chance", "blocked_chance", "expected_spread")
    rows = []
    for choice in choices:
        row = {"step": choice.step, "label": choice.label, "failure": choice.failure}
        row |= {"changes": changes.get(choice.label, "")}
        row |= dict.fromkeys(("chosen", "stop", "spread_m", *names, *values), "")
        made = choice.decision
        if made is not None:
            row |= {"chosen": made.chosen, "stop": made.stop, "spread_m": made.spread}
        if made is not None and made.chosen >= 0:
            pose = actions.world_from_hand[made.chosen]
            row |= dict(zip(names, [*pose[:3, 3].tolist(), *pose[:3, 2].tolist()], strict=True))
            row |= {name: float(getattr(made, name)[made.chosen]) for name in values}
        row["expected_spread_m"] = row.pop("expected_spread")
        rows.append(row)
    with new_file(path) as beside, beside.open("x", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


def _cells(actions: Actions, made: Decision) -> list[str]:
    """Those of an action that is taken, or why none is."""
    index = made.chosen
    if index < 0:
        return [f"stop: {made.stop}", *["-"] * 3, f"{1000.0 * made.spread:.1f}"]
    pose = actions.world_from_hand[index]
    return [
        str(index),
        " ".join(f"{1000.0 * value:.0f}" for value in pose[:3, 3].tolist())
        + _direction(pose[:3, 2]),
        f"{made.score[index]:.3g}",
        f"{made.hit_chance[index]:.2f}",
        f"{1000.0 * made.expected_spread[index]:.1f}",
    ]


def _direction(axis: np.ndarray) -> str:
    """A unit vector (3,): " +x", or three numbers on a line of their own."""
    largest = int(np.abs(axis).argmax())
    if abs(axis[largest]) > 1.0 - 1e-9:
        return (" -" if axis[largest] < 0.0 else " +") + "xyz"[largest]
    return "\n" + " ".join(f"{value:.2f}" for value in axis.tolist())
