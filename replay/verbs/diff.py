"""The first difference between two recordings, and a summary of all.

Status 0 if they say the same, 1 if not, 2 if a file cannot be used.
"""

from __future__ import annotations

import argparse
from collections import Counter

from rich.table import Table

from replay.arguments import path_argument
from replay.comparing.recording_diff import BOTH, FIRST, SECOND, RecordingDiff, recording_diff
from replay.console import Console, plain_table


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Two files, and what to leave out."""
    parser.add_argument("first", type=path_argument, metavar="A", help="a recording")
    parser.add_argument("second", type=path_argument, metavar="B", help="another one")
    parser.add_argument("--all", action="store_true", help="list every difference")
    parser.add_argument(
        "--ignore",
        nargs="+",
        default=[],
        action="extend",
        metavar="NAME",
        help="topics or fields to leave out, also of the status, such as environment",
    )


def run(given: argparse.Namespace) -> int:
    """Print the first difference, a table by topic, and the differences themselves."""
    found = recording_diff(given.first, given.second, given.ignore)
    console = Console(soft_wrap=True)
    if not found.differences:
        but = f", leaving out {', '.join(given.ignore)}" if given.ignore else ""
        equal = f"equal in content{but}; the files differ in other bytes"
        console.print("equal to the byte" if found.same_bytes else equal)
        return 0
    console.print(f"first difference: {found.differences[0]}")
    console.print(_table(found), "")
    same = len(set(found.counts) - {item.place.topic for item in found.differences})
    console.print(f"{same} of {len(found.counts)} topics are equal")
    of_start = [item for item in found.differences[1:] if item.place.topic == "/session"]
    for item in found.differences if given.all else of_start:
        console.print(str(item))
    return 1


def _table(found: RecordingDiff) -> Table:
    """A row for each topic with a difference."""
    table = plain_table(
        texts=("topic", "steps", "fields"),
        numbers=("differ", "of", "only\nin A", "only\nin B", "largest\nulp"),
    )
    for topic, count in found.counts.items():
        own = [item for item in found.differences if item.place.topic == topic]
        if own:
            having = Counter({item.place: item.having for item in own}.values())
            steps = ("start" if step < 0 else str(step) for step in {i.place.step: 0 for i in own})
            names = dict.fromkeys(item.field.split(".")[0].split("[")[0] for item in own)
            ulps = max((item.ulps for item in own if item.ulps is not None), default=None)
            table.add_row(
                topic,
                ", ".join(steps),
                ", ".join(filter(None, names)),
                *(str(number) for number in (having[BOTH], count, having[FIRST], having[SECOND])),
                "-" if ulps is None else f"{ulps:.3g}",
            )
    return table
