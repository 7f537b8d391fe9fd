"""Pinhole cameras, and which pixels of a depth image are reliable."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from chsel.errors import PointsError, SettingError, require_at_most, require_positive
from chsel.numerics.arrays import BoolArray, FloatArray

MOST_PIXELS = 100_000  # on a side


@dataclass(frozen=True)
class PinholeCamera:
    """A camera without distortion; its frame has x right, y down, z forward.

    The centre of the first pixel is at (0, 0). Raises SettingError for impossible values.
    """

    width: int  # of the image, pixels
    height: int
    fx: float  # focal lengths, pixels
    fy: float
    cx: float  # principal point, pixels
    cy: float

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            require_positive(f"camera {name}", value)
            require_at_most(f"camera {name}", value, MOST_PIXELS)
            if int(value) != value:
                raise SettingError(f"camera {name} is {value}; accepted: a whole number")
        require_positive("camera fx", self.fx)
        require_positive("camera fy", self.fy)
        for name, value in (("cx", self.cx), ("cy", self.cy)):
            if not np.isfinite(value):
                raise SettingError(f"camera {name} is {value}; accepted: a finite number")

    @property
    def columns(self) -> FloatArray:
        """x / z (W,) of what each column sees."""
        return (np.arange(self.width, dtype=np.float64) - self.cx) / self.fx

    @property
    def rows(self) -> FloatArray:
        """y / z (H,) of what each row sees."""
        return (np.arange(self.height, dtype=np.float64) - self.cy) / self.fy

    def directions(self) -> FloatArray:
        """Where each pixel looks (H, W, 3) in the camera frame, with z = 1."""
        return self.back_project(np.ones((self.height, self.width)))

    def back_project(self, depth: Any) -> FloatArray:
        """Points (H, W, 3) in the camera frame, metres, of depths (H, W) along z.

        Depths that are not finite give such points. Raises PointsError for another shape.
        """
        depth = self.image("depth", depth)
        with np.errstate(invalid="ignore"):  # 0 times infinity
            x, y = self.columns * depth, self.rows[:, None] * depth
        return np.stack([x, y, depth], axis=-1)

    def image(self, name: str, values: Any, dtype: Any = np.float64) -> np.ndarray:
        """Values (H, W) as an array. Raises PointsError for another shape."""
        values = np.asarray(values, dtype=dtype)
        if values.shape != (self.height, self.width):
            raise PointsError(
                f"{name} has shape {values.shape}; accepted: ({self.height}, {self.width}), as its "
                "camera"
            )
        return values


def valid_pixels(depth: FloatArray, *, nearest: float, furthest: float) -> BoolArray:
    """Whether pixels (H, W) have a depth from nearest to furthest, metres.

    Cameras mark pixels without a measurement by 0, NaN, infinity or a negative number.
    """
    depth = np.asarray(depth)
    return np.isfinite(depth) & (depth > 0.0) & (depth >= nearest) & (depth <= furthest)


def occlusion_edges(
    depth: FloatArray, valid: BoolArray, jump: float, *, reach: int = 1
) -> BoolArray:
    """Pixels (H, W) that differ by more than `jump` metres from one of their neighbours.

    On both sides of the jump, as either may be wrong. depth (H, W): metres. valid (H, W): pixels
    that count, all finite. reach: the distance in pixels, along rows and columns, up to which a
    pixel is a neighbour; 2 also finds jumps across one invalid pixel.
    """
    depth = np.where(valid, np.asarray(depth, np.float64), 0.0)
    nearest = _least_around(np.where(valid, depth, np.inf), reach)
    furthest = -_least_around(np.where(valid, -depth, np.inf), reach)
    return valid & ((furthest - depth > jump) | (depth - nearest > jump))


def nearest_around(
    depth: FloatArray, valid: BoolArray, pixels: BoolArray, *, reach: int
) -> FloatArray:
    """Depths (H, W) in which `pixels` (H, W) have the least of all valid ones around them.

    depth (H, W): metres. valid (H, W): pixels that count, those of `pixels` among them. reach: how
    many pixels away others are looked at, along rows and columns.
    """
    depth = np.asarray(depth, np.float64)
    if not pixels.any():
        return depth
    return np.where(pixels, _least_around(np.where(valid, depth, np.inf), reach), depth)


def _least_around(image: FloatArray, reach: int) -> FloatArray:
    """The least (H, W) of the pixels up to `reach` away from each, along rows and columns."""
    least = np.pad(image, reach, constant_values=np.inf)
    side, size = 1, 2 * reach + 1
    while side < size:
        step = min(side, size - side)
        least = np.minimum(least[step:], least[:-step])
        least = np.minimum(least[:, step:], least[:, :-step])
        side += step
    return least
