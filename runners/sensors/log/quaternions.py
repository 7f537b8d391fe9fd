"""Rotations in logs, as quaternions x y z w: one at a time, as logs have hundreds a second."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from chsel.numerics.arrays import FloatArray
from runners.sensors.log.messages import UnusableMessage

_FURTHEST = 1e9  # metres: no robot works further from the origin of its frame


def rigid(position: Sequence[float], quaternion: Sequence[float]) -> FloatArray:
    """The transform (4, 4) of a position (3,), metres, and a quaternion (4,) of any length.

    Raises UnusableMessage for a quaternion of length 0 and for numbers that are not finite.
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


def _shown(numbers: Sequence[float]) -> str:
    return ", ".join(f"{number:.3g}" for number in numbers)
