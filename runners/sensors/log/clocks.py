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
_LEAST_STEP = 0.1  # s: images of a moving camera that are off by less are off by millimetres
_STEADY = 5  # messages before and after a step of a clock, which show that it is none of latency
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
        """Return log times (N,) and stamps (N,), 0: none, of a topic's messages, nanoseconds."""
        log_times, stamps = self._times.get(topic, (array("q"), array("q")))
        return np.array(log_times, dtype=np.int64), np.array(stamps, dtype=np.int64)

    def correction(self) -> ClockCorrection:
        """Return what must be added to the times of each topic, by all messages so far."""
        medians: dict[str, int] = {}
        several: dict[str, list[int]] = {}
        small_steps: dict[str, float] = {}  # seconds
        limit = round(self._rig.offset * _NANOSECONDS)
        for topic in self._times:
            log_times, stamps = (times[self.of(topic)[1] != 0] for times in self.of(topic))
            if len(stamps):
                offsets = clock_offsets(log_times, stamps, limit=limit)
                medians[topic] = offsets[0]
                if len(offsets) > 1:
                    several[topic] = offsets
                elif (step := largest_step(log_times, stamps)) != 0.0:
                    small_steps[topic] = step
        if self._rig.stamp == "log" or not medians:
            return ClockCorrection(by_log=True)
        ordered = sorted(medians.values())
        middle = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
        typical = min(middle, key=abs)  # the median; of two, the one nearer to the log's clock
        for topic, offsets in several.items():
            medians[topic] = min(offsets, key=lambda offset: abs(offset - typical))
        shifts = {
            topic: typical - median
            for topic, median in medians.items()
            if abs(typical - median) > limit
        }
        warnings = [
            f"the clock of {topic} is {_seconds(-shift)} other topics': its stamps are shifted"
            for topic, shift in sorted(shifts.items())
        ]
        warnings += [
            f"stamps on {topic} jump by {step:+.3g} s against the log's clock, which is less than "
            "clock.offset: they are used as they are; check the sender's clock, or set clock.offset"
            for topic, step in sorted(small_steps.items())
        ]
        steps = {}
        for topic, offsets in sorted(several.items()):
            known = np.array(offsets, dtype=np.int64)
            steps[topic] = known, medians[topic] + shifts.get(topic, 0) - known
            apart = ", ".join(f"{(one - offsets[0]) / _NANOSECONDS:+.4g} s" for one in offsets[1:])
            warnings.append(
                f"stamps on {topic} start again or jump against the log's clock, by {apart}: "
                "each part is shifted to when the log received it"
            )
        if abs(typical) <= limit:
            return ClockCorrection(shifts, steps=steps, warnings=tuple(warnings))
        alike = "" if steps else ", all alike"
        warnings.append(f"stamps are {_seconds(typical)} the log's clock{alike}")
        return ClockCorrection(shifts, typical, steps=steps, warnings=tuple(warnings))


@dataclass(frozen=True)
class ClockCorrection:
    """Times of messages by one clock."""

    shifts: dict[str, int] = field(default_factory=dict)
    """Nanoseconds to add to the stamps of topics that depart."""

    typical: int = 0  # ns to add to the log's times of messages without a stamp
    by_log: bool = False  # whether the log's times count for all
    steps: dict[str, tuple[IntArray, IntArray]] = field(default_factory=dict)
    """Of topics whose clock was set: offsets (K,) of stamps against the log's times, and what to
    add (K,) to stamps near each of them, nanoseconds."""

    warnings: tuple[str, ...] = ()  # what a user should know of the clocks

    def times(self, topic: str, log_times: Any, *, stamps: Any) -> IntArray:
        """Return when messages (N,) were true, nanoseconds: by their stamps, where possible."""
        logged, sent = np.asarray(log_times, np.int64), np.asarray(stamps, np.int64)
        if self.by_log:
            return logged
        shift: Any = self.shifts.get(topic, 0)
        if topic in self.steps:
            offsets, shifts = self.steps[topic]
            shift = shifts[np.abs((sent - logged)[..., None] - offsets).argmin(axis=-1)]
        times = np.where(sent == 0, logged + self.typical, sent + shift)
        return np.clip(times, 0, _END_OF_TIME)

    def time(self, received: Received) -> int:
        """Return when one message was true, nanoseconds."""
        return int(self.times(received.topic, received.log_time, stamps=received.stamp or 0))


def clock_offsets(log_times: IntArray, stamps: IntArray, *, limit: int) -> list[int]:
    """Return the offsets of stamps (N,) against the log's times (N,), nanoseconds, N > 0.

    Several if the sender's clock was set or started again, or senders have several, by more than
    `limit`: the stamps go back, or advance by more than the log does. Where they advance by less,
    messages came late, and their stamps are right.
    """
    offsets = stamps - log_times
    starts = [0, *(np.flatnonzero(np.abs(np.diff(offsets)) > limit) + 1).tolist()]
    clocks = np.zeros(len(offsets), dtype=np.int64)  # number of the clock of each message
    met: list[tuple[int, int]] = []  # typical offsets of runs of messages, and their clocks
    clock = 0
    count = 1  # of clocks
    alone = True  # whether the run before has a single message
    for start, end in zip(starts, [*starts[1:], len(offsets)], strict=True):
        typical = _lower_median(offsets[start:end])
        known = next((number for offset, number in met if abs(offset - typical) <= limit), None)
        if known is None and start > 0:
            sent = stamps[start] - stamps[start - 1]
            late = 0 <= sent <= log_times[start] - log_times[start - 1]
            # A single message from before may be one that was kept for whoever comes later.
            kept = alone and sent > 0
            if not late and not kept:
                clock, count = count, count + 1
        elif known is not None:
            clock = known
        if known is None:
            met.append((typical, clock))
        clocks[start:end] = clock
        alone = end - start == 1
    return [_lower_median(offsets[clocks == clock]) for clock in range(clocks.max() + 1)]


def largest_step(log_times: IntArray, stamps: IntArray) -> float:
    """Return the largest lasting step of stamps (N,) against the log's times (N,), seconds.

    0 if there is none: messages that come late have the same offset before them and after them, and
    a latency that varies is as large within the messages before and after as between them.
    """
    offsets = (stamps - log_times) / _NANOSECONDS
    changes = np.abs(np.diff(offsets))[_STEADY - 1 : -_STEADY + 1]
    if len(changes) == 0:
        return 0.0
    last = _STEADY - 1 + int(changes.argmax())  # before the step
    before = offsets[last + 1 - _STEADY : last + 1]
    after = offsets[last + 1 : last + 1 + _STEADY]
    step = float(np.median(after) - np.median(before))
    varies = max(float(np.ptp(before)), float(np.ptp(after)))
    return step if abs(step) > max(_LEAST_STEP, 3.0 * varies) else 0.0


def _lower_median(values: IntArray) -> int:
    return int(np.sort(values)[(len(values) - 1) // 2])


def _seconds(nanoseconds: float) -> str:
    side = "ahead of" if nanoseconds > 0 else "behind"
    return f"{abs(nanoseconds) / _NANOSECONDS:.3g} s {side}"


def in_time_order(
    messages: Iterable[Received], time_of: Callable[[Received], int]
) -> Iterator[tuple[int, Received]]:
    """Yield times and messages, by time; a message that is too late comes when it comes."""
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
