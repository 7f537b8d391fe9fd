"""A diverse choice: facility location by the greedy algorithm (Cornuejols et al., 1977)."""

from __future__ import annotations

import numpy as np

from chsel.kernels.compiler import compiled


@compiled
def locate_facilities(points, given, chosen, nearest, apart):  # type: ignore[no-untyped-def]
    """Choose points (C, d) so that all are near to a chosen one: by the mean square.

    Each choice takes off the most. The first `given` of chosen (B,) are there already. nearest
    (C,), apart (C, C): scratch. Returns how many are chosen before all others are like them.
    """
    count, dimension = points.shape
    for i in range(count):
        apart[i, i] = 0.0
        nearest[i] = np.inf
        for j in range(i):
            total = 0.0
            for d in range(dimension):
                total += (points[i, d] - points[j, d]) * (points[i, d] - points[j, d])
            apart[i, j] = apart[j, i] = total
    for n in range(len(chosen)):
        if n >= given:
            best, least = -1, np.inf
            for i in range(count):
                if nearest[i] == 0.0:
                    continue
                total = 0.0
                for j in range(count):
                    total += min(nearest[j], apart[i, j])
                if total < least:
                    best, least = i, total
            if best < 0:  # all are chosen, or alike
                return n
            chosen[n] = best
        for j in range(count):
            nearest[j] = min(nearest[j], apart[chosen[n], j])
    return len(chosen)
