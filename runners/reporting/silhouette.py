"""The outline of an object that is seen along an axis of the world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from matplotlib.axes import Axes
from scipy.ndimage import binary_closing, binary_fill_holes, gaussian_filter

from chsel.numerics.arrays import FloatArray
from chsel.plausible.surface_distance import surface_points
from chsel.problem.poses import apply
from chsel.problem.streams import StreamKey

VIEWS = {"xz": (0, 2), "xy": (0, 1), "yz": (1, 2)}
"""The axes of the world that are drawn to the right and upwards."""
_POINTS = 12_000
_PIXELS = 160  # along the longer side of what is drawn


@dataclass(frozen=True)
class Frame:
    """What is drawn of the world: lower and upper corner (2,) in metres, of these axes."""

    axes: tuple[int, int]
    lower: FloatArray
    upper: FloatArray

    @property
    def pixel(self) -> float:
        """Side in metres of the pixels in which silhouettes are found."""
        return float((self.upper - self.lower).max()) / _PIXELS


class Silhouettes:
    """Draws outlines of one mesh in any pose."""

    def __init__(self, mesh: trimesh.Trimesh, frame: Frame) -> None:
        self._points = surface_points(mesh, _POINTS, StreamKey(0, 0))
        self._frame = frame

    def draw(
        self,
        axes: Axes,
        world_from_object: FloatArray,
        color: str,
        *,
        width: float,
        alpha: float = 1.0,
        style: str = "solid",
    ) -> None:
        """The outline of the mesh in one pose (4, 4); nothing where it is out of sight."""
        mask = self.mask(world_from_object)
        if not mask.any():
            return
        smooth = gaussian_filter(mask.astype(float), 0.8)
        x, y = self._centres()
        axes.contour(
            x, y, smooth.T, [0.5], colors=color, linewidths=width, alpha=alpha, linestyles=style
        )

    def mask(self, world_from_object: FloatArray) -> FloatArray:
        """The pixels (right, up) behind the mesh in one pose (4, 4), as booleans."""
        frame = self._frame
        flat = apply(world_from_object, self._points)[:, list(frame.axes)]
        count = np.ceil((frame.upper - frame.lower) / frame.pixel).astype(int)
        index = np.floor((flat - frame.lower) / frame.pixel).astype(int)
        seen = ((index >= 0) & (index < count)).all(axis=1)
        mask = np.zeros(count, dtype=bool)
        mask[tuple(index[seen].T)] = True
        padded = np.pad(mask, 3)  # closing takes what is beyond the border for nothing
        closed = binary_fill_holes(binary_closing(padded, iterations=3))
        return np.asarray(closed)[3:-3, 3:-3]

    def _centres(self) -> tuple[FloatArray, FloatArray]:
        frame = self._frame
        count = np.ceil((frame.upper - frame.lower) / frame.pixel).astype(int)
        x, y = (frame.lower[i] + (np.arange(count[i]) + 0.5) * frame.pixel for i in range(2))
        return x, y
