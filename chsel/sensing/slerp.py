"""Poses between poses: straight lines and the shortest turns, at constant speed."""

from __future__ import annotations

import numpy as np

from chsel.arrays import FloatArray
from chsel.kernels.elementary import arctangents, sines_cosines
from chsel.pose import compose


def interpolated(first: FloatArray, second: FloatArray, fraction: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) on the way from first to second (N, 4, 4), at fraction (N,) of it.

    Positions are linear, rotations are q(t) = (sin((1 - t) a) p + sin(t a) q) / sin a of unit
    quaternions p and q with the angle a between them, the nearer of q and -q.
    """
    t = np.asarray(fraction, dtype=np.float64)[:, None]
    position = (1.0 - t) * first[:, :3, 3] + t * second[:, :3, 3]
    p, q = quaternions(first[:, :3, :3]), quaternions(second[:, :3, :3])
    q = np.where(_product(p, q) < 0.0, -q, q)
    apart, joint = q - p, q + p
    a = 2.0 * arctangents(np.sqrt(_product(apart, apart)), np.sqrt(_product(joint, joint)))
    sine = np.where(a > 1e-6, sines_cosines(a)[0], 1.0)
    early = np.where(a > 1e-6, sines_cosines((1.0 - t) * a)[0], 1.0 - t)
    late = np.where(a > 1e-6, sines_cosines(t * a)[0], t)
    return compose(rotations((early * p + late * q) / sine), position)


def quaternions(rotation: FloatArray) -> FloatArray:
    """Unit quaternions w, x, y, z (N, 4) of rotations (N, 3, 3); their sign is arbitrary.

    The rows of 4 q q^T are all multiples of q; the longest is taken.
    """
    r = np.moveaxis(rotation, 0, -1)
    w, x, y, z = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], 1.0 + 0.0 * r[0, 0]
    xy, xz, yz = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    a, b, c = r[0, 0], r[1, 1], r[2, 2]
    rows = np.array(
        [
            [z + a + b + c, w, x, y],
            [w, z + a - b - c, xy, xz],
            [x, xy, z - a + b - c, yz],
            [y, xz, yz, z - a - b + c],
        ]
    )  # (4, 4, N)
    longest = np.argmax(np.stack([rows[n, n] for n in range(4)]), axis=0)
    chosen = rows[longest, :, np.arange(len(longest))]
    return chosen / np.sqrt(_product(chosen, chosen))


def rotations(quaternion: FloatArray) -> FloatArray:
    """Rotations (N, 3, 3) of quaternions w, x, y, z (N, 4) of any length above 0."""
    w, x, y, z = (quaternion / np.sqrt(_product(quaternion, quaternion))).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def _product(left: FloatArray, right: FloatArray) -> FloatArray:
    """Inner products (N, 1) of vectors (N, 4)."""
    return (left * right).sum(axis=1, keepdims=True)
