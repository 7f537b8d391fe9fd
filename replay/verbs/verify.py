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
from replay.console import Console, print_error


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add files, steps, processes."""
    parser.add_argument("files", nargs="+", metavar="FILE", help="recordings, or folders of them")
    parser.add_argument(
        "--step", type=int, action="append", metavar="K", help="this step alone; may be repeated"
    )
    parser.add_argument(
        "--jobs", type=int, default=1, metavar="N", help="processes, a file in each"
    )


def run(given: argparse.Namespace) -> int:
    """Print a line for each file, and a report for each step that differs."""
    require_threads("--jobs", given.jobs)
    console = Console(soft_wrap=True)
    paths = recordings_in(given.files)
    begun = time.perf_counter()
    files = []
    for file in verified_files(paths, given.step, jobs=given.jobs):
        _print(console, file)
        files.append(file)
    if len(paths) > 1:
        outcomes = [v.outcome for file in files for v in file.compared(decisions=False)]
        equal = f"{outcomes.count(EQUAL)} of {len(outcomes)} steps equal"
        rate = len(outcomes) / (time.perf_counter() - begun)
        console.print(f"{len(paths)} recordings: {equal}, {rate:.0f} steps/s")
    return max(file.status for file in files)


def _print(console: Console, file: FileVerdict) -> None:
    if file.unusable:
        print_error(file.unusable)
        return
    parts = []
    for decisions, kind in ((False, "steps"), (True, "decisions")):
        found = file.compared(decisions=decisions)
        if found:
            equal = sum(verdict.outcome == EQUAL for verdict in found)
            parts.append(f"{equal} of {len(found)} {kind} equal ({found[0].name})")
    without = sum(verdict.outcome == NO_RESULT for verdict in file.verdicts)
    parts += [f"{file.seconds:.1f} s", f"{without} without a result" if without else ""]
    parts += [f"digest {file.digest}" if file.digest else ""]
    console.print(f"{file.path}: {', '.join(filter(None, parts))}")
    for verdict in file.verdicts:
        if verdict.outcome == DIFFERS:
            for line in verdict.report().split("\n"):
                console.print(line)
