"""Unit quaternions, as x y z w, of the rotations in logs."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from chsel.arrays import FloatArray
from chsel.pose import compose
from runners.sensors.unusable import UnusableMessage

_FURTHEST = 1e9  # metres: no robot works further from the origin of its frame
_NEARLY_EQUAL = 1.0 - 1e-9  # cosine from which a straight line is as good as an arc


def rigid(position: Sequence[float], quaternion: Sequence[float]) -> FloatArray:
    """The transform (4, 4) of a position (3,), metres, and a quaternion (4,) of any length.

    Plain numbers, as logs have hundreds of these a second. Raises UnusableMessage for a quaternion
    of length 0 and for numbers that are not finite.
    """
    x, y, z, w = quaternion
    largest = max(abs(x), abs(y), abs(z), abs(w))
    if not 0.0 < largest < math.inf or x != x or y != y or z != z or w != w:
        raise UnusableMessage(f"its quaternion is {_shown(quaternion)}")
    if not all(abs(value) < _FURTHEST for value in position):
        raise UnusableMessage(f"its position is {_shown(position)}")
    x, y, z, w = x / largest, y / largest, z / largest, w / largest
    s = 2.0 / (x * x + y * y + z * z + w * w)
    return np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w), position[0]],
            [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w), position[1]],
            [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y), position[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def unit_quaternion(rows: Sequence[Sequence[float]]) -> tuple[float, float, float, float]:
    """The quaternion of a rotation, rows of three numbers or more; the stablest of four ways."""
    (a, b, c), (d, e, f), (g, h, i) = (row[:3] for row in rows[:3])
    ways = (1 + a - e - i, 1 - a + e - i, 1 - a - e + i, 1 + a + e + i)
    way = ways.index(max(ways))
    outer = (
        (ways[0], b + d, c + g, h - f),
        (b + d, ways[1], f + h, c - g),
        (c + g, f + h, ways[2], d - b),
        (h - f, c - g, d - b, ways[3]),
    )[way]
    length = math.sqrt(sum(value * value for value in outer))
    x, y, z, w = outer
    return x / length, y / length, z / length, w / length


def slerp(first: FloatArray, second: FloatArray, fraction: FloatArray) -> FloatArray:
    """Quaternions (N, 4) at fractions (N,) of the shorter arcs from one to the other (N, 4)."""
    cosine = (first * second).sum(axis=1)
    second = np.where(cosine[:, None] < 0.0, -second, second)
    angle = np.arccos(np.minimum(np.abs(cosine), _NEARLY_EQUAL))
    sine = np.sin(angle)
    straight = np.abs(cosine) >= _NEARLY_EQUAL
    before = np.where(straight, 1.0 - fraction, np.sin((1.0 - fraction) * angle) / sine)
    after = np.where(straight, fraction, np.sin(fraction * angle) / sine)
    between = before[:, None] * first + after[:, None] * second
    unit: FloatArray = between / np.sqrt((between**2).sum(axis=1, keepdims=True))
    return unit


def transforms(positions: FloatArray, quaternions: FloatArray) -> FloatArray:
    """The transforms (N, 4, 4) of positions (N, 3) and unit quaternions (N, 4)."""
    x, y, z, w = quaternions.T
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return compose(np.moveaxis(rotation, 2, 0), positions)


def _shown(numbers: Sequence[float]) -> str:
    return ", ".join(f"{number:.3g}" for number in numbers)
