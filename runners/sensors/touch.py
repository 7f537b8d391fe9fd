"""A sensor that looks at a gel from behind: contacts where the object presses it in."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.errors import PointsError
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.sensing.touch_image import touch_points
from runners.sensors.cell import RobotCell
from runners.sensors.depth_camera import metres
from runners.sensors.first_pass import FirstPass, SensorTopic
from runners.sensors.log.messages import ImageMessage
from runners.sensors.rig import TouchRig
from runners.sensors.sensor import Sensed
from runners.sensors.session_report import Counts
from runners.sensors.surface_points import SurfacePoints


class _Press(NamedTuple):
    """An image of a gel that is pressed in."""

    height: FloatArray  # (H, W), how far, metres
    contact: BoolArray  # (H, W)
    world_from_sensor: FloatArray  # (4, 4)


class TouchSensor:
    """A sensor whose contact in a probe is that of the image with the most pixels in contact."""

    _cell: RobotCell

    def __init__(self, rig: TouchRig, resolution: float) -> None:
        """Make the sensor; resolution: of its points, metres."""
        self.name = rig.name
        self.topics = (SensorTopic(rig.height, ImageMessage, use=f"heights of {rig.name}"),)
        self.frame = rig.frame
        self._rig = rig
        self._resolution = resolution
        self._best: _Press | None = None
        self._deepest = 0.0  # metres

    def prepare(self, first_pass: FirstPass, cell: RobotCell) -> None:
        """Keep the cell. Raise SessionError for heights of a unit that nobody states."""
        self._cell = cell
        content = first_pass.first(self.topics[0])[0].content
        assert isinstance(content, ImageMessage)
        if self._rig.unit is None and np.issubdtype(content.values.dtype, np.integer):
            raise first_pass.error(
                f"heights of {self.name} are integers, whose unit is not stated; accepted: unit in "
                "the rig, metres a unit",
                self.topics[0],
            )

    def take(self, time: int, message: ImageMessage, *, counts: Counts, within: bool) -> None:
        """Use an image; `within` a probe's begin and end, it can be the contact's."""
        counts.images += 1
        if not within:
            counts.spared += 1
            return
        frame = self._rig.frame or message.frame
        pose = self._cell.world_from(frame, time, sensor=self.name)
        if pose is None:
            counts.lost += 1
            return
        height = metres(message.values, self._rig.unit)
        measured = np.isfinite(height)
        counts.used += 1
        counts.pixels += height.size
        counts.invalid += int((~measured).sum())
        height = np.where(measured, height, 0.0)
        self._deepest = max(self._deepest, float(height.max(initial=0.0)))
        contact = height > self._rig.threshold
        if contact.any() and (self._best is None or contact.sum() > self._best.contact.sum()):
            self._best = _Press(height, contact, world_from_sensor=pose)

    def finish(self, step: int, counts: Counts) -> Sensed:
        """Return the points of a probe, with the normals of the object."""
        best, self._best = self._best, None
        if best is None:
            return Sensed()
        counts.touching += int(best.contact.sum())
        try:
            points, normals = touch_points(
                best.height,
                best.contact,
                pixel=self._rig.pixel,
                world_from_sensor=best.world_from_sensor,
                spacing=self._resolution,
            )
        except PointsError as error:
            counts.unusable += 1
            self._cell.warnings.warn(f"{self.name}: {error}")
            return Sensed()
        found = SurfacePoints.measured(
            points, contact_normals=normals, normals=normals, degrees=self._rig.normals
        )
        return Sensed(contacts=found)

    def remark(self, total: Counts) -> str:
        """Return what is suspicious about all that it gave; "" if nothing is."""
        if not total.used or total.contacts:
            return ""
        return (
            f"no contact in {total.used} images: a gel is pressed in by {1e3 * self._deepest:.3g} "
            f"mm at most, the threshold is {1e3 * self._rig.threshold:g} mm; check unit"
        )
