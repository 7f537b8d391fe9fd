"""How two recordings differ: event by event, each number to the bit."""

from __future__ import annotations

import filecmp
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from heapq import merge
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

from replay.comparing.differences import Difference, differences
from replay.comparing.event_differences import Content, content, event_name
from replay.mcap.reader import Recording, read_recording

BOTH, FIRST, SECOND = "both", "first", "second"


class Place(NamedTuple):
    """What two events have in common to be compared."""

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
    """All that differs between two recordings."""

    same_bytes: bool  # whether the files are equal
    counts: Counter[str] = field(default_factory=Counter)  # events on each topic in either
    differences: list[EventDifference] = field(default_factory=list)


def recording_diff(first: Path, second: Path, ignored: Sequence[str] = ()) -> RecordingDiff:
    """Compare two recordings, step by step.

    ignored: topics, such as "/timed", and fields with what is nested in them, such as
    "environment" or "config.seed". Raises RecordingError if a file cannot be read.
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
                found.differences += _differences(place, one, other, ignored)
    return found


def _steps(recording: Recording, side: int) -> Iterator[tuple[int, int, dict[Place, Content]]]:
    """What the events of each step say, by their places."""
    for step, events in groupby(recording.events(), lambda event: event.step):
        contents: dict[Place, Content] = {}
        numbers: Counter[tuple[str, int, str]] = Counter()
        for event in events:
            name = event_name(event)
            contents[Place(*name, numbers[name])] = content(event)
            numbers[name] += 1
        yield step, side, contents


def _differences(
    place: Place, first: Content | None, second: Content | None, ignored: Sequence[str]
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
