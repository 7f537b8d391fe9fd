"""Which pixels of a depth image can be believed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from chsel.errors import PointsError, SettingError, require_at_most, require_positive
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.sensing.ray_kernels import window_minimum

MOST_PIXELS = 100_000  # on a side


@dataclass(frozen=True)
class PinholeCamera:
    """Size of the image, focal lengths and principal point, all in pixels.

    The centre of the first pixel is at (0, 0). Camera frame: x right, y down, z forward.
    Raises SettingError for what no camera has.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            require_positive(f"camera {name}", value)
            require_at_most(f"camera {name}", value, MOST_PIXELS)
            if int(value) != value:
                raise SettingError(f"camera {name} is {value}; accepted: a whole number")
        for name in ("fx", "fy"):
            require_positive(f"camera {name}", getattr(self, name))
        for name in ("cx", "cy"):
            if not np.isfinite(getattr(self, name)):
                value = getattr(self, name)
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

        Depths that are not finite give points that are not. Raises PointsError for another shape.
        """
        depth = self.image("depth", depth)
        with np.errstate(invalid="ignore"):  # 0 times infinity
            x, y = self.columns * depth, self.rows[:, None] * depth
        return np.stack([x, y, depth], axis=-1)

    def image(self, name: str, values: Any, dtype: Any = np.float64) -> np.ndarray:
        """Values (H, W) as they are, one a pixel. Raises PointsError for another shape."""
        values = np.asarray(values, dtype=dtype)
        if values.shape != (self.height, self.width):
            raise PointsError(
                f"{name} has shape {values.shape}; accepted: ({self.height}, {self.width}), as its "
                "camera"
            )
        return values


def valid_pixels(depth: FloatArray, *, nearest: float, furthest: float) -> BoolArray:
    """Whether pixels (H, W) have a depth from nearest to furthest, metres.

    A camera tells that it could not measure by 0, nan, infinity or a negative number.
    """
    depth = np.asarray(depth)
    return np.isfinite(depth) & (depth > 0.0) & (depth >= nearest) & (depth <= furthest)


def occlusion_edges(
    depth: FloatArray, valid: BoolArray, jump: float, *, reach: int = 1
) -> BoolArray:
    """Pixels (H, W) that a jump of more than `jump` metres parts from one of their neighbours.

    On both sides of the jump, as either may have been measured across it. depth (H, W): metres.
    valid (H, W): pixels that count, and that can be edges. reach: how many pixels away, along rows
    and columns, a neighbour may be; 2 also finds jumps where one pixel between them is invalid.
    """
    own = np.where(valid, depth, 0.0)
    nearest = _least_around(np.where(valid, depth, np.inf), reach)
    furthest = -_least_around(np.where(valid, -own, np.inf), reach)
    return valid & ((furthest - own > jump) | (own - nearest > jump))


def _least_around(image: FloatArray, reach: int) -> FloatArray:
    """The least (H, W) of the pixels up to `reach` away from each, along rows and columns."""
    height, width = image.shape
    padded = np.full((height + 2 * reach, width + 2 * reach), np.inf)
    padded[reach : reach + height, reach : reach + width] = image
    window_minimum(padded, 2 * reach + 1)
    return padded[:height, :width]
