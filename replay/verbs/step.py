"""Register one recorded problem again, with another method or other settings; record that.

The new recording has all that the problem follows from, and names its source by digest. Status 1
if method and settings are the recorded ones and the result is not. With --policy nothing is
registered: a table shows what policies decide after the step, from what was known then.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.table import Table

from chsel.cost.compiled_cost import CompiledCost
from chsel.errors import SettingError
from chsel.methods import METHODS
from chsel.policies import POLICIES
from replay.arguments import path_argument
from replay.comparing.comparison import common_cost, numbers_under, recorded_label
from replay.comparing.policy_choices import (
    PolicyContender,
    choice_table,
    decision_problem,
    policy_choices,
    policy_contenders,
    recorded_policy_name,
)
from replay.comparing.step_again import StepAgain, register_step_again
from replay.console import Console, plain_table
from replay.files import require_new
from replay.mcap.reader import Recording, read_recording
from replay.registration import other_method
from replay.rerun.rerun_recorder import draw_recording


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The file, its step, the method with its settings, and what to write."""
    parser.add_argument("file", type=path_argument, metavar="FILE", help="a recording")
    parser.add_argument("--step", type=int, required=True, metavar="K", help="a recorded problem")
    parser.add_argument(
        "--method",
        nargs="+",
        default=[],
        metavar=("NAME", "KEY=VALUE"),
        help=f"one of {', '.join(METHODS)}, by default the recorded one; then settings such as "
        "cost.free_scale=40, or preset=NAME",
    )
    parser.add_argument(
        "--policy",
        nargs="+",
        action="append",
        default=[],
        metavar=("NAME", "KEY=VALUE"),
        help=f"one of {', '.join(POLICIES)}, then settings such as noise=0.01: what it decides "
        "after the step; may be repeated",
    )
    parser.add_argument(
        "-o",
        "--out",
        type=path_argument,
        help="a new file; else RECORDING_stepK_METHOD.mcap in this folder",
    )
    parser.add_argument(
        "--snapshot-interval",
        type=int,
        metavar="N",
        help="iterations between snapshots of the archive, 0 for first and last; else as recorded",
    )
    parser.add_argument(
        "--save-rerun", type=path_argument, metavar="RRD", help="also draw it: a new file"
    )


def run(given: argparse.Namespace) -> int:
    """Register, record, and print how the result compares with the recorded one."""
    if given.policy:
        return _decide(given)
    name, changes = _named(given.method)
    interval = given.snapshot_interval
    if interval is not None and interval < 0:
        raise SettingError(f"--snapshot-interval is {interval}; accepted: 0 or more")
    if given.save_rerun is not None:
        require_new(given.save_rerun)
    recording = read_recording(given.file)
    method = other_method(recording, name, changes)
    path = given.out or Path(f"{recording.path.stem}_step{given.step}_{method.name}.mcap")
    preset = next((text.partition("=")[2] for text in changes if text.startswith("preset=")), None)
    waiting = Console(stderr=True)
    with waiting.status(f"registering step {given.step} by {method.name}"):
        again = register_step_again(
            recording, given.step, method, path, preset=preset, interval=interval
        )
    console = Console()
    console.print(_table(recording, again))
    console.print(_verdict(again), soft_wrap=True)
    console.print(f"registered in {again.seconds:.2f} s")
    console.print(f"written: {path}", soft_wrap=True)
    if given.save_rerun is not None:
        draw_recording(again.recording, given.save_rerun)
        console.print(f"written: {given.save_rerun}", soft_wrap=True)
    return int(again.as_recorded and again.recorded is not None and not again.equal)


def _named(words: Sequence[str]) -> tuple[str | None, list[str]]:
    """The method's name, None for the recorded one, and the changes of its settings."""
    names = _names("method", words)
    return (names[0] if names else None), [word for word in words if "=" in word]


def _names(option: str, words: Sequence[str]) -> list[str]:
    """At most one name among words."""
    names = [word for word in words if "=" not in word]
    if len(names) > 1:
        raise SettingError(f"--{option} names {' and '.join(names)}; accepted: one, then KEY=VALUE")
    return names


def _decide(given: argparse.Namespace) -> int:
    """Print what policies decide after a step; 1 if one cannot."""
    others = (given.method, given.out, given.snapshot_interval, given.save_rerun)
    if any(other not in (None, []) for other in others):
        raise SettingError("--policy registers and writes nothing; accepted: with FILE and --step")
    recording = read_recording(given.file)
    policies: list[PolicyContender] = []
    for words in given.policy:
        names, changes = _names("policy", words), [word for word in words if "=" in word]
        if not names:
            raise SettingError(f"--policy {words[0]} names none; accepted: {', '.join(POLICIES)}")
        (made,) = policy_contenders(recording, names, changes)
        again = sum(policy.named.name == made.named.name for policy in policies)
        label = f"{made.label}#{again + 1}" if again and "#" not in made.label else made.label
        policies.append(dataclasses.replace(made, label=label))
    problem = decision_problem(recording, given.step)
    choices = list(policy_choices(recording, policies, [given.step]))
    console = Console()
    title = f"after step {given.step} by {recorded_policy_name(recording)}: "
    title += f"{len(problem.belief)} poses, "
    title += f"{int(problem.available.sum())} of {len(problem.actions)} actions available"
    console.print(choice_table(problem.actions, choices, title))
    for policy in policies:
        if policy.changes:
            console.print(f"{policy.label} with {', '.join(policy.changes)}", soft_wrap=True)
    for choice in choices:
        if choice.failure:
            console.print(f"{choice.label}: {choice.failure}", soft_wrap=True)
    return int(any(choice.failure for choice in choices))


def _table(recording: Recording, again: StepAgain) -> Table:
    """The recorded result and the new one, judged by one cost."""
    cost = common_cost(recording)
    judge = CompiledCost.of(again.problem, cost.settings)
    truth = recording.start.world_from_object is not None
    title = f"cost: {cost.name}"
    if truth:
        title += (
            "; errors to the true pose modulo the object's symmetries, at its centre: "
            "best hypothesis, closest one by its surface"
        )
    errors = ("mm", "°", "mm", "°") if truth else ()
    numbers = ("best cost", "median cost", "distinct", *errors)
    table = plain_table(title, texts=["method"], numbers=numbers)
    rows = {recorded_label(recording): again.recorded, again.recording.start.method: again.found}
    for label, found in rows.items():
        if found is not None:
            cells = _cells(numbers_under(judge, found, recording.start), truth=truth)
            table.add_row(label, *cells)
    return table


def _cells(numbers: Mapping[str, float], *, truth: bool) -> list[str]:
    costs = [numbers.get(name, math.nan) for name in ("best_cost", "median_cost")]
    cells = [*(f"{cost:.4g}" for cost in costs), f"{numbers['distinct']:.0f}"]
    for which in ("best", "closest") if truth else ():
        position = numbers.get(f"{which}_position_error", math.nan)
        rotation = numbers.get(f"{which}_rotation_error", math.nan)
        cells += [f"{1000.0 * position:.1f}", f"{math.degrees(rotation):.1f}"]
    return cells


def _verdict(again: StepAgain) -> str:
    """Whether the result has the recorded bits, and whether it should."""
    if again.recorded is None:
        return "no result was recorded to compare with"
    settings = "method and settings are the recorded ones"
    if again.equal:
        same = f"equal to the recorded result, every bit; digest {again.found.digest}"
        return f"{same}; {settings}" if again.as_recorded else same
    if again.as_recorded:
        return f"differs from the recorded result, though {settings}: `verify` says where"
    return "differs from the recorded result, as another method or other settings may"
