"""The twin's cameras: pinholes, whose pixel (u, v) looks along ((u - cx) / f, (v - cy) / f, 1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chsel.numerics.arrays import FloatArray


@dataclass(frozen=True)
class Pinhole:
    """width, height, focal: pixels. near, far: metres, between which something can be seen."""

    width: int
    height: int
    focal: float
    near: float
    far: float

    @property
    def center(self) -> tuple[float, float]:
        """Where the optical axis meets the image, pixels: its middle."""
        return (self.width - 1) / 2.0, (self.height - 1) / 2.0

    def slopes(self) -> tuple[FloatArray, FloatArray]:
        """x / z and y / z (H, W) of every pixel's ray, optical frame."""
        cx, cy = self.center
        v, u = np.indices((self.height, self.width), dtype=np.float64)
        return (u - cx) / self.focal, (v - cy) / self.focal
