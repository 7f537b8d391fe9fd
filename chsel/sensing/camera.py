"""A pinhole camera without distortion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from chsel.arrays import FloatArray
from chsel.errors import PointsError, SettingError, require_at_most, require_positive

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
