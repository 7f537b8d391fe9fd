"""Run several methods on exactly the same recorded problems, and judge all by one cost.

A problem is as it was recorded: its low-cost set E_l follows from what the recorded method found
before, so no method goes on from results of its own. Status 1 if a registration failed. With
--policies, what policies decide after recorded steps of a steered session.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn
from rich.table import Table

from chsel.errors import RecordingError, SettingError
from chsel.numerics.threads import require_threads, threads
from chsel.plausible.plausible_settings import DEFINITIONS
from chsel.problem.registration_problem import Hypotheses
from replay.arguments import STEPS_HELP, chosen_steps, path_argument
from replay.comparing.columns import PLAUSIBLE, Column, columns_in_table
from replay.comparing.comparison import (
    Outcome,
    common_cost,
    compared,
    medians,
    recorded_label,
)
from replay.comparing.contenders import METHODS_HELP, Contender, contenders
from replay.comparing.csv_file import write_csv
from replay.comparing.plausible import PlausibleSets
from replay.comparing.policy_choices import (
    POLICIES_HELP,
    choice_table,
    decision_problem,
    median_table,
    policy_choices,
    policy_contenders,
    write_choices,
)
from replay.console import Console, Progress, TextColumn, plain_table
from replay.files import require_folder, require_new
from replay.mcap.reader import Recording, read_recording

_FEW_STEPS = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The file, its steps, the methods with their settings, and what to save."""
    parser.add_argument("file", type=path_argument, metavar="FILE", help="a recording")
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument(
        "--policies",
        nargs="+",
        metavar="POLICY",
        help=f"{POLICIES_HELP}; after them KEY=VALUE for all policies that have the setting, or "
        "POLICY:KEY=VALUE for one",
    )
    which.add_argument(
        "--methods",
        nargs="+",
        metavar="METHOD",
        help=f"{METHODS_HELP}; after them KEY=VALUE for all methods that have the setting, or "
        "METHOD:KEY=VALUE for one",
    )
    parser.add_argument("--steps", metavar="STEPS", help=STEPS_HELP)
    parser.add_argument("--each", action="store_true", help="show every step, not medians alone")
    parser.add_argument(
        "--plausible",
        type=path_argument,
        metavar="FOLDER",
        help="plausible sets of `runners.plausible`; by default those beside the recording",
    )
    parser.add_argument(
        "--definition",
        default="default",
        metavar="NAME",
        help=f"which of them: {', '.join(DEFINITIONS)}",
    )
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="threads, 1 by default")
    parser.add_argument("--save-csv", type=path_argument, metavar="OUT", help="all numbers")
    parser.add_argument("--save-plot", type=path_argument, metavar="OUT", help="a png, svg or pdf")
    parser.add_argument("--save-rerun", type=path_argument, metavar="OUT", help="a Rerun recording")


def run(given: argparse.Namespace) -> int:
    """Print a table of medians, of all steps if wanted; 1 if a registration failed."""
    outputs = _checked_outputs(given)
    require_threads("--threads", given.threads)
    recording = read_recording(given.file)
    if given.policies:
        return _compare_policies(given, recording)
    if not recording.steps:
        raise RecordingError(f"recording {given.file} has no registration problem to compare on")
    steps = chosen_steps(given.steps, recording.steps)
    labels = [word for word in given.methods if "=" not in word]
    changes = [word for word in given.methods if "=" in word]
    methods = contenders(recording, labels, changes)
    sets = PlausibleSets(recording, given.plausible, given.definition)
    with threads(given.threads):
        outcomes = _outcomes(recording, methods, steps, sets)
    console = Console()
    cost = common_cost(recording)
    columns = columns_in_table({name for outcome in outcomes for name in outcome.numbers})
    for title, found in (
        (f"costs of all by {cost.name}", [c for c in columns if c.name not in PLAUSIBLE]),
        (
            f"plausible sets by definition {given.definition}",
            [c for c in columns if c.name in PLAUSIBLE],
        ),
    ):
        if found:
            each = given.each or len(steps) <= _FEW_STEPS
            _print_tables(console, title, found, outcomes, each=each)
    console.print(_legend(columns, given.threads))
    for method in methods:
        if method.changes:
            console.print(f"{method.label} with {', '.join(method.changes)}", soft_wrap=True)
        _print_bits(console, method, [o for o in outcomes if o.label == method.label])
    failed = [outcome for outcome in outcomes if outcome.failure]
    for outcome in failed:
        what = f"step {outcome.step}, {outcome.label}: {outcome.failure}"
        console.print(what, soft_wrap=True)
    if given.save_csv is not None:
        write_csv(given.save_csv, outcomes, methods, cost, given.definition)
    if given.save_plot is not None:
        from replay.comparing.plot import write_plot

        start = recording.start
        title = f"{start.object}, {start.session} session, seed {start.seed}, costs of all by "
        write_plot(given.save_plot, outcomes, title + cost.name)
    if given.save_rerun is not None:
        from replay.rerun.comparison_view import save_comparison

        save_comparison(given.save_rerun, recording, _results(recording, outcomes))
    for path in outputs:
        console.print(f"written: {path}", soft_wrap=True)
    return int(any(outcome.label != recorded_label(recording) for outcome in failed))


def _compare_policies(given: argparse.Namespace, recording: Recording) -> int:
    """Print what policies decide, each step or in medians; 1 if one cannot."""
    if any((given.plausible, given.save_plot, given.save_rerun)):
        raise SettingError("--policies writes tables alone; accepted: with --save-csv")
    if recording.offered is None:
        decision_problem(recording, 0)  # says so
    existing = sorted({*recording.decision_steps, *recording.steps})
    steps = chosen_steps(given.steps, existing)
    labels = [word for word in given.policies if "=" not in word]
    changes = [word for word in given.policies if "=" in word]
    policies = policy_contenders(recording, labels, changes)
    with threads(given.threads):
        choices = list(policy_choices(recording, policies, steps))
    console, offered = Console(), recording.offered
    assert offered is not None
    if given.each or len(steps) <= _FEW_STEPS:
        console.print(choice_table(offered.actions, choices, "each step, problems as recorded"))
    if len(steps) > 1:
        console.print(median_table(choices))
    for policy in policies:
        if policy.changes:
            console.print(f"{policy.label} with {', '.join(policy.changes)}", soft_wrap=True)
    failed = [choice for choice in choices if choice.failure]
    for choice in failed:
        console.print(f"step {choice.step}, {choice.label}: {choice.failure}", soft_wrap=True)
    if given.save_csv is not None:
        write_choices(given.save_csv, offered.actions, choices, policies)
        console.print(f"written: {given.save_csv}", soft_wrap=True)
    return int(bool(failed))


def _checked_outputs(given: argparse.Namespace) -> list[Path]:
    """The files to write. Raises before any work what would make it end in nothing."""
    paths = [path for path in (given.save_csv, given.save_plot, given.save_rerun) if path]
    for path in paths:
        require_new(path)
        require_folder(path)
        if paths.count(path) > 1:
            raise RecordingError(f"{path} is named twice; accepted: a file for each")
    if given.save_plot is not None:
        from replay.comparing.plot import require_picture

        require_picture(given.save_plot)
    return paths


def _outcomes(
    recording: Recording,
    methods: Sequence[Contender],
    steps: Sequence[int],
    plausible: PlausibleSets,
) -> list[Outcome]:
    waiting = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    outcomes = []
    with Progress(
        *columns, console=waiting, transient=True, disable=not waiting.is_terminal
    ) as progress:
        task = progress.add_task("registering", total=len(steps) * (len(methods) + 1))
        for outcome in compared(recording, methods, steps, common_cost(recording), plausible):
            outcomes.append(outcome)
            progress.update(task, advance=1, description=f"step {outcome.step}")
    return outcomes


def _print_tables(
    console: Console,
    what: str,
    columns: Sequence[Column],
    outcomes: Sequence[Outcome],
    *,
    each: bool,
) -> None:
    """A row for each step and method if wanted, and the medians over several steps."""
    steps = list(dict.fromkeys(outcome.step for outcome in outcomes))
    headings = [column.heading for column in columns]
    if each:
        table = plain_table(f"each step, {what}", texts=["step", "method"], numbers=headings)
        for step, of_step in groupby(outcomes, lambda outcome: outcome.step):
            for outcome in of_step:
                _add(table, [str(step), outcome.label], columns, outcome)
            table.add_section()
        console.print(table, "")
    if len(steps) > 1:
        some_failed = any(outcome.failure for outcome in outcomes)
        texts = ["method", "steps"] if some_failed else ["method"]
        title = f"medians over {len(steps)} steps, {what}"
        table = plain_table(title, texts=texts, numbers=headings)
        for label in dict.fromkeys(outcome.label for outcome in outcomes):
            found = [o for o in outcomes if o.label == label and not o.failure]
            cells = [label, str(len(found))][: len(texts)]
            _add(table, cells, columns, Outcome(0, label, None, medians(found)))
        console.print(table, "")


def _add(table: Table, texts: list[str], columns: Sequence[Column], outcome: Outcome) -> None:
    cells = [column.shown(outcome.numbers.get(column.name)) for column in columns]
    if outcome.failure:
        cells[0] = "failed"
    style = "dim" if outcome.label.startswith("recorded:") else ""
    table.add_row(*texts, *cells, style=style)


def _legend(columns: Sequence[Column], count: int) -> str:
    """What the numbers of a table are about."""
    text = "problems as recorded, with their E_0 and E_l; "
    if any(column.name.endswith("_error") for column in columns):
        text += "mm, °: to the true pose, modulo the object's symmetries, at its centre, "
        text += "of the best hypothesis by cost and of the nearest; "
    return text + f"ms: of one registration by {count} thread{'s' if count > 1 else ''}"


def _print_bits(console: Console, method: Contender, outcomes: Sequence[Outcome]) -> None:
    """Whether a method with the recorded settings gives what was recorded."""
    known = [outcome for outcome in outcomes if outcome.as_recorded is not None]
    other = [str(outcome.step) for outcome in known if not outcome.as_recorded]
    if not known:
        return
    text = f"{method.label} has the recorded settings: "
    if other:
        text += f"{len(other)} of {len(known)} results are not those recorded, at step "
        text += f"{', '.join(other)} (verify shows where)"
    else:
        text += f"its {len(known)} results are those recorded, to the bit"
    console.print(text, soft_wrap=True)


def _results(recording: Recording, outcomes: Sequence[Outcome]) -> dict[str, dict[int, Hypotheses]]:
    """Hypotheses by label and step; without the recorded ones if a method has them all again."""
    results: dict[str, dict[int, Hypotheses]] = {}
    for outcome in outcomes:
        if outcome.hypotheses is not None:
            results.setdefault(outcome.label, {})[outcome.step] = outcome.hypotheses
    again = {outcome.label for outcome in outcomes if outcome.as_recorded}
    again -= {outcome.label for outcome in outcomes if not outcome.as_recorded}
    if again:
        results.pop(recorded_label(recording), None)
    return results
