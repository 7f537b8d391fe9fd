"""The protocol of the sensors of a rig: what each takes from the two passes over a log."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

from chsel.events import SensorImage
from runners.sensors.cell import RobotCell
from runners.sensors.first_pass import FirstPass, TopicReader
from runners.sensors.session_report import Counts
from runners.sensors.surface_points import NO_POINTS, SurfacePoints


@dataclass(frozen=True, eq=False)
class Sensed:
    """Points that a sensor gives of one probe.

    Free space is not here: a sensor marks it in `RobotCell.free`.
    """

    contacts: SurfacePoints = field(default_factory=lambda: NO_POINTS)
    """Points at which the hand touches the object."""

    candidates: SurfacePoints | None = None
    """Points of a contact that are too many; None: nothing was measured.

    A random subset of them counts, of `contact.points` of the rig for all sensors together.
    """

    surface: SurfacePoints = field(default_factory=lambda: NO_POINTS)
    """Points on the object that are no contacts."""

    rigid: bool = False
    """Whether contacts are those of the rigid hand, so that no voxel behind them is free."""

    image: SensorImage | None = None
    """Image to record."""


class Sensor(TopicReader, Protocol):
    """A sensor of a rig.

    The first pass over the log reads the first messages of all `topics`. `prepare` takes from them
    what the sensor needs. The second pass gives the messages of the first topic to `take`, one by
    one, and calls `finish` at the end of each probe.
    """

    def prepare(self, first_pass: FirstPass, cell: RobotCell) -> None:
        """Keep what the first pass has found, and the cell, whose free space the sensor marks.

        Raise SessionError for a log that lacks what the sensor needs.
        """

    def take(self, time: int, message: Any, *, counts: Counts, within: bool) -> None:
        """Use a message of the current probe, nanoseconds; within: its begin and end."""

    def finish(self, step: int, counts: Counts) -> Sensed:
        """Return the points of the probe, whose index is `step`, that ends."""

    def remark(self, total: Counts) -> str:
        """Return what is suspicious about all that the sensor gave; "" if nothing is."""
