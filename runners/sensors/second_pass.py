"""The second pass over a log: images one after the other, and a probe's points at its end."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints
from replay.events import Logged, Probe, RigDescribed, SensorImage
from runners.sensors.cell import RobotCell
from runners.sensors.clouds import Clouds
from runners.sensors.contacts import ContactFinder, Contacts, PushWatch
from runners.sensors.depth_camera import DepthCamera
from runners.sensors.first_pass import FirstPass
from runners.sensors.forces import Forces
from runners.sensors.hand import HandModel
from runners.sensors.hand_path import HandPath
from runners.sensors.log.messages import CloudMessage, ImageMessage, Received, WrenchMessage
from runners.sensors.log.probe_windows import ProbeWindow
from runners.sensors.pad import Pad
from runners.sensors.rig import Rig
from runners.sensors.session_report import Report

HAND = "hand"
"""The name under which the hand is counted."""

Event = RigDescribed | SensorImage | Logged | Probe


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
        self._images = images
        self._sensors = _by_topic(rig)
        self._cameras = {
            sensor.name: DepthCamera(sensor, first_pass.cameras[sensor.name], cell)
            for sensor in rig.cameras
        }
        # Where the reference's sweep is chosen, no other free space follows from pads.
        self._backwards = rig.hand is not None and rig.hand.sweep == "backwards"
        self._pads = {
            sensor.name: Pad(
                sensor,
                rig.contact,
                first_pass.cameras[sensor.name],
                first_pass.references[sensor.name],
                cell,
                inside=not self._backwards,
            )
            for sensor in rig.bubbles
        }
        self._clouds = {
            cloud.topic: Clouds(cloud, cell, rig.surface_resolution) for cloud in rig.clouds
        }
        self._contacts = ContactFinder(rig, self._pads, cell, seed)
        self._hand, self._push_end = None, None
        self._forces: dict[str, Forces] = {}
        if rig.hand is not None and hand is not None:
            parts = rig.hand, hand, first_pass.joints
            self._forces = {
                force.topic: Forces(force, parts, cell, rig.surface_resolution)
                for force in rig.forces
            }
            self._hand = HandPath(rig.hand, hand, first_pass.joints, first_pass.tree.times, cell)
            if self._backwards or any(extra.foremost for extra in rig.annotations.contacts):
                self._push_end = PushWatch(rig.hand.frame, cell)

    def events(self, messages: Iterator[tuple[int, Received]]) -> Iterator[Event]:
        """Events of the probes, from messages with their times, ascending."""
        message = next(messages, None)
        sensors = (*self._cameras, *self._pads, *self._clouds, *self._forces)
        for window in self._windows:
            for name in (*sensors, *[HAND] * bool(self._hand)):
                self._report.counts(window.step, name)  # in this order they are shown
            while message is not None and message[0] < window.closes:
                self._take(window, *message)
                message = next(messages, None)
            yield from self._finish(window)

    def check(self) -> None:
        """Remark on topics whose points were all out of reach, once the log is read."""
        total = self._report.total()
        for topic, cloud in self._clouds.items():
            suspicious = cloud.check(total[topic]) if topic in total else None
            if suspicious:
                self._cell.warnings.warn(suspicious)

    def _take(self, window: ProbeWindow, time: int, message: Received) -> None:
        """Hand a message to whoever reads its topic."""
        if time < window.opens:
            self._cell.warnings.warn(f"{message.topic}: left out, as it came long after its probe")
            return
        for sensor in self._sensors.get(message.topic, ()):
            counts, within = self._report.counts(window.step, sensor), window.holds(time)
            content = message.content
            if isinstance(content, CloudMessage) and sensor in self._clouds:
                self._clouds[sensor].take(time, content, counts, within=within)
            elif isinstance(content, WrenchMessage) and sensor in self._forces:
                self._forces[sensor].take(time, content, counts, within=within)
            elif isinstance(content, ImageMessage) and sensor in self._cameras:
                self._cameras[sensor].take(time, content, counts)
            elif isinstance(content, ImageMessage) and sensor in self._pads:
                pad = self._pads[sensor]
                imprint = pad.take(time, content, counts, within=within)
                if imprint is not None and within and self._push_end is not None:
                    self._push_end.take(time, sensor, pad, imprint.view)

    def _finish(self, window: ProbeWindow) -> Iterator[Event]:
        """What is known at the end of a probe."""
        step, path = window.step, np.zeros((0, 4, 4))
        if self._hand is not None:
            path = self._hand.follow(window, self._report.counts(step, HAND))
        imprints = {
            name: imprint
            for name, pad in self._pads.items()
            if (imprint := pad.strongest(self._report.counts(step, name))) is not None
        }
        push_end = self._push_end.next() if self._push_end else None
        if push_end is not None and self._hand is not None and self._backwards:
            self._hand.backwards(push_end, self._report.counts(step, HAND))
        by_sensor = self._report.by_probe[step]
        felt = self._contacts.felt(step, imprints, by_sensor)
        added = self._contacts.annotated(step, push_end)
        scanned = self._scanned(step, contacts=True)
        pushed = Contacts.joined(
            [
                force.contacts(self._report.counts(step, name))
                for name, force in self._forces.items()
            ]
        )
        if step in self._rig.annotations.exclude:
            pushed = Contacts.joined([])
        contacts = Contacts.joined([felt, added, Contacts.without_normals(scanned), pushed])
        surface = self._scanned(step, contacts=False)
        new = KnownPoints(
            free=self._cell.free.new(pushed.points, pushed.normals),
            known=np.concatenate([contacts.points, surface]),
        )
        if self._images:
            shown = [camera.image(step) for camera in self._cameras.values()]
            yield from (image for image in shown if image is not None)
            for name, imprint in imprints.items():
                yield self._pads[name].image(step, imprint)
        yield from self._summary(step, new, contacts)
        yield Probe(
            step,
            "contact" if len(contacts.points) else "free",
            new,
            gripper_path=path,
            contacts=contacts.points,
            contact_normals=contacts.normals,
        )

    def _scanned(self, step: int, *, contacts: bool) -> FloatArray:
        """Points (N, 3) of topics of contacts, or of topics of surface points."""
        found = [np.zeros((0, 3))]
        for topic, cloud in self._clouds.items():
            if cloud.touches == contacts:
                points = cloud.surface()
                if contacts and step in self._rig.annotations.exclude:
                    points = points[:0]
                self._report.counts(step, topic).contacts += len(points)
                found.append(points)
        return np.concatenate(found)

    def _summary(self, step: int, new: KnownPoints, contacts: Contacts) -> Iterator[Logged]:
        """What a probe came to, in a line; and whether its points contradict one another."""
        by_sensor = self._report.by_probe[step].items()
        free = ", ".join(f"{name} {counts.free}" for name, counts in by_sensor if counts.free)
        surface = ", ".join(
            f"{name} {counts.contacts}" for name, counts in by_sensor if counts.contacts
        )
        text = f"probe {step}: {len(new.free)} new free voxels" + f" ({free})" * bool(free)
        text += f", {len(new.known)} surface points" + f" ({surface})" * bool(surface)
        held = self._cell.free.holds(contacts.points)
        if held.any():
            text += f"; {int(held.sum())} contacts lie in free voxels"
        yield Logged(step, "info", text)
        lattice = self._cell.free.grid.lattice
        behind = lattice.centres(lattice.voxels(contacts.points)) - contacts.points
        inside = held & ((behind * contacts.normals).sum(axis=1) < 0.0)
        self._cell.warnings.warn(
            "a contact lies in a free voxel whose centre is behind it, in the object",
            int(inside.sum()),
        )


def _by_topic(rig: Rig) -> dict[str, list[str]]:
    """The names of the sensors that read a topic; that of a cloud or of forces is its topic."""
    sensors: dict[str, list[str]] = {}
    for sensor in rig.sensors:
        sensors.setdefault(sensor.depth, []).append(sensor.name)
    for topic in [*(cloud.topic for cloud in rig.clouds), *(part.topic for part in rig.forces)]:
        sensors.setdefault(topic, []).append(topic)
    return sensors
