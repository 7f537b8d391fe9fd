"""The first difference between two recordings, and a summary of all.

Status 0 if they say the same, 1 if not, 2 if a file cannot be used.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable

from rich.table import Table

from replay.arguments import path_argument
from replay.comparing.recording_diff import Ignored, RecordingDiff, TopicDiff, recording_diff
from replay.console import Console, plain_table

_SHOWN = 20
_MANY_ULPS = 10**6


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
        help="topics, attachments or fields to leave out, also of the status, such as environment",
    )


def run(given: argparse.Namespace) -> int:
    """Print the first difference, a table by topic, and the differences themselves."""
    ignored = Ignored(given.ignore)
    found = recording_diff(
        given.first, given.second, ignored=ignored, keep=None if given.all else 1
    )
    console = Console()
    but = f", leaving out {', '.join(given.ignore)}" if given.ignore else ""
    if found.same_bytes:
        console.print("equal to the byte")
        return 0
    if found.is_equal:
        console.print(f"equal in content{but}; the files differ in other bytes", soft_wrap=True)
        return 0
    first = f"first difference: {found.differences[0]}"
    console.print(first, soft_wrap=True)
    console.print(_table(found), "")
    equal = sum(topic.is_equal for topic in found.topics.values())
    console.print(f"{equal} of {len(found.topics)} topics and attachments are equal")
    if given.all:
        for item in found.differences:
            console.print(str(item), soft_wrap=True)
    else:
        _print_session(console, found)
    return 1


def _table(found: RecordingDiff) -> Table:
    """A row for each topic and attachment with a difference."""
    table = plain_table(
        texts=("topic", "steps", "fields"),
        numbers=("differ", "of", "only\nin A", "only\nin B", "largest\nulp"),
    )
    for name, topic in found.topics.items():
        if not topic.is_equal:
            counts = (topic.differing, topic.count, topic.only_first, topic.only_second)
            texts = (name, _ranges(topic.steps), _fields(topic))
            table.add_row(*texts, *map(str, counts), _largest(topic))
    return table


def _print_session(console: Console, found: RecordingDiff) -> None:
    """The settings and the environment that differ, beyond the line that was printed first."""
    of_start = [item for item in found.differences[1:] if item.key.topic == "/session"]
    for item in of_start[:_SHOWN]:
        console.print(str(item), soft_wrap=True)
    if len(of_start) > _SHOWN:
        console.print(f"{len(of_start) - _SHOWN} more on /session; --all lists every difference")


def _fields(topic: TopicDiff) -> str:
    """Names of fields, settings by their group alone, with the number of messages if not all."""
    counts: dict[str, int] = {}
    for path, count in topic.fields.items():
        name = path.split(".")[0].split("[")[0]
        counts[name] = max(counts.get(name, 0), count)
    return ", ".join(
        name if count == topic.differing else f"{name} ({count})" for name, count in counts.items()
    )


def _largest(topic: TopicDiff) -> str:
    if topic.largest_ulps is None:
        return "-"
    many = topic.largest_ulps >= _MANY_ULPS
    return f"{topic.largest_ulps:.1e}" if many else str(topic.largest_ulps)


def _ranges(steps: Iterable[int]) -> str:
    """Steps as "start, 3, 5..7"."""
    runs: list[list[int]] = []
    for step in sorted(steps):
        if runs and runs[-1][1] == step - 1 and runs[-1][0] >= 0:
            runs[-1][1] = step
        else:
            runs.append([step, step])
    names = [str(low) if low == high else f"{low}..{high}" for low, high in runs]
    return ", ".join("start" if name == "-1" else name for name in names)
