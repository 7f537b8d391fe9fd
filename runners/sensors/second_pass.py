"""The second pass over a log: images one after the other, and a probe's points at its end."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, Protocol

import numpy as np

from chsel.events import Logged, Probe, RigDescribed, SensorImage
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints
from chsel.problem.streams import Purpose, StreamKey
from chsel.sensing.contact_sensing import contact_subset, share
from runners.sensors.cell import RobotCell
from runners.sensors.clouds import Clouds
from runners.sensors.depth_camera import DepthCamera
from runners.sensors.first_pass import FirstPass
from runners.sensors.forces import Forces
from runners.sensors.hand import HandModel, HandPath
from runners.sensors.log.messages import Received
from runners.sensors.log.probe_windows import ProbeWindow
from runners.sensors.pad import Imprint, Pad
from runners.sensors.rig import Rig
from runners.sensors.session_report import Counts, Report

HAND = "hand"
"""The name under which the hand is counted."""

Event = RigDescribed | SensorImage | Logged | Probe


class Sensor(Protocol):
    """What reads the messages of a topic."""

    reads: ClassVar[type]  # the kind of their content

    def take(self, time: int, message: Any, counts: Counts, *, within: bool) -> None:
        """A message of the current probe, at nanoseconds; whether within its begin and end."""

    def remark(self, total: Counts) -> str:
        """What is suspicious about all that it gave in a log; "" if nothing is."""


class SecondPass:
    """All that a rig senses, probe by probe."""

    def __init__(
        self,
        rig: Rig,
        first_pass: FirstPass,
        cell: RobotCell,
        report: Report,
        hand: HandModel | None,
        *,
        seed: int,
        images: bool,
    ) -> None:
        """seed: of the choice of contact pixels. images: whether they are among the events."""
        self._rig, self._windows, self._cell, self._report = rig, first_pass.windows, cell, report
        self._seed, self._images = seed, images
        cameras, resolution = first_pass.cameras, rig.surface_resolution
        self._cameras = {
            sensor.name: DepthCamera(sensor, cameras[sensor.name], cell) for sensor in rig.cameras
        }
        self._pads = {
            pad.name: Pad(
                pad, rig.contact, cameras[pad.name], first_pass.references[pad.name], cell
            )
            for pad in rig.bubbles
        }
        self._clouds = {cloud.topic: Clouds(cloud, cell, resolution) for cloud in rig.clouds}
        self._forces: dict[str, Forces] = {}
        self._hand = None
        if rig.hand is not None and hand is not None:
            joints, frame = first_pass.joints, rig.hand.frame
            self._hand = HandPath(rig.hand, hand, joints, first_pass.tree.times, cell)
            self._forces = {
                force.topic: Forces(force, frame, hand, joints, cell, resolution)
                for force in rig.forces
            }
        self._sensors: dict[str, Sensor] = {
            **self._cameras,
            **self._pads,
            **self._clouds,
            **self._forces,
        }
        topics = {sensor.name: sensor.depth for sensor in rig.sensors}
        self._by_topic: dict[str, list[str]] = {}
        for name in self._sensors:  # that of a cloud or of forces is its topic
            self._by_topic.setdefault(topics.get(name, name), []).append(name)

    def events(self, messages: Iterator[tuple[int, Received]]) -> Iterator[Event]:
        """Events of the probes, from messages with their times, ascending."""
        message = next(messages, None)
        for window in self._windows:
            for name in (*self._sensors, *[HAND] * bool(self._hand)):
                self._report.counts(window.step, name)  # in this order they are shown
            while message is not None and message[0] < window.closes:
                self._take(window, *message)
                message = next(messages, None)
            yield from self._finish(window)

    def check(self) -> None:
        """Warn of sensors that gave next to nothing, once the log is read."""
        total = self._report.total()
        sensors: dict[str, Sensor | HandPath] = {**self._sensors}
        if self._hand is not None:
            sensors[HAND] = self._hand
        for name, sensor in sensors.items():
            counts = total[name]
            text = sensor.remark(counts)
            if counts.images and not counts.used:
                text = f"none of its {counts.images} messages was of use: {counts.unused()}"
            if text:
                self._cell.warnings.warn(f"{name}: {text}")

    def _take(self, window: ProbeWindow, time: int, message: Received) -> None:
        """Hand a message to whoever reads its topic."""
        if time < window.opens:
            self._cell.warnings.warn(f"{message.topic}: left out, as it came long after its probe")
            return
        for name in self._by_topic.get(message.topic, ()):
            sensor = self._sensors[name]
            if isinstance(message.content, sensor.reads):
                counts = self._report.counts(window.step, name)
                sensor.take(time, message.content, counts, within=window.holds(time))

    def _finish(self, window: ProbeWindow) -> Iterator[Event]:
        """What is known at the end of a probe."""
        step, path = window.step, np.zeros((0, 4, 4))
        by_sensor, annotations = self._report.by_probe[step], self._rig.annotations
        if self._hand is not None:
            path = self._hand.follow(window, by_sensor[HAND])
        imprints = {
            name: imprint
            for name, pad in self._pads.items()
            if (imprint := pad.strongest(by_sensor[name])) is not None
        }
        touched = self._points(step, touches=True)
        pushed = [force.contacts(by_sensor[name]) for name, force in self._forces.items()]
        measured = [self._felt(step, imprints), touched, *pushed]
        if step in annotations.exclude:
            if any(len(contacts) for contacts in measured):
                self._cell.warnings.note(f"probe {step}: contacts left out, as the rig annotates")
            measured, pushed = [], []
            for counts in by_sensor.values():
                counts.contacts = 0
        contacts = np.concatenate([*measured[:1], self._annotated(step), *measured[1:]])
        surface = self._points(step, touches=False)
        new = KnownPoints(
            free=self._cell.free.new(np.concatenate([_NONE, *pushed])),
            known=np.concatenate([contacts[:, :3], surface[:, :3]]),
        )
        if self._images:
            shown = [camera.image(step) for camera in self._cameras.values()]
            yield from (image for image in shown if image is not None)
            for name, imprint in imprints.items():
                yield self._pads[name].image(step, imprint)
        yield Logged(step, "info", _summary(step, new, by_sensor))
        yield Probe(
            step,
            "contact" if len(contacts) else "free",
            new,
            gripper_path=path,
            contacts=contacts[:, :3],
            contact_normals=contacts[:, 3:],
        )

    def _felt(self, step: int, imprints: Mapping[str, Imprint]) -> FloatArray:
        """A seeded subset (C, 6) of the contact pixels of all pads (CHSEL, Sec. V-B)."""
        key, found = StreamKey(self._seed, step), [_NONE]
        shares = share([imprint.size for imprint in imprints.values()], self._rig.contact.points)
        for index, (name, imprint) in enumerate(imprints.items()):
            stream = key.stream(Purpose.CONTACT_POINTS, index)
            chosen = contact_subset(imprint.size, shares[index], stream)
            contacts = self._within(name, self._pads[name].contacts(imprint, chosen))
            self._report.counts(step, name).contacts += len(contacts)
            found.append(contacts)
        return np.concatenate(found)

    def _annotated(self, step: int) -> FloatArray:
        """The contacts (C, 6) that the rig adds to a probe."""
        extras = self._rig.annotations.contacts
        points = [point for extra in extras if extra.probe == step for point in extra.points]
        contacts = self._within(f"probe {step}", _unturned(np.reshape(points, (-1, 3))))
        if len(contacts):
            text = f"probe {step}: {len(contacts)} contacts added, as the rig annotates"
            self._cell.warnings.note(text)
        return contacts

    def _within(self, name: str, contacts: FloatArray) -> FloatArray:
        """Those of contacts (C, 6) that lie in the workspace; name: whose they are."""
        kept = self._cell.free.within(contacts[:, :3])
        self._cell.warnings.warn(
            f"{name}: a contact left out, as it is out of the workspace", int((~kept).sum())
        )
        return contacts[kept]

    def _points(self, step: int, *, touches: bool) -> FloatArray:
        """Points (N, 6) of topics of contacts, or of topics of surface points."""
        found = [_NONE]
        for topic, cloud in self._clouds.items():
            if cloud.touches == touches:
                points = cloud.surface()
                self._report.counts(step, topic).contacts += len(points)
                found.append(_unturned(points))
        return np.concatenate(found)


_NONE = np.zeros((0, 6))


def _unturned(points: FloatArray) -> FloatArray:
    """Points (N, 3) with normals 0, as they are not known (N, 6)."""
    return np.concatenate([points, np.zeros_like(points)], axis=1)


def _summary(step: int, new: KnownPoints, by_sensor: Mapping[str, Counts]) -> str:
    """What a probe came to, in a line."""
    free = ", ".join(f"{name} {counts.free}" for name, counts in by_sensor.items() if counts.free)
    surface = ", ".join(
        f"{name} {counts.contacts}" for name, counts in by_sensor.items() if counts.contacts
    )
    text = f"probe {step}: {len(new.free)} new free voxels" + f" ({free})" * bool(free)
    return text + f", {len(new.known)} surface points" + f" ({surface})" * bool(surface)
