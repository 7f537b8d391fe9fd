"""Which time belongs to which probe, as markers in the log or the rig define it."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from chsel.errors import SettingError
from runners.sensors.rig import ProbeTimes
from runners.sensors.session_report import LogWarnings

_TEXT = re.compile(r"(begin|end)\s*(\d{1,6})?")
_INTEGER = re.compile(r"\s*(-?\d{1,6})\s*")
_SECOND = 1_000_000_000  # ns
_Span = tuple[int, int, int | None]


@dataclass(frozen=True)
class ProbeWindow:
    """Times of a probe, nanoseconds, in its clock.

    step: its index. opens, closes: what is sensed from `opens` to before `closes` becomes known
    with this probe. begin, end: contacts count within, both included.
    """

    step: int
    opens: int
    begin: int
    end: int
    closes: int

    def holds(self, time: int) -> bool:
        """Whether a time is between its begin and its end."""
        return self.begin <= time <= self.end


def marked_windows(
    markers: Iterable[tuple[int, str]], first: int, last: int, warnings: LogWarnings
) -> list[ProbeWindow]:
    """The probes of markers (time, text) in a log from `first` to `last`; there may be none.

    Texts are "begin N", "begin", "end N", "end", integers (below 0: end) and true or false.
    Other texts, and begins and ends that do not fit, are warnings.
    """
    spans: list[_Span] = []
    begun: tuple[int, int | None] | None = None
    for time, text in sorted(markers, key=lambda marker: marker[0]):
        marker = _parsed(text)
        if marker is None:
            warnings.warn(f"a marker is {text[:40]!r}; accepted: begin N, end")
        elif begun is None:
            if marker.begins:
                begun = time, marker.probe
            elif not marker.is_state:
                warnings.warn(f"{_name(marker.probe)} has an end and no begin; ignored")
        elif not marker.begins:
            begin, index = begun
            if None not in (marker.probe, index) and marker.probe != index:
                warnings.warn(f"the end of probe {marker.probe} is taken as that of probe {index}")
            spans.append((begin, time, index))
            begun = None
        elif marker.probe == begun[1] and (marker.is_state or marker.probe is not None):
            if not marker.is_state:
                warnings.warn(f"probe {marker.probe} begins twice without an end; taken as one")
        else:
            if not marker.is_state:
                warnings.warn(f"{_name(begun[1])} has a begin and no end; the next begin ends it")
            spans.append((begun[0], time, begun[1]))
            begun = time, marker.probe
    if begun is not None:
        warnings.warn(f"{_name(begun[1])} has a begin and no end; the log's end ends it")
        spans.append((begun[0], max(last, begun[0]), begun[1]))
    return _windows(spans, first, last, warnings)


def timed_windows(
    probes: Sequence[ProbeTimes], first: int, last: int, warnings: LogWarnings
) -> list[ProbeWindow]:
    """The probes that a rig names by seconds since the first message.

    Raises SettingError unless each begins before its end and after the end of the one before.
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
    return _windows(spans, first, last, warnings)


def whole_log(first: int, last: int) -> list[ProbeWindow]:
    """All of a log as a single probe."""
    return [ProbeWindow(0, first, first, last, last + 1)]


class _Marker(NamedTuple):
    begins: bool
    probe: int | None  # its index, where given
    is_state: bool  # sent all the time, so that repeating it says nothing new


def _parsed(text: str) -> _Marker | None:
    """The marker of a text; None if it is none."""
    lowered = text.strip().lower()
    if lowered in ("true", "false"):
        return _Marker(lowered == "true", None, True)
    number = _INTEGER.fullmatch(text)
    if number:
        value = int(number.group(1))
        return _Marker(value >= 0, value if value >= 0 else None, True)
    match = _TEXT.fullmatch(lowered)
    if match is None:
        return None
    return _Marker(match[1] == "begin", int(match[2]) if match[2] else None, False)


def _name(index: int | None) -> str:
    return "a probe" if index is None else f"probe {index}"


def _windows(spans: list[_Span], first: int, last: int, warnings: LogWarnings) -> list[ProbeWindow]:
    """Windows of spans (begin, end, index) in order of time; indices that do not rise are new."""
    named = [index for _, _, index in spans if index is not None]
    rising = all(a < b for a, b in itertools.pairwise(named))
    steps = list(range(len(spans)))
    if named and rising and len(named) == len(spans):
        steps = named
    elif named:
        warnings.warn(
            f"probes are marked {', '.join(map(str, named[:10]))}; as these do not rise, they are "
            f"counted from 0 to {len(spans) - 1}"
        )
    opens = [min(first, spans[0][0]) if k == 0 else span[0] for k, span in enumerate(spans)]
    closes = [*opens[1:], max(last, spans[-1][1]) + 1] if spans else []
    return [
        ProbeWindow(step, opened, begin, end, closed)
        for step, opened, (begin, end, _), closed in zip(steps, opens, spans, closes, strict=True)
    ]
