"""Clocks of a robot's computers: times that can be compared, and messages in their order."""

from __future__ import annotations

import heapq
from array import array
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from runners.sensors.log.messages import CloudMessage, ImageMessage, Received, TransformMessage
from runners.sensors.rig import ClockRig

_NANOSECONDS = 1e9
_END_OF_TIME = 2**63 - 1
_MOST_KEPT = 2**16  # offsets of a topic


class Clocks:
    """Gathers the stamps of a log's messages, in the order in which they were read.

    Static transforms do not count: their stamps are of long ago, and hold for all times.
    """

    def __init__(self, rig: ClockRig) -> None:
        self._rig = rig
        self._offsets: dict[str, _Offsets] = {}
        self._last: int | None = None
        self._steps = {"ahead": 0, "back": 0}

    def add(self, received: Received) -> None:
        """Take note of one message."""
        step = 0 if self._last is None else received.log_time - self._last
        if abs(step) > self._rig.jump * _NANOSECONDS:
            self._steps["ahead" if step > 0 else "back"] += 1
        self._last = received.log_time
        content = received.content
        if received.stamp and not (isinstance(content, TransformMessage) and content.static):
            offsets = self._offsets.setdefault(received.topic, _Offsets())
            offsets.add(received.stamp - received.log_time)

    def correction(self) -> ClockCorrection:
        """What must be added to the stamps of each topic, by all messages so far."""
        if self._rig.stamp == "log" or not self._offsets:
            return ClockCorrection(by_log=True, warnings=tuple(self._step_remarks()))
        medians = {topic: offsets.median() for topic, offsets in self._offsets.items()}
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
        for topic, offsets in sorted(self._offsets.items()):
            count = offsets.departing(medians[topic], jump)
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
    """Times of messages by one clock. warnings: what a user should know of the clocks.

    shifts: nanoseconds to add, of topics that depart. medians: of the stamps less the log's times,
    by topic. typical: of all topics, 0 if small. jump: nanoseconds a stamp may be off at most.
    by_log: whether the log's times count for all.
    """

    shifts: dict[str, int] = field(default_factory=dict)
    medians: dict[str, int] = field(default_factory=dict)
    typical: int = 0
    jump: float = 0.0
    by_log: bool = False
    warnings: tuple[str, ...] = ()

    def of(self, topic: str) -> int:
        """Nanoseconds to add to a topic's stamps."""
        return self.shifts.get(topic, 0)

    def time(self, received: Received) -> int:
        """When a message was true, nanoseconds: by its stamp, where it has one that can be."""
        if self.by_log:
            return received.log_time
        usual = self.medians.get(received.topic)
        if not received.stamp or usual is None:
            time = received.log_time + self.typical
        elif abs(received.stamp - received.log_time - usual) > self.jump:
            time = received.log_time + usual + self.of(received.topic)
        else:
            time = received.stamp + self.of(received.topic)
        return min(max(time, 0), _END_OF_TIME)


class _Offsets:
    """Offsets of one topic, thinned out evenly so that they stay few."""

    def __init__(self) -> None:
        self._kept = array("q")
        self._every, self._count = 1, 0

    def add(self, offset: int) -> None:
        """Take note of one, nanoseconds."""
        if self._count % self._every == 0:
            self._kept.append(offset)
            if len(self._kept) > _MOST_KEPT:
                self._kept, self._every = self._kept[::2], 2 * self._every
        self._count += 1

    def median(self) -> int:
        """Of the offsets kept, the lower of two."""
        return int(np.sort(np.array(self._kept))[(len(self._kept) - 1) // 2])

    def departing(self, median: int, limit: float) -> int:
        """About how many lie further than a limit from the median."""
        away = np.abs(np.array(self._kept).astype(float) - float(median))
        return int((away > limit).sum()) * self._every


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
