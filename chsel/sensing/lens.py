"""Distortion of camera images by the lens, undone in depth images.

A pinhole camera sees a point at (x, y) = (X / Z, Y / Z); the lens moves it to (x', y'), by the
model of Brown (1971) with tangential and thin prism terms, as OpenCV and ROS write it, or for a
fisheye by that of Kannala and Brandt (2006).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chsel.errors import SettingError, require_choice
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.sensing.depth_camera import PinholeCamera, valid_pixels

BROWN = ("plumb_bob", "rational_polynomial")
FISHEYE = ("equidistant", "fisheye")
_COUNTS = {**dict.fromkeys(BROWN, (4, 5, 8, 12, 14)), **dict.fromkeys(FISHEYE, (4,))}
_JUMP = 0.02  # share of the depth: neighbouring pixels that differ by more are not of one surface
_RADII = 1000  # distances from the axis at which the model is followed outward


@dataclass(frozen=True)
class LensDistortion:
    """How a lens moves what a camera sees. Raises SettingError for another kind of model."""

    model: str  # "plumb_bob" or "rational_polynomial", "equidistant" or "fisheye"
    coefficients: tuple[float, ...]
    """k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4[, tau_x, tau_y]]]]; or k1 to k4."""

    def __post_init__(self) -> None:
        require_choice("distortion model", self.model, accepted=tuple(_COUNTS))
        counts = _COUNTS[self.model]
        if len(self.coefficients) not in counts or not np.isfinite(self.coefficients).all():
            raise SettingError(
                f"distortion {self.model} has coefficients {list(self.coefficients)}; accepted: "
                f"finite ones, {' or '.join(map(str, counts))} of them"
            )
        if any(self.coefficients[12:]):
            raise SettingError(
                f"distortion has a tilted sensor, {self.coefficients[12:]}; accepted: tau of 0"
            )

    def distorted(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return x' and y' of what a pinhole camera sees at x and y, of any shape."""
        k = np.zeros(14)
        k[: len(self.coefficients)] = self.coefficients
        squared = x * x + y * y
        if self.model in FISHEYE:
            radius = np.sqrt(squared)
            angle = np.arctan(radius)
            a = angle * angle
            moved = angle * (1.0 + a * (k[0] + a * (k[1] + a * (k[2] + a * k[3]))))
            factor = np.divide(moved, radius, out=np.ones_like(radius), where=radius > 0.0)
            return factor * x, factor * y
        above = 1.0 + squared * (k[0] + squared * (k[1] + squared * k[4]))
        below = 1.0 + squared * (k[5] + squared * (k[6] + squared * k[7]))
        factor = above / below
        across = 2.0 * k[2] * x * y + k[3] * (squared + 2.0 * x * x)
        down = k[2] * (squared + 2.0 * y * y) + 2.0 * k[3] * x * y
        across += squared * (k[8] + squared * k[9])
        down += squared * (k[10] + squared * k[11])
        return factor * x + across, factor * y + down

    def undistorted(self, depth: FloatArray, camera: PinholeCamera) -> FloatArray:
        """Return depths (H, W) along z, metres, as a pinhole camera of these intrinsics sees them.

        depth (H, W): as the lens shows them. Between pixels of one surface the inverse of the depth
        is interpolated, so that a plane stays one; else the nearest pixel counts. 0: not seen.
        """
        column, row, seen = self._pixels(camera)
        depth = camera.image("depth", depth)
        valid = valid_pixels(depth, nearest=0.0, furthest=np.inf)
        inverse = np.zeros_like(depth)
        inverse[valid] = 1.0 / depth[valid]
        left, top = column.astype(np.int64), row.astype(np.int64)
        right = np.minimum(left + 1, camera.width - 1)
        bottom = np.minimum(top + 1, camera.height - 1)
        a, b = column - left, row - top
        corners = np.stack(
            [inverse[top, left], inverse[top, right], inverse[bottom, left], inverse[bottom, right]]
        )
        shares = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
        least = corners.min(axis=0)
        together = (least > 0.0) & (corners.max(axis=0) <= (1.0 + _JUMP) * least)
        nearest = np.take_along_axis(corners, shares.argmax(axis=0)[None], axis=0)[0]
        found = np.where(together, (corners * shares).sum(axis=0), nearest)
        found[~seen] = 0.0
        return np.divide(1.0, found, out=np.zeros_like(found), where=found > 0.0)

    def undistorted_mask(self, mask: BoolArray, camera: PinholeCamera) -> BoolArray:
        """Return a mask (H, W) as a pinhole camera of these intrinsics sees it: nearest pixels."""
        column, row, seen = self._pixels(camera)
        nearest = np.rint(row).astype(np.int64), np.rint(column).astype(np.int64)
        return np.asarray(camera.image("mask", mask, dtype=bool)[nearest] & seen)

    def _pixels(self, camera: PinholeCamera) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return where the lens puts each pixel's ray: column and row (H, W), and if in the image.

        Far from the axis, where a model's polynomials turn back, it does not hold.
        """
        x, y = np.meshgrid(camera.columns, camera.rows)
        radius = np.sqrt(x * x + y * y)
        outward = np.linspace(0.0, radius.max(), _RADII)
        moved = self.distorted(outward, np.zeros(_RADII))[0]
        back = np.flatnonzero(np.diff(moved) <= 0.0)
        furthest = outward[back[0]] if len(back) else np.inf
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            moved_x, moved_y = self.distorted(x, y)
            column = moved_x * camera.fx + camera.cx
            row = moved_y * camera.fy + camera.cy
            seen = (radius <= furthest) & (column >= 0.0) & (column <= camera.width - 1.0)
            seen &= (row >= 0.0) & (row <= camera.height - 1.0)
        return np.where(seen, column, 0.0), np.where(seen, row, 0.0), seen
