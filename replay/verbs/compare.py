"""Run several methods on exactly the same recorded problems, and judge all by one cost.

A problem is as it was recorded: its low-cost set E_l follows from what the recorded method found
before, so no method goes on from results of its own. With --policies, what policies decide after
recorded steps of a steered session. Status 1 if one fails, or one with the recorded settings has
other bits.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from rich.progress import track
from rich.table import Table

from chsel.errors import ChselError, RecordingError, SettingError
from chsel.methods.method import Method
from chsel.next_probe.decision_problem import Actions, Decision
from chsel.numerics.threads import require_threads, threads
from chsel.plausible.plausible_settings import DEFINITIONS
from chsel.policies.policy import Policy
from chsel.problem.registration_problem import Hypotheses
from replay.arguments import STEPS_HELP, chosen_steps, path_argument
from replay.comparing.choices import LABELS_HELP, METHOD, POLICY, Choice, chosen
from replay.comparing.comparison import (
    COLUMNS,
    Column,
    Outcome,
    PlausibleSets,
    common_cost,
    compared,
    frame,
    recorded_label,
    write_csv,
)
from replay.console import Console, plain_table
from replay.files import new_file, require_folder, require_new
from replay.mcap.reader import Recording, read_recording

_POSE = ("x_m", "y_m", "z_m", "dx", "dy", "dz")
_OF_ACTIONS = ("score", "hit_chance", "blocked_chance", "expected_spread")
_PICTURES = (".png", ".svg", ".pdf")
_FEW_STEPS = 3
_PLAUSIBLE = ("coverage", "plausibility", "diversity")  # which have tables of their own


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the file, its steps, the methods with their settings, and what to save."""
    parser.add_argument("file", type=path_argument, metavar="FILE", help="a recording")
    which = parser.add_mutually_exclusive_group(required=True)
    for option, kind in (("--methods", "METHOD"), ("--policies", "POLICY")):
        text = f"{LABELS_HELP}; after them KEY=VALUE for all that have the setting, or "
        text += f"{kind}:KEY=VALUE for one"
        which.add_argument(option, nargs="+", metavar=kind, help=text)
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
    parser.add_argument(
        "-o", "--out", type=path_argument, help="record one method on one step: a new recording"
    )
    parser.add_argument("--save-csv", type=path_argument, metavar="OUT", help="all numbers")
    parser.add_argument("--save-plot", type=path_argument, metavar="OUT", help="a png, svg or pdf")
    parser.add_argument("--save-rerun", type=path_argument, metavar="OUT", help="a Rerun recording")


def run(given: argparse.Namespace) -> int:
    """Print a table of medians, of all steps if wanted."""
    outputs = _checked_outputs(given)
    require_threads("--threads", given.threads)
    recording = read_recording(given.file)
    with threads(given.threads):
        compare = _compare_policies if given.policies else _compare_methods
        status = compare(given, recording)
    for path in outputs:
        Console().print(f"written: {path}", soft_wrap=True)
    return status


def _compare_methods(given: argparse.Namespace, recording: Recording) -> int:
    if not recording.steps:
        raise RecordingError(f"recording {given.file} has no registration problem to compare on")
    steps = chosen_steps(given.steps, recording.steps)
    methods = chosen(recording, METHOD, words=given.methods)
    if given.out is not None and (len(steps), len(methods)) != (1, 1):
        raise SettingError("--out records one registration; accepted: with one method and one step")
    sets = PlausibleSets(recording, given.plausible, definition=given.definition)
    cost = common_cost(recording)
    found = compared(recording, methods, steps=steps, cost=cost, plausible=sets, out=given.out)
    waiting = Console(stderr=True)
    count = len(steps) * (len(methods) + 1)
    hidden = not waiting.is_terminal
    bar = track(found, "registering", count, console=waiting, transient=True, disable=hidden)
    outcomes = list(bar)
    rows = frame(outcomes, methods, cost=cost, definition=given.definition)
    console = Console()
    columns = {n: c for n, c in COLUMNS.items() if c.heading and rows[c.csv_name].notna().any()}
    others = [column for name, column in columns.items() if name not in _PLAUSIBLE]
    each = given.each or len(steps) <= _FEW_STEPS
    _print_tables(console, f"costs of all by {cost.name}", columns=others, rows=rows, each=each)
    plausible = [columns[name] for name in _PLAUSIBLE if name in columns]
    if plausible:
        what = f"plausible sets by definition {given.definition}"
        _print_tables(console, what, columns=plausible, rows=rows, each=each)
    console.print(
        "problems as recorded, with their E_0 and E_l; errors to the true pose modulo the "
        "object's symmetries, at its centre: of the best by cost, and of the nearest; ms: of one "
        f"registration by {given.threads} thread{'s' if given.threads > 1 else ''}"
    )
    other_bits = [_print_bits(console, choice, outcomes=outcomes) for choice in methods]
    _print_rest(console, methods, rows=rows)
    if given.save_csv is not None:
        write_csv(rows, given.save_csv)
    if given.save_plot is not None:
        start = recording.start
        title = f"{start.object}, {start.session} session, seed {start.seed}, costs of all by "
        write_plot(given.save_plot, rows, columns=list(columns.values()), title=title + cost.name)
    if given.save_rerun is not None:
        from replay.rerun.comparison_view import save_comparison

        save_comparison(given.save_rerun, recording, results=_results(recording, outcomes))
    ours = [o.failure for o in outcomes if o.label != recorded_label(recording)]
    return int(any(ours) or any(other_bits))


def _compare_policies(given: argparse.Namespace, recording: Recording) -> int:
    if any((given.plausible, given.out, given.save_plot, given.save_rerun)):
        raise SettingError("--policies writes tables alone; accepted: with --save-csv")
    require_steered(recording)
    steps = chosen_steps(given.steps, recording.decision_steps)
    policies = chosen(recording, POLICY, words=given.policies)
    rows = pd.DataFrame(policy_decisions(recording, policies, steps=steps))
    console = Console()
    if given.each or len(steps) <= _FEW_STEPS:
        console.print(_decision_table(rows))
    if len(steps) > 1:
        console.print(_decision_medians(rows))
    _print_rest(console, policies, rows=rows)
    if given.save_csv is not None:
        write_csv(rows, given.save_csv)
    return int(rows["failure"].any())


def _checked_outputs(given: argparse.Namespace) -> list[Path]:
    """Return the files to write. Raises before any work what would make it end in nothing."""
    paths = (given.out, given.save_csv, given.save_plot, given.save_rerun)
    outputs = [path for path in paths if path is not None]
    for path in outputs:
        require_new(path)
        require_folder(path)
        if outputs.count(path) > 1:
            raise RecordingError(f"{path} is named twice; accepted: a file for each")
    if given.save_plot is not None:
        import matplotlib  # noqa: F401, as it is an extra

        if given.save_plot.suffix.lower() not in _PICTURES:
            accepted = f"*{', *'.join(_PICTURES)}"
            raise SettingError(
                f"{given.save_plot} is not the name of a picture; accepted: {accepted}"
            )
    return outputs


def _print_tables(
    console: Console, what: str, *, columns: Sequence[Column], rows: pd.DataFrame, each: bool
) -> None:
    """Print a row for each step and method if wanted, and medians over several steps."""
    headings = [column.heading for column in columns]
    count = rows["step"].nunique()
    if each:
        table = plain_table(f"each step, {what}", texts=["step", "method"], numbers=headings)
        for _, row in rows.iterrows():
            _add(table, [str(row["step"]), row["label"]], columns=columns, row=row)
        console.print(table, "")
    if count > 1:
        title = f"medians over {count} steps, {what}"
        table = plain_table(title, texts=["method", "steps"], numbers=headings)
        for label, of_label in rows.groupby("label", sort=False):
            medians = of_label.median(numeric_only=True)
            _add(
                table, [label, str((of_label["failure"] == "").sum())], columns=columns, row=medians
            )
        console.print(table, "")


def _add(table: Table, texts: list[str], *, columns: Sequence[Column], row: pd.Series) -> None:
    cells = [_shown_number(row.get(column.csv_name), column.times) for column in columns]
    if row.get("failure"):
        cells[0] = "failed"
    table.add_row(*texts, *cells, style="dim" if "recorded: " in "".join(texts) else "")


def _shown_number(value: float | None, times: float = 1.0) -> str:
    return "-" if value is None or pd.isna(value) else f"{times * value:.3g}"


def _decision_table(rows: pd.DataFrame) -> Table:
    """Return a table of steps and policies: actions with start, direction and forecasts."""
    numbers = ("action", "start, mm", "along", "score", "hit\nchance", "then\nmm")
    title = "each step, problems as recorded; then: spread of the belief, expected after the action"
    table = plain_table(title, texts=["step", "policy"], numbers=numbers)
    for _, row in rows.iterrows():
        cells = ["failed" if row["failure"] else f"stop: {row['stop']}"]
        if row["chosen"] >= 0:
            start = " ".join(f"{1e3 * row[name]:.0f}" for name in ("x_m", "y_m", "z_m"))
            along = " ".join(f"{row[name]:.2f}" for name in ("dx", "dy", "dz"))
            cells = [f"{row['chosen']:.0f}", start, along]
            cells += [_shown_number(row[name]) for name in ("score", "hit_chance")]
            cells.append(_shown_number(row["expected_spread_m"], 1e3))
        name = row["label"].removeprefix("recorded: ")
        style = "" if name == row["label"] else "dim"
        table.add_row(str(row["step"]), name, *cells, style=style)
    return table


def _decision_medians(rows: pd.DataFrame) -> Table:
    """Return a row for each policy, over all steps."""
    numbers = ("steps", "as\nrecorded", "stops", "hit\nchance", "then\nmm")
    table = plain_table("medians of the chosen actions", texts=["policy"], numbers=numbers)
    for label, own in rows.groupby("label", sort=False):
        same = own["as_recorded"].dropna()
        table.add_row(
            str(label),
            str((own["failure"] == "").sum()),
            f"{int(same.sum())} of {len(same)}" if len(same) else "",
            str((own["chosen"] < 0).sum()),
            _shown_number(own["hit_chance"].median()),
            _shown_number(own["expected_spread_m"].median(), 1e3),
        )
    return table


def _print_bits(
    console: Console, choice: Choice[Method], *, outcomes: Sequence[Outcome]
) -> list[str]:
    """Say whether a method with the recorded settings gives what was recorded; steps if not."""
    known = [o for o in outcomes if o.label == choice.label and o.as_recorded is not None]
    other = [str(outcome.step) for outcome in known if not outcome.as_recorded]
    if known:
        text = f"its {len(known)} results are those recorded, to the bit"
        if other:
            text = f"{len(other)} of {len(known)} results are not those recorded, at step "
            text += f"{', '.join(other)} (verify shows where)"
        console.print(f"{choice.label} has the recorded settings: {text}", soft_wrap=True)
    return other


def _print_rest(console: Console, choices: Sequence[Choice[Any]], *, rows: pd.DataFrame) -> None:
    """Print the changes of settings, and what failed."""
    for choice in choices:
        if choice.changes:
            console.print(f"{choice.label} with {', '.join(choice.changes)}", soft_wrap=True)
    for _, row in rows[rows["failure"] != ""].iterrows():
        console.print(f"step {row['step']}, {row['label']}: {row['failure']}", soft_wrap=True)


def _results(recording: Recording, outcomes: Sequence[Outcome]) -> dict[str, dict[int, Hypotheses]]:
    """Return hypotheses by label and step; recorded ones only if no method has them all."""
    results: dict[str, dict[int, Hypotheses]] = {}
    for outcome in outcomes:
        if outcome.hypotheses is not None:
            results.setdefault(outcome.label, {})[outcome.step] = outcome.hypotheses
    repeated = {outcome.label for outcome in outcomes if outcome.as_recorded}
    repeated -= {outcome.label for outcome in outcomes if not outcome.as_recorded}
    if repeated:
        results.pop(recorded_label(recording), None)
    return results


def write_plot(path: Path, rows: pd.DataFrame, *, columns: Sequence[Column], title: str) -> None:
    """Write a new picture with a panel for every column over the steps, a line for each method.

    What failed, and costs that are infinite, are gaps.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    height = math.ceil(len(columns) / 4)
    figure = Figure(figsize=(13, 1.1 + 3.0 * height), layout="constrained")
    for place, column in enumerate(columns):
        axes = figure.add_subplot(height, min(4, len(columns)), place + 1)
        values = rows.pivot(index="step", columns="label", values=column.csv_name) * column.times
        values = values[rows["label"].unique()]
        for number, label in enumerate(values):
            line = ":" if number == 0 else "-"  # the recorded one
            axes.plot(values[label], line, marker="os^DvPX"[number % 7], alpha=0.8, label=label)
        axes.set_title(column.title, fontsize=10)
        axes.set_xlabel("step")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        positive = values.min().min() > 0.0
        axes.set_yscale("log" if positive and "cost" in column.title else "linear")
        axes.grid(color="#dddddd", linewidth=0.6)
    if columns:
        lines, labels = axes.get_legend_handles_labels()
        figure.legend(lines, labels, loc="outside lower center", ncols=min(len(labels), 5))
    figure.suptitle(title, fontsize=11, parse_math=False)
    with new_file(path) as beside:
        figure.savefig(beside, format=path.suffix.lower()[1:], dpi=120)


def policy_decisions(
    recording: Recording, policies: Sequence[Choice[Policy]], *, steps: Sequence[int]
) -> Iterator[dict[str, Any]]:
    """Yield a row for each step and policy, the recorded decision first; names have units.

    step, label, failure, changes (to the settings, with "; " between), chosen (action), stop,
    spread_m, then of the chosen action, where there is one, start (x_m to z_m), direction (dx to
    dz) and forecasts, and as_recorded, whether it is the recorded one.
    """
    built = [(choice, choice.build()) for choice in policies]
    group = recording.start.config.get("policy")
    name = group.get("name") if isinstance(group, dict) else None
    for step in steps:
        decided = recording.decision(step)
        actions = decided.problem.actions
        recorded = decided.decision
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
