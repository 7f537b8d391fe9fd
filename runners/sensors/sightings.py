"""When a sensor's messages came, and in which frame and size."""

from __future__ import annotations

from array import array
from collections import Counter

import numpy as np

from chsel.numerics.arrays import IntArray
from runners.sensors.clocks import ClockCorrection
from runners.sensors.messages import (
    CloudMessage,
    ImageMessage,
    MarkerMessage,
    Received,
    WrenchMessage,
)

_LATE = 1.5  # median intervals after which an image is missing
_MOST_SIZES = 100
_NO_CONTENT = MarkerMessage("")


class Sightings:
    """The messages of one topic.

    frame: of the first. sizes: (H, W) of images, with how many had it.
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.frame: str | None = None
        self.sizes: Counter[tuple[int, int]] = Counter()
        self._log_times, self._stamps = array("q"), array("q")

    def add(self, received: Received, content: ImageMessage | CloudMessage | WrenchMessage) -> None:
        """Take note of one."""
        self._log_times.append(received.log_time)
        self._stamps.append(received.stamp or 0)
        self.frame = content.frame if self.frame is None else self.frame
        if isinstance(content, ImageMessage) and len(self.sizes) < _MOST_SIZES:
            height, width = content.values.shape
            self.sizes[height, width] += 1

    def __len__(self) -> int:
        return len(self._stamps)

    def times(self, clocks: ClockCorrection) -> IntArray:
        """Times (N,) of them, nanoseconds, ascending."""
        pairs = zip(self._log_times, self._stamps, strict=True)
        messages = (Received(self.topic, log, stamp or None, _NO_CONTENT) for log, stamp in pairs)
        return np.sort(np.array([clocks.time(message) for message in messages], dtype=np.int64))


def missing_images(times: IntArray) -> int:
    """About how many are missing between times (N,), ascending, of images at a steady rate."""
    intervals = np.diff(times)
    if len(intervals) < 2:
        return 0
    usual = float(np.median(intervals))
    if usual <= 0.0:
        return 0
    late = intervals[intervals > _LATE * usual]
    return int((np.rint(late / usual) - 1.0).sum())
