"""The first difference between two recordings, and a summary of all.

Status 0 if they say the same, 1 if not, 2 if a file cannot be used.
"""

from __future__ import annotations

import argparse
import filecmp
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from heapq import merge
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

from rich.table import Table

from replay.arguments import path_argument
from replay.comparing.differences import Content, Difference, content, differences, event_name
from replay.console import Console, plain_table
from replay.mcap.reader import Recording, read_recording

BOTH = "both"
FIRST = "first"
SECOND = "second"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add two files, and what to leave out."""
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
    found = recording_diff(given.first, given.second, ignored=given.ignore)
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
    """Return a row for each topic with a difference."""
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


class Place(NamedTuple):
    """The place of an event, which is that of the event that it is compared with."""

    topic: str
    step: int
    about: str  # see `event_name`
    number: int  # counts events with the same rest

    def __str__(self) -> str:
        parts = [self.topic, "start" if self.step < 0 else f"step {self.step}"]
        parts += [self.about] if self.about else []
        return ", ".join([*parts, f"number {self.number + 1}"] if self.number else parts)


@dataclass(frozen=True, kw_only=True)
class EventDifference(Difference):
    """A field that differs between two events, or an event that one recording alone has."""

    place: Place
    having: str = BOTH  # which of the recordings have the event: "both", "first" or "second"

    def __str__(self) -> str:
        return f"{self.place}: {self.text}"


@dataclass
class RecordingDiff:
    """The differences between two recordings."""

    same_bytes: bool  # whether the files are equal
    counts: Counter[str] = field(default_factory=Counter)  # events on each topic in either
    differences: list[EventDifference] = field(default_factory=list)


def recording_diff(first: Path, second: Path, *, ignored: Sequence[str] = ()) -> RecordingDiff:
    """Compare two recordings, step by step.

    ignored: topics, such as "/timed", and fields with what is nested in them, such as
    "environment" or "config.seed". Raise RecordingError if a file cannot be read.
    """
    recordings = [read_recording(path) for path in (first, second)]
    found = RecordingDiff(filecmp.cmp(recordings[0].path, recordings[1].path, shallow=False))
    if found.same_bytes:
        return found
    steps = (_steps(recording, side) for side, recording in enumerate(recordings))
    together = merge(*steps, key=lambda part: part[:2])
    for _, sides in groupby(together, lambda part: part[0]):
        events: list[dict[Place, Content]] = [{}, {}]
        for _, side, contents in sides:
            events[side] = contents
        for place in dict.fromkeys([*events[0], *events[1]]):
            if place.topic.strip("/") not in {word.strip("/") for word in ignored}:
                found.counts[place.topic] += 1
                one, other = (of.get(place) for of in events)
                found.differences += _differences(place, one, second=other, ignored=ignored)
    return found


def _steps(recording: Recording, side: int) -> Iterator[tuple[int, int, dict[Place, Content]]]:
    """Yield the contents of the events of each step, by their places."""
    for step, events in groupby(recording.events(), lambda event: event.step):
        contents: dict[Place, Content] = {}
        numbers: Counter[tuple[str, int, str]] = Counter()
        for event in events:
            name = event_name(event)
            contents[Place(name[0], name[1], about=name[2], number=numbers[name])] = content(event)
            numbers[name] += 1
        yield step, side, contents


def _differences(
    place: Place, first: Content | None, *, second: Content | None, ignored: Sequence[str]
) -> list[EventDifference]:
    if first is None or second is None:
        having = SECOND if first is None else FIRST
        text = f"only in the {having} recording"
        return [EventDifference(place=place, having=having, field="", text=text)]
    return [
        EventDifference(place=place, **vars(item))
        for item in differences(first, second)
        if not any(f"{item.field}.".startswith((f"{word}.", f"{word}[")) for word in ignored)
    ]
