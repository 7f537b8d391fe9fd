"""The images of a robot session's sensors: pictures of what counts, depth cameras in the scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import rerun as rr
from rerun.components import Colormap

from chsel.events import SensorImage
from replay.colors import BACKGROUND, CAMERA, CONTACT

DEFORMATION = "deformation"
_LONGEST_SIDE = 320  # pixels of a picture: of larger images, every so many rows and columns
_MOST = 12  # sensors
_DEEPEST = 0.010  # metres of deformation that have the last colour
_FRUSTUM = 0.12  # metres from a camera to its picture plane
_POINT_FILL = 0.25  # of the room that a point of a camera has in the scene
# classes of pixels
_COUNTS = 0
_LEFT_OUT = 1
_NOTHING = 2
_CLASSES = {
    "depth": (
        (_COUNTS, "free along its ray", (*CONTACT, 0)),
        (_LEFT_OUT, "not used", (*BACKGROUND, 150)),
        (_NOTHING, "no measurement", (*BACKGROUND, 255)),
    ),
    DEFORMATION: (
        (_COUNTS, "in contact", (*CONTACT, 170)),
        (_LEFT_OUT, "not in contact", (*BACKGROUND, 0)),
    ),
}


class SensorImages:
    """Images under `sensors`, and depth cameras in the scene.

    At a probe, the picture of a camera is the last of that probe, and that of a pad the one with
    the largest contact; all others stand at moments of their own on the timeline of iterations.
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        self.titles: dict[str, str] = {}  # of views, by sensor
        self._stream = stream
        self._touches: dict[str, SensorImage | None] = {}  # the largest of this probe, by pad

    def add(self, image: SensorImage) -> None:
        """Draw an image. Of more sensors than there is room for, the first ones are drawn."""
        if image.sensor not in self.titles:
            if len(self.titles) == _MOST:
                return
            meaning = "red: contact" if image.kind == DEFORMATION else "dark: not used"
            self.titles[image.sensor] = f"{image.sensor}; {meaning}"
            classes = rr.AnnotationContext(_CLASSES[image.kind])
            self._stream.log(f"sensors/{image.sensor}", classes, static=True)
        if image.kind == DEFORMATION:
            best = self._touches.get(image.sensor)
            if best is None or image.mask.sum() >= best.mask.sum():
                self._touches[image.sensor] = image
        self._draw(image)

    def end_step(self) -> None:
        """Show the largest contacts of a probe whose images are complete, and none from before."""
        for sensor, best in self._touches.items():
            if best is None:
                self._stream.log(f"sensors/{sensor}", rr.Clear(recursive=True))
            else:
                self._draw(best)
            self._touches[sensor] = None

    def _draw(self, image: SensorImage) -> None:
        image = display_size(image)
        root = f"sensors/{image.sensor}"
        meter = 1.0 / image.unit
        touch = image.kind == DEFORMATION
        values = rr.DepthImage(
            image.values,
            meter=meter,
            depth_range=(0.0, _DEEPEST * meter) if touch else None,
            colormap=Colormap.Grayscale if touch else Colormap.Turbo,
            draw_order=-30.0,
        )
        self._stream.log(f"{root}/values", values)
        pixels = rr.SegmentationImage(pixel_classes(image), opacity=1.0, draw_order=-20.0)
        self._stream.log(f"{root}/pixels", pixels)
        if not touch:
            self._draw_camera(image, meter)

    def _draw_camera(self, image: SensorImage, meter: float) -> None:
        """Draw a depth camera at its pose, and the points that it sees."""
        entity = f"scene/cameras/{image.sensor}"
        pose = image.world_from_camera
        height, width = image.values.shape
        fx, fy, cx, cy = image.intrinsics.tolist()
        pinhole = rr.Pinhole(
            focal_length=(fx, fy),
            principal_point=(cx, cy),
            resolution=(width, height),
            image_plane_distance=_FRUSTUM,
            color=CAMERA,
            line_width=-1.2,  # below 0: in points of the screen
        )
        where = rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])
        self._stream.log(entity, where, pinhole)
        points = rr.DepthImage(
            image.values,
            meter=meter,
            depth_range=(0.0, 3.0 * float(image.values.max())),
            colormap=Colormap.Grayscale,  # faint: other colours mean something here
            point_fill_ratio=_POINT_FILL,
        )
        self._stream.log(f"{entity}/depth", points)


def pixel_classes(image: SensorImage) -> np.ndarray:
    """Return the class (H, W) of each pixel: it counts, does not, or measured nothing."""
    classes = np.where(image.mask, _COUNTS, _LEFT_OUT)
    if image.kind != DEFORMATION:
        classes[(image.values == 0) & ~image.mask] = _NOTHING
    return classes.astype(np.uint8)


def display_size(image: SensorImage) -> SensorImage:
    """Return the image as it is drawn: every so many rows and columns of a larger one."""
    every = -(-max(image.values.shape) // _LONGEST_SIDE)
    return replace(
        image,
        values=np.ascontiguousarray(image.values[::every, ::every]),
        mask=np.ascontiguousarray(image.mask[::every, ::every]),
        intrinsics=image.intrinsics / every,
    )
