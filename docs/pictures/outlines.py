"""Outlines of a mesh in many poses, seen along an axis of the world or obliquely."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image
from scipy.ndimage import binary_closing, binary_fill_holes, gaussian_filter

from chsel.numerics.arrays import FloatArray
from chsel.plausible.surface_distance import surface_points
from chsel.problem.poses import apply
from chsel.problem.streams import StreamKey

TRUE_POSE = "#000000"
POSES = "#0072b2"
CONTACT: Any = {
    "color": "#e69f00",
    "marker": "o",
    "markersize": 6.0,
    "markeredgecolor": "#222222",
    "linestyle": "none",
    "zorder": 6.0,
}
# Rows: the directions in the world that a view has to the right and upwards.
VIEWS = {
    "xz": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "xy": np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "yz": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "oblique": np.array([[0.795, -0.607, 0.0], [0.256, 0.336, 0.906]]),
}
_POINTS = 12_000  # on the mesh's surface
_PIXELS = 160  # along the longer side of a panel


@dataclass(frozen=True)
class Frame:
    """The part of the world that a panel shows."""

    view: str
    lower: FloatArray  # (2,), metres
    upper: FloatArray  # (2,)

    @classmethod
    def around(
        cls, view: str, points: Sequence[FloatArray], margin: float, aspect: float | None = None
    ) -> Frame:
        """What holds all points (N, 3) with a margin, metres; aspect: height by width."""
        flat = np.concatenate(points) @ VIEWS[view].T
        lower, upper = flat.min(axis=0) - margin, flat.max(axis=0) + margin
        if aspect is not None:
            width = max(upper[0] - lower[0], (upper[1] - lower[1]) / aspect)
            half = 0.5 * width * np.array([1.0, aspect])
            lower, upper = (lower + upper) / 2.0 - half, (lower + upper) / 2.0 + half
        return cls(view, lower, upper)

    @property
    def aspect(self) -> float:
        """Height by width."""
        return float(np.divide(*(self.upper - self.lower)[::-1]))

    def flat(self, points: FloatArray) -> FloatArray:
        """Points (N, 3) as they are seen (N, 2)."""
        return points @ VIEWS[self.view].T

    def set_on(self, axes: Axes) -> None:
        """Limits and labels of a panel."""
        axes.set(xlim=(self.lower[0], self.upper[0]), ylim=(self.lower[1], self.upper[1]))
        axes.set_aspect("equal")
        axes.grid(visible=False)
        if self.view == "oblique":
            axes.set_axis_off()
        else:
            axes.set(xlabel=f"{self.view[0]} in m", ylabel=f"{self.view[1]} in m")


class Outlines:
    """Draws one mesh in any pose."""

    def __init__(self, mesh: trimesh.Trimesh, frame: Frame) -> None:
        self._points, self.frame = surface_points(mesh, _POINTS, StreamKey(0, 0)), frame

    def draw(self, axes: Axes, world_from_object: FloatArray, color: str, **look: Any) -> None:
        """The outline in one pose (4, 4). look: as for contours."""
        axes.contour(*self._covered(world_from_object), [0.5], colors=color, **look)

    def fill(self, axes: Axes, world_from_object: FloatArray, color: str) -> None:
        """All that is behind the mesh."""
        axes.contourf(*self._covered(world_from_object), [0.5, 2.0], colors=[color], alpha=0.75)

    def _covered(self, world_from_object: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Centres of pixels along both axes, and how far each pixel (up, right) is covered."""
        frame = self.frame
        side = float((frame.upper - frame.lower).max()) / _PIXELS
        flat = frame.flat(apply(world_from_object, self._points))
        edges = [
            np.arange(frame.lower[i] - 3 * side, frame.upper[i] + 3 * side, side) for i in (0, 1)
        ]
        hit = np.histogram2d(*flat.T, bins=edges)[0] > 0
        filled = binary_fill_holes(binary_closing(hit, iterations=3))
        x, y = (some[:-1] + side / 2 for some in edges)
        return x, y, gaussian_filter(filled.astype(float), 0.8).T


def corners_in(mesh: trimesh.Trimesh, poses: Iterable[FloatArray]) -> FloatArray:
    """The corners of the mesh's box (8 P, 3) in poses world_from_object (4, 4)."""
    return np.concatenate([apply(pose, trimesh.bounds.corners(mesh.bounds)) for pose in poses])


def small_png(image: Image.Image, path: Path) -> None:
    """Write a picture in few colours."""
    method = Image.Quantize.FASTOCTREE  # keeps colours of few pixels, such as contacts
    few = image.convert("RGB").quantize(256, method=method, dither=Image.Dither.NONE)
    few.save(path, optimize=True)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as a small PNG file."""
    small_png(as_image(figure, dpi=120), path)


def as_image(figure: Figure, dpi: float) -> Image.Image:
    """A figure as pixels."""
    figure.set_dpi(dpi)
    figure.canvas.draw()
    return Image.fromarray(np.asarray(figure.canvas.buffer_rgba()))
