"""The noise of contacts, estimated from how far they are from a surface."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray

PRIOR_CONTACTS = 4.0  # that the sensor's noise counts for
PRIOR_OUTLIERS = 0.02  # the share of outliers in them
FOREIGN = 4.0  # noise levels beyond which a contact is an outlier
FREEDOMS = 6  # of a pose: it can make so many distances small whatever the noise
_MEDIAN = 1.4826  # standard deviations of normal numbers by the median of their sizes
_ROUNDS = 20


class Noise(NamedTuple):
    """What known points are off, where the object is."""

    sigma: float  # standard deviation of those that are on the object, metres
    outliers: float  # share of those that are not


def estimate_noise(distances: FloatArray, sensor_noise: float) -> Noise:
    """Noise and share of outliers from distances (N,), in metres, at the pose that fits best.

    Both at once: an outlier is a distance beyond FOREIGN sigma, and sigma is that of all others.
    The sensor's noise, metres, counts as that of PRIOR_CONTACTS further contacts (the mean of a
    scaled inverse chi-squared distribution), as a pose can be fitted to six distances whatever
    their noise. Sigma is no less than it, as errors that contacts share do not show. Sums are
    rounded once, so that the result does not depend on the machine.
    """
    sizes = np.sort(np.abs(np.asarray(distances, dtype=np.float64)))
    count = len(sizes)
    middle = 0.5 * (sizes[(count - 1) // 2] + sizes[count // 2]) if count else 0.0
    sigma, within = max(sensor_noise, _MEDIAN * float(middle)), -1
    for _ in range(_ROUNDS):
        before, within = within, int(np.searchsorted(sizes, FOREIGN * sigma, side="right"))
        if within == before:
            break
        squares = math.fsum((sizes[:within] ** 2).tolist())
        weight = PRIOR_CONTACTS + max(within - FREEDOMS, 0)
        sigma = math.sqrt((PRIOR_CONTACTS * sensor_noise**2 + squares) / weight)
    foreign = PRIOR_CONTACTS * PRIOR_OUTLIERS + count - max(within, 0)
    return Noise(max(sigma, sensor_noise), foreign / (PRIOR_CONTACTS + count))
