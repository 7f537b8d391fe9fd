"""Points that are far from each other."""

from __future__ import annotations

import numpy as np

from chsel.arrays import FloatArray, IntArray


def far_apart(points: FloatArray, most: int, *, given: int = 0) -> IntArray:
    """Which of points (N, d) to take so that every next one is the farthest from those before.

    given: so many of the first points come first, as they are.
    """
    chosen = np.zeros(min(most, len(points)), dtype=np.int64)
    squared = np.full(len(points), np.inf)
    for n in range(len(chosen)):
        chosen[n] = n if n < given else int(np.argmax(squared))
        difference = points - points[chosen[n]]
        squared = np.minimum(squared, (difference * difference).sum(axis=1))
        squared[chosen[n]] = -1.0
    return chosen
