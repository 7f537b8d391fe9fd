"""Colours of the Rerun recording: costs and scores on maps, and one colour per kind of thing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chsel.numerics.arrays import FloatArray

Rgb = tuple[int, int, int]
ColorArray = NDArray[np.uint8]

BACKGROUND: Rgb = (22, 24, 29)
EMPTY_CELL: Rgb = (52, 55, 62)
FRAME: Rgb = (120, 125, 135)
GRID: Rgb = (40, 43, 50)
TEXT: Rgb = (205, 210, 218)
OBJECT: Rgb = (215, 218, 224)
CONTACT: Rgb = (255, 60, 90)
FREE: Rgb = (96, 160, 225)
FREE_FAINT: Rgb = (58, 84, 116)
OCCUPIED: Rgb = (240, 140, 40)
KNOWN: Rgb = (225, 120, 220)
GRIPPER: Rgb = (255, 255, 255)
HAND: Rgb = (150, 190, 230)
CAMERA: Rgb = (90, 210, 190)
PAST: Rgb = (140, 146, 156)
CHOSEN: Rgb = (255, 250, 225)
FORECAST: Rgb = (255, 170, 190)
UNAVAILABLE: Rgb = (104, 108, 120)

COSTS: dict[str, Rgb] = {
    "lowest": (253, 220, 60),
    "median": (53, 183, 121),
    "highest": (120, 130, 200),
}
"""Curves of a set of costs."""
SERIES: tuple[Rgb, ...] = (
    (86, 180, 233),
    (230, 159, 0),
    (0, 190, 130),
    (204, 121, 167),
    (240, 228, 66),
    (213, 94, 0),
    (150, 150, 255),
)
"""Colours of other curves, in the order in which they come."""

# Viridis, at equal steps from dark to bright; between them, colours are interpolated.
_VIRIDIS = np.array(
    [
        (68, 1, 84),
        (72, 40, 120),
        (62, 74, 137),
        (49, 104, 142),
        (38, 130, 142),
        (31, 158, 137),
        (53, 183, 121),
        (110, 206, 88),
        (181, 222, 43),
        (253, 231, 37),
    ],
    dtype=np.float64,
)
# From brown over orange to pale yellow, as costs of hypotheses have the other map.
_EMBERS = np.array(
    [(92, 44, 28), (160, 70, 20), (226, 110, 20), (255, 170, 60), (255, 240, 190)],
    dtype=np.float64,
)
_LEVELS = 1023  # no two neighbours differ by more than one in a colour
_FLOOR = 1e-4  # costs below this fraction of the highest one have the colour of the lowest


@dataclass(frozen=True)
class CostScale:
    """Logarithmic scale from the lowest cost (0, bright) to the highest (1, dark)."""

    low: float
    high: float

    @classmethod
    def of(cls, cost: ArrayLike) -> CostScale:
        """Return the scale of the finite ones of some costs, 0 to 0 if there are none."""
        values = np.asarray(cost, dtype=np.float64).ravel()
        values = values[np.isfinite(values)]
        return cls(float(values.min()), float(values.max())) if len(values) else cls(0.0, 0.0)

    def fraction(self, cost: ArrayLike) -> FloatArray:
        """Return place of each cost on the scale, in [0, 1]."""
        values = np.asarray(cost, dtype=np.float64)
        start = max(self.low, self.high * _FLOOR)
        if not start < self.high:
            return np.zeros(values.shape)
        logs = np.log(np.clip(values, start, self.high) / start)
        return np.clip(logs / np.log(self.high / start), 0.0, 1.0)


def score_fractions(score: FloatArray) -> FloatArray:
    """Return place (A,) of each finite score, from the lowest (0) to the highest (1), or all 1."""
    low = float(score.min(initial=np.inf))
    high = float(score.max(initial=-np.inf))
    return (score - low) / (high - low) if high > low else np.ones(len(score))


def cost_colors(fraction: ArrayLike) -> ColorArray:
    """Return colours (..., 3) of places (...) on a scale of costs, bright for low ones."""
    place = np.clip(np.asarray(fraction, dtype=np.float64), 0.0, 1.0)
    return _between(_VIRIDIS, 1.0 - np.rint(place * _LEVELS) / _LEVELS)


def score_colors(fraction: ArrayLike) -> ColorArray:
    """Return colours (..., 3) of places (...) on a scale of scores, bright for high ones."""
    return _between(_EMBERS, np.clip(np.asarray(fraction, dtype=np.float64), 0.0, 1.0))


def _between(colors: FloatArray, fraction: FloatArray) -> ColorArray:
    """Return colours (..., 3) at places (...) in [0, 1] along a row of colours (N, 3)."""
    place = (len(colors) - 1) * fraction
    steps = np.arange(len(colors))
    channels = [np.interp(place, steps, colors[:, channel]) for channel in range(3)]
    return np.rint(np.stack(channels, axis=-1)).astype(np.uint8)


def number(value: float) -> str:
    """Return the label of a number: three digits, and no exponent where it would be longer."""
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e5 else f"{value:.3g}"
