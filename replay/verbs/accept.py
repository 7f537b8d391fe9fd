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
from replay.comparing.acceptance import ResultChange, write_accepted
from replay.comparing.verification import DIFFERS, recordings_in
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
    new = path.with_name(f"{path.name}.{os.getpid()}.new")
    try:
        changes = write_accepted(read_recording(path), new)
        differing = [change for change in changes if change.verdict.outcome == DIFFERS]
        if not differing:
            console.print(f"{path}: all {len(changes)} results are as recorded, nothing to change")
            return 0
        for change in differing:
            for line in change.verdict.report().split("\n"):
                console.print(line)
        counts = f"{len(differing)} of {len(changes)} results"
        registrations = [change for change in differing if not change.verdict.is_decision]
        console.print(_table(f"{path}: {counts} change", registrations))
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
    """A row for each registration whose result changes."""
    table = plain_table(title, texts=["step", "up to", "best pose moves", *_NUMBERS])
    for change in changes:
        pairs = [(shown(change.recorded), shown(change.new)) for shown in _NUMBERS.values()]
        table.add_row(
            str(change.verdict.step),
            f"{change.verdict.largest_ulps:.3g} ulp",
            _distance(*change.moved),
            *(old if old == new else f"{old} -> {new}" for old, new in pairs),
        )
    return table


def _distance(position: float, rotation: float) -> str:
    """Metres and radians for people."""
    return f"{1000.0 * position:.2f} mm {math.degrees(rotation):.2f}°"


def _number(name: str, form: str) -> Callable[[Mapping[str, float]], str]:
    return lambda numbers: f"{numbers[name]:{form}}" if name in numbers else "-"


def _error(numbers: Mapping[str, float]) -> str:
    names = ("best_position_error", "best_rotation_error")
    return _distance(*(numbers[name] for name in names)) if names[0] in numbers else "-"


_NUMBERS = {
    "best cost": _number("best_cost", ".5g"),
    "distinct": _number("distinct_hypotheses", ".0f"),
    "error of the best": _error,
    "PD, mm²": _number("diversity", ".4g"),
}
"""Columns of the table, with what they show of a result."""
