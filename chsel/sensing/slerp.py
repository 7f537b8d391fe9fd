"""Poses between poses: straight lines and the shortest turns, at constant speed."""

from __future__ import annotations

import numpy as np

from chsel.arrays import FloatArray
from chsel.pose import compose
from chsel.quaternions import quaternions, rotations, slerp


def interpolated(first: FloatArray, second: FloatArray, fraction: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) on the way from first to second (N, 4, 4), at fraction (N,) of it."""
    t = np.asarray(fraction, dtype=np.float64)[:, None]
    position = (1.0 - t) * first[:, :3, 3] + t * second[:, :3, 3]
    turned = slerp(quaternions(first[:, :3, :3]), quaternions(second[:, :3, :3]), fraction)
    return compose(rotations(turned), position)
