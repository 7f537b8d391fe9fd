"""The images of a robot session's sensors: pictures of what counts, depth cameras in the scene."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import rerun as rr

from replay.colors import BACKGROUND, CAMERA, CONTACT
from replay.events import SensorImage
from replay.rerun.plane import Frame, lines, texts

DEFORMATION = "deformation"
_LONGEST_SIDE = 320  # pixels of a picture: of larger images, every so many rows and columns
_MOST = 12  # sensors
_DEEPEST = 0.010  # metres of deformation that have the last colour
_PERCENTILES = (1.0, 99.0)  # of a camera's first image, that have the first and the last colour
_FRUSTUM = 0.12  # metres from a camera to its picture plane
_POINT_FILL = 0.25  # of the room that a point of a camera has in the scene
_COUNTS, _LEFT_OUT, _NOTHING = 0, 1, 2  # classes of pixels
_USED = {
    _COUNTS: (*CONTACT, 0),
    _LEFT_OUT: (*BACKGROUND, 150),
    _NOTHING: (*BACKGROUND, 255),
}
_TOUCHED = {
    _COUNTS: (*CONTACT, 170),
    _LEFT_OUT: (*BACKGROUND, 0),
    _NOTHING: (*BACKGROUND, 255),
}
_NAMES = {
    "depth": ("free along its ray", "not used", "no measurement"),
    DEFORMATION: ("in contact", "not in contact", "no measurement"),
}


@dataclass(frozen=True)
class SensorPicture:
    """What a view has to make room for: the sensor's name, the kind and size of its images."""

    sensor: str
    kind: str
    frame: Frame

    @property
    def title(self) -> str:
        """What the view shows, and in which colours."""
        if self.kind == DEFORMATION:
            return f"{self.sensor}; red: contact"
        return f"{self.sensor}; dark: not used"


class SensorImages:
    """Draws images under `root`, and depth cameras in the scene.

    At a probe, the picture of a camera is the last of that probe, and that of a pad the one with
    the largest contact; all others stand at moments of their own on the timeline of iterations.
    """

    def __init__(
        self, stream: rr.RecordingStream, root: str = "sensors", scene: str = "scene/cameras"
    ) -> None:
        self.pictures: dict[str, SensorPicture] = {}
        self._stream = stream
        self._root = root
        self._scene = scene
        self._ranges: dict[str, tuple[float, float]] = {}
        self._of_step: dict[str, SensorImage] = {}  # what a probe shows of each sensor
        self._shown: dict[str, SensorImage] = {}
        self._left: dict[str, SensorImage] = {}  # what the last probe that ended left to see

    def add(self, image: SensorImage) -> bool:
        """Draw an image at the present moment; whether it is the first of its sensor.

        Of more sensors than there is room for, the first ones are drawn.
        """
        new = image.sensor not in self.pictures
        if new and len(self.pictures) == _MOST:
            return False
        small = display_size(image)
        if new:
            self._set_up(small)
        best = self._of_step.get(image.sensor)
        if best is None or image.kind != DEFORMATION or image.mask.sum() >= best.mask.sum():
            self._of_step[image.sensor] = image
        self._draw(image, small)
        return new

    def end_step(self) -> None:
        """A probe's images are all there: show what it shows of them, and no touch from before."""
        for sensor, picture in self.pictures.items():
            best = self._of_step.get(sensor)
            if best is None and picture.kind == DEFORMATION:
                for name in ("values", "pixels", "caption"):
                    self._stream.log(f"{self._root}/{sensor}/{name}", rr.Clear(recursive=False))
                self._left.pop(sensor, None)
            elif best is not None and self._shown.get(sensor) is not best:
                self._draw(best, display_size(best))
        self._left |= self._of_step
        self._of_step.clear()
        self._shown.clear()

    def draw_again(self) -> None:
        """Draw what the last probe left to see once more, at the present moment."""
        for image in self._left.values():
            self._draw(image, display_size(image))
        self._shown.clear()

    def _set_up(self, image: SensorImage) -> None:
        """Colours and frame of a sensor, from its first image."""
        height, width = image.values.shape
        frame = Frame(float(width), float(height))
        self.pictures[image.sensor] = SensorPicture(image.sensor, image.kind, frame)
        low, high = 0.0, _DEEPEST
        if image.kind != DEFORMATION:
            depths = image.values[image.values > 0] * image.unit
            ends = np.percentile(depths, _PERCENTILES) if len(depths) else np.array([0.0, 1.0])
            low, high = ends.tolist()
        self._ranges[image.sensor] = (low, max(high, low + image.unit))
        colors = _TOUCHED if image.kind == DEFORMATION else _USED
        names = _NAMES["depth" if image.kind != DEFORMATION else DEFORMATION]
        classes = [(number, names[number], color) for number, color in colors.items()]
        root = f"{self._root}/{image.sensor}"
        self._stream.log(root, rr.AnnotationContext(classes), static=True)
        self._stream.log(f"{root}/frame", lines(frame.outline()), static=True)

    def _draw(self, image: SensorImage, small: SensorImage) -> None:
        """image: as recorded; small: as drawn."""
        self._shown[image.sensor] = image
        root = f"{self._root}/{image.sensor}"
        self._stream.log(f"{root}/values", self._values(small))
        pixels = rr.SegmentationImage(pixel_classes(small), opacity=1.0, draw_order=-20.0)
        self._stream.log(f"{root}/pixels", pixels)
        self._stream.log(f"{root}/caption", texts([self._caption(image)]))
        if image.kind != DEFORMATION:
            self._draw_camera(small)

    def _values(self, image: SensorImage) -> rr.DepthImage:
        low, high = self._ranges[image.sensor]
        touch = image.kind == DEFORMATION
        return rr.DepthImage(
            image.values,
            meter=1.0 / image.unit,
            depth_range=(low / image.unit, high / image.unit),
            colormap=rr.components.Colormap.Grayscale if touch else rr.components.Colormap.Turbo,
            draw_order=-30.0,
        )

    def _caption(self, image: SensorImage) -> tuple[float, float, str]:
        """Of which probe, how many pixels count, and what the first and last colour stand for."""
        low, high = self._ranges[image.sensor]
        if image.kind == DEFORMATION:
            scale, counts = f"{1000.0 * low:.0f} to {1000.0 * high:.0f} mm", "in contact"
        else:
            scale, counts = f"{low:.2f} to {high:.2f} m", "used"
        share = 100.0 * float(image.mask.mean())
        frame = self.pictures[image.sensor].frame
        text = f"probe {image.step}: {share:.1f} % {counts}; {scale}"
        return frame.width / 2, -0.11 * frame.height, text

    def _draw_camera(self, image: SensorImage) -> None:
        """A depth camera where it stands, and the points that it sees."""
        entity = f"{self._scene}/{image.sensor}"
        height, width = image.values.shape
        fx, fy, cx, cy = image.intrinsics.tolist()
        pose = image.world_from_camera
        where = rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])
        pinhole = rr.Pinhole(
            focal_length=(fx, fy),
            principal_point=(cx, cy),
            resolution=(width, height),
            image_plane_distance=_FRUSTUM,
            color=CAMERA,
            line_width=-1.2,  # below 0: in points of the screen
        )
        self._stream.log(entity, where, pinhole)
        low, high = self._ranges[image.sensor]
        span = high - low
        points = rr.DepthImage(
            image.values,
            meter=1.0 / image.unit,
            depth_range=((low - 0.4 * span) / image.unit, (high + 2.0 * span) / image.unit),
            colormap=rr.components.Colormap.Grayscale,  # faint: other colours mean something here
            point_fill_ratio=_POINT_FILL,
        )
        self._stream.log(f"{entity}/depth", points)


def pixel_classes(image: SensorImage) -> np.ndarray:
    """Class of each pixel (H, W): it counts, it does not, or it measured nothing."""
    classes = np.where(image.mask, _COUNTS, _LEFT_OUT)
    if image.kind != DEFORMATION:
        classes[(image.values == 0) & ~image.mask] = _NOTHING
    return classes.astype(np.uint8)


def display_size(image: SensorImage) -> SensorImage:
    """The image as it is drawn: every so many rows and columns of a larger one."""
    every = -(-max(image.values.shape) // _LONGEST_SIDE)
    return replace(
        image,
        values=np.ascontiguousarray(image.values[::every, ::every]),
        mask=np.ascontiguousarray(image.mask[::every, ::every]),
        intrinsics=image.intrinsics / every,
    )
