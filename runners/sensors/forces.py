"""A force sensor: contacts where the line of force enters the hand."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.points import Lattice
from chsel.problem.poses import apply, inverse, rotated
from chsel.sensing.contact_sensing import contact_ahead, contact_on_axis
from runners.sensors.cell import RobotCell
from runners.sensors.first_pass import FirstPass, SensorTopic
from runners.sensors.hand import HandModel
from runners.sensors.log.messages import WrenchMessage
from runners.sensors.log.transforms import JointHistory
from runners.sensors.rig import ForceRig
from runners.sensors.sensor import Sensed
from runners.sensors.session_report import Counts
from runners.sensors.surface_points import NO_POINTS, SurfacePoints

_MOST_LOOKED_AT = 50  # samples of a probe, the strongest
_MOST_TARED = 4096  # samples
_NANOSECONDS = 1e9


@dataclass(frozen=True, order=True)
class _Sample:
    """Force and torque beyond the tare; ordered by strength."""

    newtons: float
    time: int
    frame: str
    numbers: tuple[float, ...]  # force, N; torque, Nm


class _Contact(NamedTuple):
    """A contact, world. Normals are unit, out of the object."""

    point: FloatArray  # (3,), metres
    opposite: FloatArray  # (3,), normal against that of the hand
    along_force: FloatArray  # (3,), normal along the force on the hand


class ForceSensor:
    """A sensor of forces on the hand; of each probe, it gives where the strongest act."""

    _cell: RobotCell
    _joints: JointHistory
    _lattice: Lattice

    def __init__(self, rig: ForceRig, resolution: float, *, hand: HandModel | None) -> None:
        """Make the sensor of a hand; one contact a voxel of side `resolution`, metres, is kept."""
        assert hand is not None  # a rig with forces has one
        self.name = rig.topic
        self.topics = (SensorTopic(rig.topic, WrenchMessage, use="forces"),)
        self.frame = rig.frame
        self._rig = rig
        self._resolution = resolution
        self._hand = hand
        self._idle: deque[tuple[int, FloatArray]] = deque(maxlen=_MOST_TARED)
        self._tare: FloatArray | None = None
        self._within = self._has_torque = self._in_contact = False
        self._largest = 0.0  # newtons
        self._row: list[_Sample] = []  # not yet long enough for a contact
        self._strong: list[_Sample] = []

    def prepare(self, first_pass: FirstPass, cell: RobotCell) -> None:
        """Keep the cell, and the joints that move the hand."""
        self._cell = cell
        self._joints = first_pass.joints
        self._lattice = Lattice(cell.free.workspace.lower, self._resolution)

    def take(self, time: int, message: WrenchMessage, *, counts: Counts, within: bool) -> None:
        """Use a message; `within` a probe's begin and end, forces are of contacts."""
        counts.images += 1
        numbers = np.concatenate([message.force, message.torque])
        numbers = numbers if self._rig.acts == "on_hand" else -numbers
        self._has_torque |= bool(message.torque.any())
        if within and not self._within:
            self._set_tare(time)
        self._within = within
        if within and self._tare is not None:
            counts.used += 1
            beyond = numbers - self._tare
            newtons = float(np.sqrt((beyond[:3] ** 2).sum()))
            self._largest = max(self._largest, newtons)
            self._look(
                _Sample(newtons, time, frame=message.frame, numbers=tuple(beyond.tolist())), counts
            )
            return
        self._end_row(counts)
        self._idle.append((time, numbers))
        counts.spared += 1
        if within and time - self._idle[0][0] >= self._rig.tare * _NANOSECONDS:
            self._cell.warnings.warn(
                f"{self._rig.topic}: nothing came before the first probe: its first "
                f"{self._rig.tare:g} s are its tare"
            )
            self._set_tare(time)

    def finish(self, step: int, counts: Counts) -> Sensed:
        """Return the contacts of a probe, the strongest first."""
        self._end_row(counts)
        samples = sorted(self._strong, reverse=True)[:_MOST_LOOKED_AT]
        self._strong = []
        found: dict[tuple[int, ...], _Contact] = {}
        for sample in samples:
            contact = self._contact(sample, counts)
            if contact is not None:
                voxel = tuple(self._lattice.voxels(contact.point[None])[0].tolist())
                found.setdefault(voxel, contact)
            if len(found) == self._rig.points:
                break
        contacts = NO_POINTS
        if found:
            points, opposite, along_force = map(np.array, zip(*found.values(), strict=True))
            contacts = SurfacePoints.measured(
                points, contact_normals=opposite, normals=along_force, degrees=self._rig.normals
            )
        return Sensed(contacts=contacts, rigid=True)

    def remark(self, total: Counts) -> str:
        """Return what is suspicious about all that it gave; "" if nothing is."""
        if not total.used or total.contacts:
            return ""
        if total.outside:
            return (
                f"none of {total.outside} lines of force meets the hand in the workspace; check "
                "frame, acts, torque, and the solids of the hand"
            )
        return (
            f"no contact in {total.used} messages: their largest force is {self._largest:.3g} N, "
            f"the threshold {self._rig.threshold:g} N for {self._rig.samples} in a row"
        )

    def _set_tare(self, time: int) -> None:
        """Take the median of what came last as the tare; without any, keep the tare."""
        since = time - self._rig.tare * _NANOSECONDS
        idle = [numbers for moment, numbers in self._idle if moment >= since]
        self._idle.clear()
        if idle:
            self._tare = np.median(idle, axis=0)

    def _look(self, sample: _Sample, counts: Counts) -> None:
        """Keep a sample if it is of a contact, and strong."""
        if sample.newtons <= self._rig.threshold:
            self._end_row(counts)
            return
        self._row.append(sample)
        if self._in_contact or len(self._row) >= self._rig.samples:
            self._in_contact = True
            self._strong += self._row
            self._row.clear()

    def _end_row(self, counts: Counts) -> None:
        """End a row of samples, as the force is below the threshold or the probe is over."""
        counts.spikes += len(self._row)
        self._row.clear()
        self._in_contact = False

    def _contact(self, sample: _Sample, counts: Counts) -> _Contact | None:
        """Return where a force acts; None, counted, where that is not known.

        An object without friction pushes the hand along its own outward normal.
        """
        sensor = self._rig.frame or sample.frame
        world_from_sensor = self._cell.world_from(sensor, sample.time, sensor=self._rig.topic)
        world_from_hand = self._cell.world_from(
            self._hand.frame, sample.time, sensor=self._rig.topic
        )
        if world_from_sensor is None or world_from_hand is None:
            counts.lost += 1
            return None
        joints = self._joints.during(sample.time, sample.time + 1)[0][1]
        if joints is None:
            self._cell.warnings.warn(
                f"{self._rig.topic}: left out, as the hand's joints are not known"
            )
            counts.lost += 1
            return None
        solids = self._hand.solids(joints)
        assert solids is not None  # a rig with forces has some
        corners = np.asarray(solids.triangles, dtype=np.float64).reshape(-1, 3)
        sensor_from_hand = inverse(world_from_sensor) @ world_from_hand
        triangles = apply(sensor_from_hand, corners).reshape(-1, 3, 3)
        force, torque = np.array(sample.numbers[:3]), np.array(sample.numbers[3:])
        if self._rig.torque and self._has_torque:
            found = contact_on_axis(force, torque, triangles=triangles)
        else:
            found = contact_ahead(force, triangles)
        point = apply(world_from_sensor, found.point[None])
        if found.miss > self._rig.reach or not self._cell.free.within(point)[0]:
            counts.outside += 1
            return None
        turn = world_from_sensor[:3, :3]
        opposite = -rotated(turn, found.normal[None])
        along = rotated(turn, force[None] / np.sqrt((force**2).sum()))
        return _Contact(point[0], opposite[0], along_force=along[0])
