"""A diverse choice: facility location by the greedy algorithm (Cornuejols et al., 1977)."""

from __future__ import annotations

import numpy as np

from chsel.kernels.compiler import compiled
from chsel.kernels.energy import distance_at
from chsel.kernels.pose import pose_at


@compiled
def distances_from_surface(field, poses, places, out, first, last):  # type: ignore[no-untyped-def]
    """Fill out (B, K) with the distances of world points (K, 3) in poses (B, 12), first to last."""
    for b in range(first, last):
        pose = pose_at(poses, b)
        for k in range(len(places)):
            out[b, k] = distance_at(field, pose, places[k, 0], places[k, 1], places[k, 2])


@compiled
def locate_facilities(points, chosen, nearest, apart):  # type: ignore[no-untyped-def]
    """Choose points (d, C) so that all are near to a chosen one: by the mean square.

    The first, then what takes off the most. nearest (C,), apart (C, C): scratch. Returns how many
    of chosen (B,) there are before all others are like them.
    """
    dimension, count = points.shape
    apart[:] = 0.0
    for i in range(count):
        nearest[i] = np.inf
        row = apart[i]
        for d in range(dimension):
            of_all, own = points[d], points[d, i]
            for j in range(count):
                row[j] += (own - of_all[j]) * (own - of_all[j])
    for n in range(len(chosen)):
        if n > 0:
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
