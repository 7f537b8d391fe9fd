"""What a first pass over a log gathers: times, camera infos, markers, units, first images."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from chsel.errors import SessionError
from chsel.numerics.arrays import IntArray
from chsel.sensing.depth_camera import valid_pixels
from runners.sensors.depth_camera import metres
from runners.sensors.log.clocks import ClockCorrection, Clocks
from runners.sensors.log.messages import (
    CameraInfoMessage,
    CloudMessage,
    ImageMessage,
    MarkerMessage,
    Received,
    WrenchMessage,
)
from runners.sensors.log.motion import Movements
from runners.sensors.log.raw_log import RawLog
from runners.sensors.rig import BubbleRig, CameraRig, Rig

_LATE = 1.5  # median intervals after which an image is missing
_MOST_SIZES = 100
_NO_CONTENT = MarkerMessage("")


class MessageTimes:
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


_LEAST_WITHIN = 0.01  # of the numbers, or else these are no depths in metres
_MOST_LOOKED_AT = 1_000_000  # numbers of an image


class UnitCheck:
    """Looks at the images 1, 2, 4, 8, ... of a sensor, so at all times of a log."""

    def __init__(self, rig: CameraRig | BubbleRig) -> None:
        self._rig = rig
        self._images = self._numbers = self._within = 0
        self._medians: list[float] = []
        self._unit = 1.0

    def add(self, values: np.ndarray) -> None:
        """Take note of an image (H, W), as it was sent."""
        self._images += 1
        if self._images & (self._images - 1):
            return
        every = -(-values.size // _MOST_LOOKED_AT)
        numbers = metres(values.reshape(-1)[::every], self._rig.unit)
        numbers = numbers[np.isfinite(numbers) & (numbers > 0.0)]
        nearest, furthest = self._rig.range
        self._numbers += len(numbers)
        self._within += int(valid_pixels(numbers, nearest=nearest, furthest=furthest).sum())
        if len(numbers):
            self._medians.append(float(np.median(numbers)))
        self._unit = float(metres(np.ones(1, values.dtype), self._rig.unit)[0])

    def judge(self) -> str | None:
        """What is suspicious; None if nothing is.

        Raises SessionError if there are numbers, and next to none of them is a depth within range.
        """
        if isinstance(self._rig, BubbleRig) and self._rig.kind == "deformation":
            return None
        if not self._medians:
            return f"{self._rig.name}: no image that was looked at has a measurement"
        if self._within >= _LEAST_WITHIN * self._numbers:
            return None
        nearest, furthest = self._rig.range
        raise SessionError(
            f"topic {self._rig.depth} of {self._rig.name} has depths of "
            f"{float(np.median(self._medians)):.4g} m (median, at {self._unit:g} m a unit); "
            f"accepted: from {nearest:g} to {furthest:g} m, its range: set unit, the metres of a "
            "unit of its images, or range"
        )


_MOST_MARKERS = 1_000_000
_MOST_BYTES = 2**28  # of images that references are made of


class LogScan:
    """All that is small, and of what is large when it came.

    infos: by topic, the first; changed_infos: how many others there were. message_times: by the
    topics of images, clouds and forces. units: a check by the name of a sensor. first_images: by a
    pad's topic.
    """

    def __init__(self, rig: Rig, joint_names: Sequence[str]) -> None:
        self.rig = rig
        self.moving = Movements(rig, joint_names)
        self.clocks = Clocks(rig.clock)
        self.infos: dict[str, CameraInfoMessage] = {}
        self.changed_infos: dict[str, int] = {}
        self.markers: list[Received] = []
        sensors = rig.sensors
        self.message_times = {sensor.depth: MessageTimes(sensor.depth) for sensor in sensors}
        self.units = {sensor.name: UnitCheck(sensor) for sensor in sensors}
        self.first_images: dict[str, list[Received]] = {pad.depth: [] for pad in rig.bubbles}
        self._images = {sensor.depth for sensor in sensors}
        self._others = [
            *(cloud.topic for cloud in rig.clouds),
            *(part.topic for part in rig.forces),
        ]
        self.message_times |= {topic: MessageTimes(topic) for topic in self._others}
        self._infos = {sensor.info for sensor in sensors}
        self._held = 0

    def read(self, log: RawLog, topics: set[str], progress: Callable[[int, int], None]) -> None:
        """Go through the log once."""
        for received in log.messages(topics, progress=progress):
            self.clocks.add(received)
            self.moving.add(received, received.stamp or received.log_time)
            topic, content = received.topic, received.content
            if isinstance(content, ImageMessage) and topic in self._images:
                self._see(received, content)
            elif isinstance(content, CloudMessage | WrenchMessage) and topic in self._others:
                self.message_times[topic].add(received, content)
            elif isinstance(content, CameraInfoMessage) and topic in self._infos:
                if self.infos.setdefault(topic, content) != content:
                    self.changed_infos[topic] = self.changed_infos.get(topic, 0) + 1
            elif (
                isinstance(content, MarkerMessage)
                and topic == self.rig.markers
                and len(self.markers) < _MOST_MARKERS
            ):
                self.markers.append(received)

    def _see(self, received: Received, content: ImageMessage) -> None:
        topic = received.topic
        self.message_times[topic].add(received, content)
        for sensor in self.rig.sensors:
            if sensor.depth == topic:
                self.units[sensor.name].add(content.values)
        first = self.first_images.get(topic)
        if first is not None and len(first) < self.rig.contact.reference_images:
            self._held += content.values.nbytes
            if self._held <= _MOST_BYTES:
                first.append(received)
