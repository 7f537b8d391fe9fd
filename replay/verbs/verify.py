"""Run every registration of recordings again and compare hypotheses, costs and archives.

Decisions of steered sessions are made again and compared, too.

Status 0 if all bits are equal, 1 if not, 2 if a file cannot be used or holds no result.
"""

from __future__ import annotations

import argparse
import time

from chsel.numerics.threads import require_threads
from replay.comparing.verification import (
    DIFFERS,
    EQUAL,
    NO_RESULT,
    FileVerdict,
    recordings_in,
    verified_files,
)
from replay.console import Console, Progress, print_error


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Files, steps, processes."""
    parser.add_argument("files", nargs="+", metavar="FILE", help="recordings, or folders of them")
    parser.add_argument(
        "--step", type=int, action="append", metavar="K", help="this step alone; may be repeated"
    )
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes")


def run(given: argparse.Namespace) -> int:
    """Print a line for each file, and a report for each step that differs."""
    require_threads("--jobs", given.jobs)
    console = Console(soft_wrap=True)
    paths = recordings_in(given.files)
    begun, status, equal, total = time.perf_counter(), 0, 0, 0
    # One console for both, so that results are printed above the bar.
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("verifying", total=len(paths) if len(paths) > 1 else None)
        for file in verified_files(paths, given.step, jobs=given.jobs):
            progress.advance(task)
            _print(console, file)
            status = max(status, file.status)
            equal += file.equal
            total += len(file.registrations)
    if len(paths) > 1:
        rate = total / (time.perf_counter() - begun)
        console.print(
            f"{len(paths)} recordings: {equal} of {total} steps equal, {rate:.0f} steps/s"
        )
    return status


def _print(console: Console, file: FileVerdict) -> None:
    if file.unusable:
        print_error(file.unusable)
        return
    registrations = file.registrations
    compared = [verdict for verdict in registrations if verdict.outcome != NO_RESULT]
    methods = ", ".join(sorted({verdict.method for verdict in registrations})) or "no method"
    line = f"{file.path}: {file.equal} of {len(compared)} steps equal ({methods}), "
    if file.decisions:
        equal = sum(verdict.outcome == EQUAL for verdict in file.decisions)
        line += f"{equal} of {len(file.decisions)} decisions equal ({file.decisions[0].method}), "
    line += f"{file.seconds:.1f} s"
    without = len(registrations) - len(compared)
    if without:
        line += f", {without} without a result"
    if file.digest:
        line += f", digest {file.digest}"
    console.print(line)
    for verdict in file.verdicts:
        if verdict.outcome == DIFFERS:
            for line in verdict.report().split("\n"):
                console.print(line)
