"""Record today's results as the expected ones, after showing what changes and asking."""

from __future__ import annotations

import argparse
import math
import os
import sys
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.table import Table

from chsel.errors import RecordingError
from replay.blessing import Change, changes, write_blessed
from replay.console import Console
from replay.disk import sync_folder
from replay.file_verification import recordings_in
from replay.mcap.reader import read_recording
from replay.verification import environment_differences


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Files, and whether to ask."""
    parser.add_argument("files", nargs="+", metavar="FILE", help="recordings, or folders of them")
    parser.add_argument("--yes", action="store_true", help="do not ask")


def run(given: argparse.Namespace) -> int:
    """Bless file by file; status 1 if the answer was no."""
    paths = recordings_in(given.files)
    if not given.yes and not sys.stdin.isatty():
        raise RecordingError("nobody can be asked here; accepted: --yes")
    return max([_bless(path, ask=not given.yes) for path in paths])


def _bless(path: Path, *, ask: bool) -> int:
    console = Console(soft_wrap=True)
    recording = read_recording(path)
    new = path.with_name(f"{path.name}.{os.getpid()}.new")
    try:
        found = changes(recording, write_blessed(recording, new))
        differing = [change for change in found if not change.equal]
        if not differing:
            console.print(f"{path}: all {len(found)} results are as recorded, nothing to change")
            return 0
        console.print(_table(path, differing, len(found)))
        for line in environment_differences(recording.start):
            console.print(f"  {line}")
        if ask and console.input("record these results as the expected ones? [y/N] ") != "y":
            console.print(f"{path}: left as it was")
            return 1
        new.replace(path)
        sync_folder(path.parent)
        console.print(f"{path}: {len(differing)} of {len(found)} results are new")
        return 0
    finally:
        new.unlink(missing_ok=True)


def _table(path: Path, differing: list[Change], count: int) -> Table:
    title = f"{path}: {len(differing)} of {count} results change"
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    names = ["step", "up to", "best cost", "distinct", "best pose moves"]
    if differing[0].position_error is not None:
        names.append("its error to the true pose")
    if any(change.diversity for change in differing):
        names.append("PD, mm²")
    for name in names:
        table.add_column(name, justify="right")
    for change in differing:
        cells = [str(change.step), f"{change.ulps:.3g} ulp" if change.ulps else "stages alone"]
        cells.append(_pair(*(f"{cost:.5g}" for cost in change.best_cost)))
        cells.append(_pair(*map(str, change.distinct)))
        cells.append(_moved(change.position, change.rotation))
        if change.position_error and change.rotation_error:
            errors = zip(change.position_error, change.rotation_error, strict=True)
            cells.append(_pair(*(_moved(*error) for error in errors)))
        if change.diversity:
            cells.append(_pair(*(f"{number:.4g}" for number in change.diversity)))
        table.add_row(*cells)
    return table


def _pair(recorded: str, new: str) -> str:
    return recorded if recorded == new else f"{recorded} -> {new}"


def _moved(position: float, rotation: float) -> str:
    """Metres and radians for people."""
    return f"{1000.0 * position:.2f} mm {math.degrees(rotation):.2f}°"
