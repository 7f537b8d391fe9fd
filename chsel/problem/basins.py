"""Basins and modes: groups of poses that put an object's surface at nearly one place.

A mode is a group of poses whose surfaces are alike. A basin is one whose rotations are alike, too:
a brick and the same brick turned by half are one mode of two basins.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.compiler import compiled
from chsel.problem.poses import Poses
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.subset import farthest_points, squared_distance, surface_descriptors

# Where these numbers are from: docs/anchored.md, "Numbers that are no settings".
MODE_DISTANCE = 0.01  # metres between surfaces of different modes, at least
_BASIN_ANGLE = 0.35  # radians between poses of different basins of one mode, at least


def basin_bests(
    sdf: SdfGrid, poses: Poses, *, most: int, distance: float = MODE_DISTANCE
) -> IntArray:
    """Return indices of the first pose of each basin, in their order, at most `most`.

    Each is farther than a distance (metres) from all chosen before it, or turned against them.
    """
    surfaces = surface_descriptors(sdf, poses)
    rotations = poses.rotations.reshape(-1, 9).copy()
    least_trace = 1.0 + 2.0 * np.cos(_BASIN_ANGLE)  # of the relative rotation
    chosen = np.empty(min(most, len(poses)), dtype=np.int64)
    count = choose_basins(surfaces, rotations, distance**2, least_trace, chosen)
    return chosen[:count]


@compiled
def choose_basins(surfaces: Any, rotations: Any, within: Any, least_trace: Any, chosen: Any) -> Any:
    """Fill `chosen` with the first pose of each basin; return how many they are.

    surfaces (N, D): descriptors, metres. rotations (N, 9). within: metres^2, of poses of a basin.
    """
    count = 0
    for n in range(len(surfaces)):
        if count == len(chosen):
            break
        is_new = True
        for m in range(count):
            other = chosen[m]
            trace = 0.0
            for i in range(9):
                trace += rotations[n, i] * rotations[other, i]
            if trace < least_trace:
                continue
            mean = squared_distance(surfaces[n], surfaces[other]) / surfaces.shape[1]
            if mean <= within:
                is_new = False
                break
        if is_new:
            chosen[count] = n
            count += 1
    return count


def has_new_mode(sdf: SdfGrid, old: Poses, *, new: Poses, count: int) -> bool:
    """Return whether a new pose is in a mode of its own.

    It is if it is farther from all old poses than `count` old ones, spread as far as possible, are
    from each other, and than MODE_DISTANCE.
    """
    if len(old) == 0 or len(new) == 0:
        return len(new) > 0
    surfaces = surface_descriptors(sdf, Poses.joined([old, new]))
    old_surfaces = surfaces[: len(old)]
    new_surfaces = surfaces[len(old) :]
    spread = farthest_points(old_surfaces, count)
    spacing = 0.0
    if len(spread) > 1:
        spacing = _farthest(old_surfaces[spread[:-1]], old_surfaces[spread[-1:]])
    return _farthest(old_surfaces, new_surfaces) > max(spacing, MODE_DISTANCE)


def _farthest(surfaces: FloatArray, others: FloatArray) -> float:
    """Return the largest distance (m) of others (M, D) from the nearest of surfaces (N, D)."""
    nearest = [((surfaces - other) ** 2).mean(axis=1).min() for other in others]
    return float(np.sqrt(max(nearest)))
