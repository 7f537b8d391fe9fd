"""What a first pass over a log gathers."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from runners.sensors.clocks import Clocks
from runners.sensors.log import RawLog
from runners.sensors.messages import (
    CameraInfoMessage,
    CloudMessage,
    ImageMessage,
    MarkerMessage,
    Received,
    WrenchMessage,
)
from runners.sensors.movements import Movements
from runners.sensors.rig import Rig
from runners.sensors.sightings import Sightings
from runners.sensors.unit_check import UnitCheck

_MOST_MARKERS = 1_000_000
_MOST_BYTES = 2**28  # of images that references are made of


class FirstPass:
    """All that is small, and of what is large when it came.

    infos: by topic, the first; changed_infos: how many others there were. sightings: by the topics
    of images, clouds and forces. units: a check by the name of a sensor. first_images: by a pad's
    topic.
    """

    def __init__(self, rig: Rig, joint_names: Sequence[str]) -> None:
        self.rig = rig
        self.moving = Movements(rig, joint_names)
        self.clocks = Clocks(rig.clock)
        self.infos: dict[str, CameraInfoMessage] = {}
        self.changed_infos: dict[str, int] = {}
        self.markers: list[Received] = []
        sensors = rig.sensors
        self.sightings = {sensor.depth: Sightings(sensor.depth) for sensor in sensors}
        self.units = {sensor.name: UnitCheck(sensor) for sensor in sensors}
        self.first_images: dict[str, list[Received]] = {pad.depth: [] for pad in rig.bubbles}
        self._images = {sensor.depth for sensor in sensors}
        self._others = [
            *(cloud.topic for cloud in rig.clouds),
            *(part.topic for part in rig.forces),
        ]
        self.sightings |= {topic: Sightings(topic) for topic in self._others}
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
                self.sightings[topic].add(received, content)
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
        self.sightings[topic].add(received, content)
        for sensor in self.rig.sensors:
            if sensor.depth == topic:
                self.units[sensor.name].add(content.values)
        first = self.first_images.get(topic)
        if first is not None and len(first) < self.rig.contact.reference_images:
            self._held += content.values.nbytes
            if self._held <= _MOST_BYTES:
                first.append(received)
