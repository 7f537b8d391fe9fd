"""Clocks of a robot's computers: times that can be compared, and messages in their order."""

from __future__ import annotations

import heapq
from array import array
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from chsel.numerics.arrays import IntArray
from runners.sensors.log.messages import Received, TransformMessage
from runners.sensors.rig import ClockRig

_NANOSECONDS = 1e9
_END_OF_TIME = 2**63 - 1
SLACK = 1_000_000_000  # ns of the log's time that a message waits for those before it


class Clocks:
    """Gathers the times of a log's messages, in the order in which they were read.

    Static transforms do not count: their stamps are of long ago, and hold for all times.
    """

    def __init__(self, rig: ClockRig) -> None:
        self._rig = rig
        self._times: dict[str, tuple[array[int], array[int]]] = {}

    def add(self, received: Received) -> None:
        """Take note of one message."""
        content = received.content
        if not (isinstance(content, TransformMessage) and content.static):
            times = self._times.setdefault(received.topic, (array("q"), array("q")))
            times[0].append(received.log_time)
            times[1].append(received.stamp or 0)

    def of(self, topic: str) -> tuple[IntArray, IntArray]:
        """The log's times (N,) and stamps (N,), 0: none, of a topic's messages, nanoseconds."""
        log_times, stamps = self._times.get(topic, (array("q"), array("q")))
        return np.array(log_times, dtype=np.int64), np.array(stamps, dtype=np.int64)

    def correction(self) -> ClockCorrection:
        """What must be added to the times of each topic, by all messages so far."""
        medians = {}
        for topic in self._times:
            log_times, stamps = self.of(topic)
            offsets = np.sort((stamps - log_times)[stamps != 0])
            if len(offsets):
                medians[topic] = int(offsets[(len(offsets) - 1) // 2])
        if self._rig.stamp == "log" or not medians:
            return ClockCorrection(by_log=True)
        ordered = sorted(medians.values())
        middle = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
        typical = min(middle, key=abs)  # the median; of two, the one nearer to the log's clock
        limit = self._rig.offset * _NANOSECONDS
        shifts = {
            topic: typical - median
            for topic, median in medians.items()
            if abs(typical - median) > limit
        }
        warnings = [
            f"the clock of {topic} is {_seconds(-shift)} other topics': its stamps are shifted"
            for topic, shift in sorted(shifts.items())
        ]
        if abs(typical) <= limit:
            return ClockCorrection(shifts, warnings=tuple(warnings))
        warnings.append(f"stamps are {_seconds(typical)} the log's clock, all alike")
        return ClockCorrection(shifts, typical, warnings=tuple(warnings))


@dataclass(frozen=True)
class ClockCorrection:
    """Times of messages by one clock."""

    shifts: dict[str, int] = field(default_factory=dict)
    """Nanoseconds to add to the stamps of topics that depart."""

    typical: int = 0  # ns to add to the log's times of messages without a stamp
    by_log: bool = False  # whether the log's times count for all
    warnings: tuple[str, ...] = ()  # what a user should know of the clocks

    def times(self, topic: str, log_times: Any, stamps: Any) -> IntArray:
        """When messages (N,) were true, nanoseconds: by their stamps, where they can be."""
        logged, sent = np.asarray(log_times, np.int64), np.asarray(stamps, np.int64)
        if self.by_log:
            return logged
        times = np.where(sent == 0, logged + self.typical, sent + self.shifts.get(topic, 0))
        return np.clip(times, 0, _END_OF_TIME)

    def time(self, received: Received) -> int:
        """When one message was true, nanoseconds."""
        return int(self.times(received.topic, received.log_time, received.stamp or 0))


def _seconds(nanoseconds: float) -> str:
    side = "ahead of" if nanoseconds > 0 else "behind"
    return f"{abs(nanoseconds) / _NANOSECONDS:.3g} s {side}"


def in_time_order(
    messages: Iterable[Received], time_of: Callable[[Received], int]
) -> Iterator[tuple[int, Received]]:
    """Times and messages, by time; what comes too late for its place comes when it comes."""
    waiting: list[tuple[int, int, Received]] = []
    for count, message in enumerate(messages):
        heapq.heappush(waiting, (time_of(message), count, message))
        while message.log_time - waiting[0][2].log_time > SLACK:
            yield _popped(waiting)
    while waiting:
        yield _popped(waiting)


def _popped(waiting: list[tuple[int, int, Received]]) -> tuple[int, Received]:
    time, _, earliest = heapq.heappop(waiting)
    return time, earliest
