"""The outline of an object that is seen along an axis of the world, or obliquely."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import trimesh
from matplotlib.axes import Axes
from scipy.ndimage import binary_closing, binary_fill_holes, gaussian_filter

from chsel.numerics.arrays import FloatArray
from chsel.plausible.surface_distance import surface_points
from chsel.problem.poses import apply
from chsel.problem.streams import StreamKey

VIEWS = {"xz": (0, 2), "xy": (0, 1), "yz": (1, 2)}
"""The axes of the world that are drawn to the right and upwards."""
TRUE_POSE = "#000000"  # the colour of its outline, which is a broken line
CONTACT: Any = {
    "color": "#e69f00",
    "marker": "o",
    "markersize": 6.0,
    "markeredgecolor": "#222222",
    "linestyle": "none",
}
# The directions (2, 3) in the world that an oblique view has to the right and upwards.
_OBLIQUE = np.array([[0.795, -0.607, 0.0], [0.256, 0.336, 0.906]])
_POINTS = 12_000
_PIXELS = 160  # along the longer side of what is drawn


@dataclass(frozen=True)
class Frame:
    """What is drawn of the world."""

    axes: tuple[int, int]  # of the world, to the right and upwards
    lower: FloatArray  # (2,), the corner, metres
    upper: FloatArray  # (2,)

    @classmethod
    def around(cls, view: str, points: Sequence[FloatArray], margin: float) -> Frame:
        """What holds all points (N, 3) with a margin, metres. view: of VIEWS."""
        flat = np.concatenate(points)[:, list(VIEWS[view])]
        return cls(VIEWS[view], flat.min(axis=0) - margin, flat.max(axis=0) + margin)

    def set_on(self, axes: Axes, *, bottom: bool = True, left: bool = True) -> None:
        """The limits and labels of a panel. bottom, left: whether the axes there have a label."""
        axes.set(xlim=(self.lower[0], self.upper[0]), ylim=(self.lower[1], self.upper[1]))
        axes.set_aspect("equal")
        axes.grid(visible=False)
        right, up = (f"{'xyz'[axis]} in m" for axis in self.axes)
        axes.set(xlabel=right if bottom else "", ylabel=up if left else "")

    @property
    def aspect(self) -> float:
        """Height by width."""
        width, height = self.upper - self.lower
        return float(height / width)

    def flat(self, points: FloatArray) -> FloatArray:
        """Points (N, 3) as they are seen (N, 2)."""
        return points[:, list(self.axes)]

    @property
    def pixel(self) -> float:
        """Side in metres of the pixels in which silhouettes are found."""
        return float((self.upper - self.lower).max()) / _PIXELS


@dataclass(frozen=True)
class Oblique(Frame):
    """What is drawn of the world as seen from afar, from behind probes along +x and from above."""

    @classmethod
    def holding(cls, points: FloatArray, margin: float, *, aspect: float) -> Oblique:
        """What holds all points (N, 3) with a margin, metres, in a panel of an aspect."""
        flat = points @ _OBLIQUE.T
        centre, size = 0.5 * (flat.min(axis=0) + flat.max(axis=0)), np.ptp(flat, axis=0)
        width = max(size[0] + 2.0 * margin, (size[1] + 2.0 * margin) / aspect)
        half = 0.5 * width * np.array([1.0, aspect])
        return cls((0, 1), centre - half, centre + half)

    def flat(self, points: FloatArray) -> FloatArray:
        """Points (N, 3) as they are seen (N, 2)."""
        return points @ _OBLIQUE.T

    def set_on(self, axes: Axes, *, bottom: bool = True, left: bool = True) -> None:
        """The limits of a panel without axes."""
        super().set_on(axes, bottom=bottom, left=left)
        axes.set_axis_off()


class Silhouettes:
    """Draws outlines of one mesh in any pose."""

    def __init__(self, mesh: trimesh.Trimesh, frame: Frame) -> None:
        self._points = surface_points(mesh, _POINTS, StreamKey(0, 0))
        self._frame = frame

    def fill(self, axes: Axes, world_from_object: FloatArray, color: str, *, alpha: float) -> None:
        """All that is behind the mesh in one pose (4, 4); nothing where it is out of sight."""
        mask = self.mask(world_from_object)
        if mask.any():
            smooth = np.pad(gaussian_filter(mask.astype(float), 0.8), 1)
            axes.contourf(*self._centres(1), smooth.T, [0.5, 2.0], colors=[color], alpha=alpha)

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
        flat = frame.flat(apply(world_from_object, self._points))
        count = np.ceil((frame.upper - frame.lower) / frame.pixel).astype(int)
        index = np.floor((flat - frame.lower) / frame.pixel).astype(int)
        seen = ((index >= 0) & (index < count)).all(axis=1)
        mask = np.zeros(count, dtype=bool)
        mask[tuple(index[seen].T)] = True
        padded = np.pad(mask, 3)  # closing takes what is beyond the border for nothing
        closed = binary_fill_holes(binary_closing(padded, iterations=3))
        return np.asarray(closed)[3:-3, 3:-3]

    def _centres(self, beyond: int = 0) -> tuple[FloatArray, FloatArray]:
        """Where the pixels are, with some beyond the border."""
        frame = self._frame
        count = np.ceil((frame.upper - frame.lower) / frame.pixel).astype(int)
        x, y = (
            frame.lower[i] + (np.arange(-beyond, count[i] + beyond) + 0.5) * frame.pixel
            for i in range(2)
        )
        return x, y


def corners_in(mesh: trimesh.Trimesh, poses: Iterable[FloatArray]) -> FloatArray:
    """The corners of the mesh's box (8 P, 3) in poses world_from_object (4, 4)."""
    corners = np.asarray(mesh.bounding_box.vertices, dtype=np.float64)
    return np.concatenate([apply(pose, corners) for pose in poses])


def pose_table(poses: FloatArray, /, **columns: Any) -> pd.DataFrame:
    """A row per pose (P, 4, 4): columns of the same values or of a value each, then the pose.

    r00 to r22: its rotation by row and column; x, y, z: its translation, metres.
    """
    names = [f"r{row}{column}" for row in range(3) for column in range(3)]
    rotations = pd.DataFrame(poses[:, :3, :3].reshape(-1, 9), columns=names)
    translations = pd.DataFrame(poses[:, :3, 3], columns=["x", "y", "z"])
    first = pd.DataFrame(columns, index=rotations.index)
    return pd.concat([first, rotations, translations], axis=1)


def point_table(points: FloatArray, /, **columns: Any) -> pd.DataFrame:
    """A row per point (P, 3): columns as in `pose_table`, then x, y, z, metres."""
    found = pd.DataFrame(points, columns=["x", "y", "z"])
    return pd.concat([pd.DataFrame(columns, index=found.index), found], axis=1)
