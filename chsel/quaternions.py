"""Unit quaternions, as x y z w, and turns between two of them."""

from __future__ import annotations

import numpy as np

from chsel.arrays import FloatArray
from chsel.kernels.elementary import arctangents, sines_cosines

_SMALL = 1e-6  # radians, below which a straight line is as good as an arc


def quaternions(rotation: FloatArray) -> FloatArray:
    """Unit quaternions (N, 4) of rotations (N, 3, 3); their sign is arbitrary.

    Each row of the outer product of a quaternion with itself is a multiple of it, and all its
    entries follow from the rotation without a root; the row of the largest entry is the stablest.
    """
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(rotation, 0, -1)
    outer = np.array(
        [
            [1 + a - e - i, b + d, c + g, h - f],
            [b + d, 1 - a + e - i, f + h, c - g],
            [c + g, f + h, 1 - a - e + i, d - b],
            [h - f, c - g, d - b, 1 + a + e + i],
        ]
    )  # (4, 4, N)
    largest = np.argmax(np.diagonal(outer), axis=1)
    rows = np.moveaxis(outer, -1, 0)[np.arange(len(rotation)), largest]
    unit: FloatArray = rows / np.sqrt((rows**2).sum(axis=1, keepdims=True))
    return unit


def rotations(quaternion: FloatArray) -> FloatArray:
    """Rotations (N, 3, 3) of unit quaternions (N, 4)."""
    x, y, z, w = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def slerp(first: FloatArray, second: FloatArray, fraction: FloatArray) -> FloatArray:
    """Unit quaternions (N, 4) at fractions (N,) of the shorter arcs from one to the other (N, 4).

    q(t) = (sin((1 - t) a) p + sin(t a) q) / sin a, with the angle a between p and q or -q. The same
    bits on every machine.
    """
    t = np.asarray(fraction, dtype=np.float64)[:, None]
    second = np.where(_product(first, second) < 0.0, -second, second)
    apart, joint = second - first, second + first
    a = 2.0 * arctangents(np.sqrt(_product(apart, apart)), np.sqrt(_product(joint, joint)))
    arc = a > _SMALL
    before = np.where(arc, sines_cosines((1.0 - t) * a)[0], 1.0 - t)
    after = np.where(arc, sines_cosines(t * a)[0], t)
    between = before * first + after * second
    unit: FloatArray = between / np.sqrt(_product(between, between))
    return unit


def _product(left: FloatArray, right: FloatArray) -> FloatArray:
    """Inner products (N, 1) of vectors (N, 4), summed in a fixed order."""
    terms = left * right
    return ((terms[:, 0] + terms[:, 1]) + (terms[:, 2] + terms[:, 3]))[:, None]
