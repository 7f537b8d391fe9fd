"""The second pass over a log: measurements one by one, and a probe's points at its end."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from chsel.events import Logged, Probe, SensorImage
from chsel.problem.points import KnownPoints
from chsel.problem.streams import Purpose, StreamKey
from chsel.sensing.contact_sensing import contact_subset, share
from runners.sensors.cell import RobotCell
from runners.sensors.hand import HAND, HandPath
from runners.sensors.log.messages import Received
from runners.sensors.log.probe_windows import ProbeWindow
from runners.sensors.rig import Rig
from runners.sensors.sensor import Sensed, Sensor
from runners.sensors.session_report import Counts, Report
from runners.sensors.surface_points import NO_POINTS, SurfacePoints

Event = SensorImage | Logged | Probe


class SecondPass:
    """The measurements of all sensors, probe by probe."""

    def __init__(
        self,
        rig: Rig,
        sensors: Sequence[Sensor],
        *,
        hand: HandPath | None,
        cell: RobotCell,
        report: Report,
        seed: int,
        images: bool,
    ) -> None:
        """Make the pass of prepared sensors.

        seed: of the choice of contact pixels. images: whether they are among the events.
        """
        self._rig = rig
        self._sensors = sensors
        self._hand = hand
        self._cell = cell
        self._report = report
        self._seed = seed
        self._images = images

    def events(
        self, windows: Sequence[ProbeWindow], messages: Iterator[tuple[int, Received]]
    ) -> Iterator[Event]:
        """Yield the events of the probes, from messages with their times, ascending."""
        names = [sensor.name for sensor in self._sensors] + ([HAND] if self._hand else [])
        message = next(messages, None)
        for window in windows:
            for name in names:
                self._report.counts(window.step, name)  # in this order they are shown
            while message is not None and message[0] < window.closes:
                self._take(window, message[0], message=message[1])
                message = next(messages, None)
            yield from self._finish(window)

    def check(self) -> None:
        """Warn of sensors that gave next to nothing, once the log is read."""
        total = self._report.total()
        remarks = {sensor.name: sensor.remark(total[sensor.name]) for sensor in self._sensors}
        if self._hand is not None:
            remarks[HAND] = self._hand.remark(total[HAND])
        for name, text in remarks.items():
            counts = total[name]
            if counts.images and not counts.used:
                text = f"none of its {counts.images} messages was of use: {counts.unused()}"
            if text:
                self._cell.warnings.warn(f"{name}: {text}")

    def _take(self, window: ProbeWindow, time: int, *, message: Received) -> None:
        """Give a message to the sensors that read its topic."""
        if time < window.opens:
            self._cell.warnings.warn(f"{message.topic}: left out, as it came long after its probe")
            return
        for sensor in self._sensors:
            topic = sensor.topics[0]
            if topic.name == message.topic and isinstance(message.content, topic.content):
                counts = self._report.counts(window.step, sensor.name)
                sensor.take(time, message.content, counts=counts, within=window.holds(time))

    def _finish(self, window: ProbeWindow) -> Iterator[Event]:
        """Yield the events at the end of a probe."""
        step = window.step
        by_sensor = self._report.by_probe[step]
        path = np.zeros((0, 4, 4))
        if self._hand is not None:
            path = self._hand.follow(window, by_sensor[HAND])
        sensed = {
            sensor.name: sensor.finish(step, by_sensor[sensor.name]) for sensor in self._sensors
        }
        drawn = self._drawn(step, sensed)
        contacts = {name: each.contacts for name, each in sensed.items()}
        for name, points in contacts.items():
            by_sensor[name].contacts += len(points)
        if step in self._rig.annotations.exclude:
            if any(len(points) for points in (drawn, *contacts.values())):
                self._cell.warnings.note(f"probe {step}: contacts left out, as the rig annotates")
            drawn = NO_POINTS
            contacts = {}
            for counts in by_sensor.values():
                counts.contacts = 0
        touched = SurfacePoints.joined([drawn, self._annotated(step), *contacts.values()])
        for name, each in sensed.items():
            by_sensor[name].contacts += len(each.surface)
        rigid = [points for name, points in contacts.items() if sensed[name].rigid]
        known = SurfacePoints.joined([touched, *(each.surface for each in sensed.values())])
        new = KnownPoints(
            free=self._cell.free.new(SurfacePoints.joined(rigid)),
            known=known.points,
            normals=known.normals,
            normal_noise=known.normal_noise,
        )
        if self._images:
            yield from (each.image for each in sensed.values() if each.image is not None)
        yield Logged(step, "info", text=_summary(step, new, by_sensor=by_sensor))
        yield Probe(
            step,
            "contact" if len(touched) else "free",
            new_points=new,
            gripper_path=path,
            contacts=touched.points,
            contact_normals=touched.contact_normals,
        )

    def _drawn(self, step: int, sensed: Mapping[str, Sensed]) -> SurfacePoints:
        """Return a seeded subset of all candidates, counted (CHSEL, Sec. V-B)."""
        key = StreamKey(self._seed, step)
        candidates = {
            name: each.candidates for name, each in sensed.items() if each.candidates is not None
        }
        shares = share([len(points) for points in candidates.values()], self._rig.contact.points)
        drawn = []
        for index, (name, points) in enumerate(candidates.items()):
            stream = key.stream(Purpose.CONTACT_POINTS, index)
            subset = contact_subset(len(points), shares[index], stream=stream)
            contacts = self._within(name, points.chosen(subset))
            self._report.counts(step, name).contacts += len(contacts)
            drawn.append(contacts)
        return SurfacePoints.joined(drawn)

    def _annotated(self, step: int) -> SurfacePoints:
        """Return the contacts that the rig adds to a probe, without normals."""
        extras = self._rig.annotations.contacts
        points = [point for extra in extras if extra.probe == step for point in extra.points]
        annotated = SurfacePoints.measured(np.reshape(points, (-1, 3)))
        contacts = self._within(f"probe {step}", annotated)
        if len(contacts):
            text = f"probe {step}: {len(contacts)} contacts added, as the rig annotates"
            self._cell.warnings.note(text)
        return contacts

    def _within(self, name: str, contacts: SurfacePoints) -> SurfacePoints:
        """Return those of contacts that lie in the workspace; name: whose they are."""
        kept = self._cell.free.within(contacts.points)
        self._cell.warnings.warn(
            f"{name}: a contact left out, as it is out of the workspace", int((~kept).sum())
        )
        return contacts.chosen(kept)


def _summary(step: int, new: KnownPoints, *, by_sensor: Mapping[str, Counts]) -> str:
    """Return the result of a probe in one line."""
    free = ", ".join(f"{name} {counts.free}" for name, counts in by_sensor.items() if counts.free)
    surface = ", ".join(
        f"{name} {counts.contacts}" for name, counts in by_sensor.items() if counts.contacts
    )
    text = f"probe {step}: {len(new.free)} new free voxels" + f" ({free})" * bool(free)
    return text + f", {len(new.known)} surface points" + f" ({surface})" * bool(surface)
