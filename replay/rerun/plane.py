"""Drawings with axes in a 2-D view: a unit of the view is whatever the drawing says it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import rerun as rr

from replay.colors import FRAME, TEXT, Rgb

_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
Label = tuple[float, float, str]
"""A place in the view, y down, and the text around it."""


@dataclass(frozen=True)
class Frame:
    """The rectangle of a drawing: width and height in units of the view, origin at the top left."""

    width: float
    height: float

    def x(self, fraction: float) -> float:
        """Place of a fraction of the horizontal axis, from the left."""
        return fraction * self.width

    def y(self, fraction: float) -> float:
        """Place of a fraction of the vertical axis, from the bottom."""
        return (1.0 - fraction) * self.height

    def outline(self) -> list[list[tuple[float, float]]]:
        """The border as one closed line."""
        width, height = self.width, self.height
        return [[(0.0, 0.0), (width, 0.0), (width, height), (0.0, height), (0.0, 0.0)]]


def ticks(lower: float, upper: float, *, most: int = 5) -> list[float]:
    """Round numbers in [lower, upper], at most `most` of them; the ends if none is round."""
    span = upper - lower
    if not span > 0.0 or not np.isfinite(span):
        return [lower]
    power = 10.0 ** np.floor(np.log10(span / most))
    for factor in _STEPS:
        step = factor * power
        first, last = np.ceil(lower / step - 1e-9), np.floor(upper / step + 1e-9)
        if last - first + 1 <= most:
            return [float(n * step) + 0.0 for n in np.arange(first, last + 1)] or [lower, upper]
    return [lower, upper]


@cache
def on_screen(radius: float) -> Any:
    """One radius in points of the screen, however far away: an array that Rerun takes as it is."""
    points = np.asarray(rr.Radius.ui_points(radius), dtype=np.float32).reshape(1)
    return rr.components.RadiusBatch(points).as_arrow_array()


@cache
def color_array(*colors: Rgb) -> Any:
    """Colours, the last of them for all further things: an array that Rerun takes as it is."""
    return rr.components.ColorBatch(colors).as_arrow_array()


def texts(labels: Sequence[Label], color: Rgb = TEXT) -> rr.Points2D:
    """Texts without points, each centred on its place."""
    return rr.Points2D(
        np.array([label[:2] for label in labels], dtype=np.float32).reshape(-1, 2),
        labels=[label[2] for label in labels],
        colors=color_array(color),
        radii=on_screen(0.0),
        show_labels=True,
    )


def lines(strips: Sequence[object], *colors: Rgb, width: float = 1.0) -> rr.LineStrips2D:
    """Line strips, each a sequence of (x, y), of a width in points of the screen.

    colors: of each strip, the last for all further ones; FRAME if there is none.
    """
    arrays = [np.asarray(strip, dtype=np.float32).reshape(-1, 2) for strip in strips]
    drawn = color_array(*(colors or (FRAME,)))
    return rr.LineStrips2D(arrays, colors=drawn, radii=on_screen(width / 2))
