"""The times of probes, as markers in the log or the rig define them."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from chsel.errors import SettingError
from runners.sensors.rig import ProbeTimes
from runners.sensors.session_report import LogWarnings

_TEXT = re.compile(r"(begin|end)\s*(\d{1,6})?")
_STATE = re.compile(r"true|false|-?\d{1,6}")  # sent all the time: repeating it says nothing new
_SECOND = 1_000_000_000  # ns
_Span = tuple[int, int, int | None]  # begin, end, index of the probe, where it is given


@dataclass(frozen=True)
class ProbeWindow:
    """Times of a probe, nanoseconds."""

    step: int
    """Index of the probe."""

    opens: int
    """Time from which on measurements become known with this probe."""

    begin: int
    """First time at which contacts count."""

    end: int
    """Last time at which contacts count."""

    closes: int
    """Time before which measurements become known with this probe."""

    def holds(self, time: int) -> bool:
        """Return whether a time is between its begin and its end."""
        return self.begin <= time <= self.end


def marked_windows(
    markers: Iterable[tuple[int, str]], first: int, *, last: int, warnings: LogWarnings
) -> list[ProbeWindow]:
    """Return the probes of markers (time, text) in a log from `first` to `last`, if any.

    Texts are "begin N", "begin", "end N", "end", integers (below 0: end) and true or false. A begin
    ends the probe before it, unless it repeats its index. Other texts, and begins and ends that do
    not fit, are warnings.
    """
    spans: list[_Span] = []
    begun: tuple[int, int | None] | None = None
    for time, text in sorted(markers, key=lambda marker: marker[0]):
        text = text.strip().lower()
        state, match = _STATE.fullmatch(text), _TEXT.fullmatch(text)
        if state:
            begins = text != "false" and not text.startswith("-")
            index = int(text) if begins and text != "true" else None
        elif match:
            begins = match[1] == "begin"
            index = int(match[2]) if match[2] else None
        else:
            warnings.warn(f"a marker is {text[:40]!r}; accepted: begin N, end")
            continue
        repeats = begins and begun is not None and index == begun[1]
        if repeats and (state or index is not None):
            continue
        if begun is not None:
            spans.append((begun[0], time, begun[1]))
        if not state and begins == (begun is not None):
            warnings.warn(
                f"the marker {text!r} does not follow {'an end' if begins else 'a begin'}"
            )
        begun = (time, index) if begins else None
    if begun is not None:
        warnings.warn("the last probe has a begin and no end; the log's end ends it")
        spans.append((begun[0], max(last, begun[0]), begun[1]))
    return _windows(spans, first, last=last, warnings=warnings)


def timed_windows(
    probes: Sequence[ProbeTimes], first: int, *, last: int, warnings: LogWarnings
) -> list[ProbeWindow]:
    """Return the probes that a rig names by seconds since the first message.

    Raise SettingError unless each begins before its end and after the end of the one before.
    """
    spans: list[_Span] = []
    before = 0.0
    for index, times in enumerate(probes):
        if not before <= times.begin < times.end < 1e9:
            raise SettingError(
                f"probes[{index}] runs from {times.begin} to {times.end} s; accepted: a begin of "
                f"at least {before} s, and a later end"
            )
        before = times.end
        begin, end = (first + round(time * _SECOND) for time in (times.begin, times.end))
        if begin > last:
            warnings.warn(f"probe {index} begins after the end of the log")
        spans.append((begin, end, index))
    return _windows(spans, first, last=last, warnings=warnings)


def whole_log(first: int, last: int) -> list[ProbeWindow]:
    """Return all of a log as a single probe."""
    return [ProbeWindow(0, first, begin=first, end=last, closes=last + 1)]


def _windows(
    spans: list[_Span], first: int, *, last: int, warnings: LogWarnings
) -> list[ProbeWindow]:
    """Return windows of spans in order of time; count those whose indices do not rise from 0."""
    if not spans:
        return []
    steps = list(range(len(spans)))
    named = [index for _, _, index in spans if index is not None]
    if len(named) == len(spans) and all(a < b for a, b in itertools.pairwise(named)):
        steps = named
    elif named:
        warnings.warn(
            f"probes are marked {', '.join(map(str, named[:10]))}; as these do not rise, they are "
            f"counted from 0 to {len(spans) - 1}"
        )
    opens = [min(first, spans[0][0]), *(begin for begin, _, _ in spans[1:])]
    closes = [*opens[1:], max(last, spans[-1][1]) + 1]
    return [
        ProbeWindow(step, opened, begin=begin, end=end, closes=closed)
        for step, opened, (begin, end, _), closed in zip(steps, opens, spans, closes, strict=True)
    ]
