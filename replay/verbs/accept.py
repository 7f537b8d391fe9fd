"""Record today's results as the expected ones, after showing what changes and asking."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from rich.table import Table

from chsel.errors import RecordingError
from replay.comparing.acceptance import (
    ResultChange,
    decision_changes,
    result_changes,
    write_accepted,
)
from replay.comparing.verification import EQUAL, recordings_in
from replay.console import Console, plain_table
from replay.files import sync_folder
from replay.mcap.reader import read_recording


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Files, and whether to ask."""
    parser.add_argument("files", nargs="+", metavar="FILE", help="recordings, or folders of them")
    parser.add_argument("--yes", action="store_true", help="do not ask")


def run(given: argparse.Namespace) -> int:
    """Accept file by file; status 1 if the answer was no."""
    paths = recordings_in(given.files)
    if not given.yes and not sys.stdin.isatty():
        raise RecordingError("nobody can be asked here; accepted: --yes")
    return max([_accept(path, ask=not given.yes) for path in paths])


def _accept(path: Path, *, ask: bool) -> int:
    console = Console(soft_wrap=True)
    recording = read_recording(path)
    new = path.with_name(f"{path.name}.{os.getpid()}.new")
    try:
        accepted = write_accepted(recording, new)
        changes = result_changes(recording, accepted)
        decisions = decision_changes(recording, accepted)
        differing = [change for change in changes if change.verdict.outcome != EQUAL]
        others = [verdict for verdict in decisions if verdict.outcome != EQUAL]
        if not differing and not others:
            console.print(f"{path}: all {len(changes)} results are as recorded, nothing to change")
            return 0
        for verdict in [*(change.verdict for change in differing), *others]:
            for line in verdict.report().split("\n"):
                console.print(line)
        counts = f"{len(differing)} of {len(changes)} results"
        if decisions:
            counts += f" and {len(others)} of {len(decisions)} decisions"
        title = f"{path}: {counts} change"
        console.print(_table(title, differing) if differing else title)
        if ask and console.input("record these results as the expected ones? [y/N] ") != "y":
            console.print(f"{path}: left as it was")
            return 1
        new.replace(path)
        sync_folder(path.parent)
        console.print(f"{path}: {counts} are new")
        return 0
    finally:
        new.unlink(missing_ok=True)


def _table(title: str, changes: Sequence[ResultChange]) -> Table:
    """A row for each result that changes."""
    rows = [
        {
            "step": str(change.verdict.step),
            "up to": f"{change.verdict.largest_ulps:.3g} ulp",
            "best pose moves": _distance(*change.moved),
            **{name: _pair(shown, change) for name, shown in _NUMBERS.items()},
        }
        for change in changes
    ]
    names = [name for name in rows[0] if any(row[name] for row in rows)]
    table = plain_table(title, texts=names)
    for row in rows:
        table.add_row(*(row[name] for name in names))
    return table


def _pair(shown: Callable[[Mapping[str, float]], str], change: ResultChange) -> str:
    """A number of the recorded result and of the new one; empty where neither has it."""
    recorded, new = (shown(numbers) for numbers in (change.recorded, change.new))
    return recorded if recorded == new else f"{recorded or '-'} -> {new or '-'}"


def _distance(position: float, rotation: float) -> str:
    """Metres and radians for people."""
    return f"{1000.0 * position:.2f} mm {math.degrees(rotation):.2f}°"


def _error(numbers: Mapping[str, float]) -> str:
    if "best_position_error" not in numbers:
        return ""
    return _distance(numbers["best_position_error"], numbers["best_rotation_error"])


_NUMBERS: dict[str, Callable[[Mapping[str, float]], str]] = {
    "best cost": lambda numbers: f"{numbers['best_cost']:.5g}",
    "distinct": lambda numbers: f"{numbers['distinct_hypotheses']:.0f}",
    "error of the best": _error,
    "PD, mm²": lambda numbers: f"{numbers['diversity']:.4g}" if "diversity" in numbers else "",
}
"""Columns of the table, with what they show of a result."""
