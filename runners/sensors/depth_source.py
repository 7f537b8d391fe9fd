"""From an image message to a depth image at a place in the world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.sensing.depth_camera import PinholeCamera, valid_pixels
from runners.sensors.cell import Cell
from runners.sensors.messages import ImageMessage
from runners.sensors.rig import BubbleRig, CameraRig
from runners.sensors.tally import Tally

INTEGER_UNIT = 0.001  # m: of 16-bit depth images, as all the world has it
FINE, COARSE = 0.0001, 0.001  # m: units of recorded images


@dataclass(frozen=True, eq=False)
class View:
    """An image of metres (H, W) with its valid pixels (H, W), from world_from_camera (4, 4)."""

    metres: FloatArray
    valid: BoolArray
    world_from_camera: FloatArray


class DepthSource:
    """The images of one camera."""

    def __init__(self, rig: CameraRig | BubbleRig, camera: PinholeCamera, cell: Cell) -> None:
        self.rig, self.camera, self.cell = rig, camera, cell

    def view(self, time: int, message: ImageMessage, tally: Tally) -> View | None:
        """The image and its pose; None, counted, where it cannot be used."""
        shape = (self.camera.height, self.camera.width)
        if message.values.shape != shape:
            height, width = message.values.shape
            self.cell.remarks.warn(
                f"{self.rig.name}: left out, as the image has {width} x {height} pixels and its "
                f"camera {shape[1]} x {shape[0]}"
            )
            tally.unusable += 1
            return None
        frame = self.rig.frame or message.frame
        world_from_camera = self.cell.world_from(frame, time, self.rig.name)
        if world_from_camera is None:
            tally.lost += 1
            return None
        depth = metres(message.values, self.rig.unit)
        valid = valid_pixels(depth, nearest=self.rig.range[0], furthest=self.rig.range[1])
        tally.pixels += valid.size
        tally.invalid += int(valid.size - valid.sum())
        return View(depth, valid, world_from_camera)


def metres(values: np.ndarray, unit: float | None) -> FloatArray:
    """An image (H, W) in metres; unit: metres, by default INTEGER_UNIT for integers, else 1."""
    if unit is None:
        unit = INTEGER_UNIT if np.issubdtype(values.dtype, np.integer) else 1.0
    return values.astype(np.float64) * unit


def recorded(image: FloatArray, counts: BoolArray) -> tuple[np.ndarray, float]:
    """An image (H, W) of metres as uint16 with its unit in metres; 0 where it does not count."""
    kept = np.where(counts, image, 0.0)
    unit = FINE if kept.max(initial=0.0) < 65535 * FINE else COARSE
    return np.clip(np.rint(kept / unit), 0, 65535).astype(np.uint16), unit


def intrinsics_of(camera: PinholeCamera) -> FloatArray:
    """fx, fy, cx, cy (4,), pixels, as recordings have them."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])
