"""Whether the depths of a sensor are in the unit that its rig says."""

from __future__ import annotations

import numpy as np

from chsel.errors import SessionError
from chsel.sensing.depth_camera import valid_pixels
from runners.sensors.depth_source import metres
from runners.sensors.rig import BubbleRig, CameraRig

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
