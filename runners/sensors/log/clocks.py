"""Clocks of a robot's computers: times that can be compared, and messages in their order."""

from __future__ import annotations

import heapq
from array import array
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from chsel.numerics.arrays import IntArray
from runners.sensors.log.messages import CloudMessage, ImageMessage, Received, TransformMessage
from runners.sensors.rig import ClockRig

_NANOSECONDS = 1e9
_END_OF_TIME = 2**63 - 1


class Clocks:
    """Gathers the times of a log's messages, in the order in which they were read.

    Static transforms do not count: their stamps are of long ago, and hold for all times.
    """

    def __init__(self, rig: ClockRig) -> None:
        self._rig = rig
        self._times: dict[str, tuple[array[int], array[int]]] = {}
        self._last: int | None = None
        self._steps = {"ahead": 0, "back": 0}

    def add(self, received: Received) -> None:
        """Take note of one message."""
        step = 0 if self._last is None else received.log_time - self._last
        if abs(step) > self._rig.jump * _NANOSECONDS:
            self._steps["ahead" if step > 0 else "back"] += 1
        self._last = received.log_time
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
        """What must be added to the stamps of each topic, by all messages so far."""
        offsets = {}
        for topic in self._times:
            log_times, stamps = self.of(topic)
            if stamps.any():
                offsets[topic] = (stamps - log_times)[stamps != 0]
        if self._rig.stamp == "log" or not offsets:
            return ClockCorrection(by_log=True, warnings=tuple(self._step_remarks()))
        medians = {
            topic: int(np.sort(some)[(len(some) - 1) // 2]) for topic, some in offsets.items()
        }
        typical = _typical(list(medians.values()))
        limit, jump = self._rig.offset * _NANOSECONDS, self._rig.jump * _NANOSECONDS
        shifts = {
            topic: typical - median
            for topic, median in medians.items()
            if abs(typical - median) > limit
        }
        warnings = [
            f"the clock of {topic} is {_seconds(-shift)} other topics': its stamps are shifted"
            for topic, shift in sorted(shifts.items())
        ]
        for topic, some in sorted(offsets.items()):
            count = int((np.abs(some.astype(float) - medians[topic]) > jump).sum())
            if count:
                warnings.append(
                    f"{count} messages on {topic} have stamps more than {self._rig.jump:g} s off: "
                    "the log's times count for them"
                )
        if abs(typical) > limit:
            warnings.append(f"stamps are {_seconds(typical)} the log's clock, all alike")
        return ClockCorrection(
            shifts=shifts,
            medians=medians,
            typical=typical if abs(typical) > limit else 0,
            jump=jump,
            warnings=(*warnings, *self._step_remarks()),
        )

    def _step_remarks(self) -> list[str]:
        return [
            f"the log's time steps {way} by more than {self._rig.jump:g} s, {count} times"
            for way, count in self._steps.items()
            if count
        ]


@dataclass(frozen=True)
class ClockCorrection:
    """Times of messages by one clock."""

    shifts: dict[str, int] = field(default_factory=dict)
    """Nanoseconds to add, of topics that depart."""

    medians: dict[str, int] = field(default_factory=dict)  # of stamps less the log's times, ns
    typical: int = 0  # of all topics, ns; 0 if small
    jump: float = 0.0  # ns by which a stamp may be off at most
    by_log: bool = False  # whether the log's times count for all
    warnings: tuple[str, ...] = ()  # what a user should know of the clocks

    def times(self, topic: str, log_times: Any, stamps: Any) -> IntArray:
        """When messages (N,) were true, nanoseconds: by their stamps, where they can be."""
        logged, sent = np.asarray(log_times, np.int64), np.asarray(stamps, np.int64)
        if self.by_log:
            return logged
        usual, shift = self.medians.get(topic), self.shifts.get(topic, 0)
        times = logged + self.typical
        if usual is not None:
            is_off = np.abs((sent - logged).astype(float) - usual) > self.jump
            by_stamp = np.where(is_off, logged + (usual + shift), sent + shift)
            times = np.where(sent == 0, times, by_stamp)
        return np.clip(times, 0, _END_OF_TIME)

    def time(self, received: Received) -> int:
        """When one message was true, nanoseconds."""
        return int(self.times(received.topic, received.log_time, received.stamp or 0))


def _typical(medians: list[int]) -> int:
    """The median; of two in the middle the one that is nearer to the log's clock."""
    ordered = sorted(medians)
    lower, upper = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
    return min(lower, upper, key=abs)


def _seconds(nanoseconds: float) -> str:
    side = "ahead of" if nanoseconds > 0 else "behind"
    return f"{abs(nanoseconds) / _NANOSECONDS:.3g} s {side}"


SLACK = 1_000_000_000  # ns of the log's time that a message waits for those before it
MOST_BYTES = 256 * 2**20  # of waiting messages


def in_time_order(
    messages: Iterable[Received], time_of: Callable[[Received], int]
) -> Iterator[tuple[int, Received]]:
    """Times and messages, by time; what comes too late for its place comes when it comes."""
    waiting: list[tuple[int, int, Received]] = []
    held = 0
    for count, message in enumerate(messages):
        heapq.heappush(waiting, (time_of(message), count, message))
        held += _bytes(message)
        while waiting and (message.log_time - waiting[0][2].log_time > SLACK or held > MOST_BYTES):
            time, _, earliest = heapq.heappop(waiting)
            held -= _bytes(earliest)
            yield time, earliest
    while waiting:
        time, _, earliest = heapq.heappop(waiting)
        yield time, earliest


def _bytes(message: Received) -> int:
    if isinstance(message.content, ImageMessage):
        return message.content.values.nbytes
    return message.content.points.nbytes if isinstance(message.content, CloudMessage) else 1000
