"""What poses are scored by, roughly, of a problem."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from chsel.arrays import FloatArray
from chsel.far_apart import far_apart
from chsel.interior import VoxelGrid
from chsel.kernels.coarse_score import Coarse
from chsel.kernels.region import box_of
from chsel.points import KnownPoints
from chsel.problem import RegistrationProblem
from chsel.sdf import SdfGrid

MOST_CONTACTS = 32
MOST_INSIDE = 150
_DEEP = 0.3  # of the greatest depth: points inside are at least so deep
_MOST_NODES = 4000  # of which they are chosen
_WEIGHT = 90.0  # of the mean depth of the points inside that are in free space
_MOST_VOXELS = 20_000_000


def coarse_of(problem: RegistrationProblem, known: KnownPoints, margin: float) -> Coarse:
    """The score of poses: mean contact distance, and the depths of points inside in free space.

    known: the problem's points, in the order in which they tell most. margin: metres by which the
    object's origin may be beside the workspace; free space beyond its reach is left out, and all
    of it if it needs more voxels than memory should hold.
    """
    sdf, resolution = problem.sdf, problem.free_resolution
    values, inside, depth = sdf.derived("coarse", lambda: _values_and_depths(sdf))
    count = min(len(known.known), MOST_CONTACTS)
    free = _within_reach(problem, margin + sdf.diameter)
    box = voxels = box_of(sdf.origin, sdf.resolution, sdf.shape)
    flags = np.zeros(1, dtype=bool)
    if len(free) and math.prod((np.ptp(free, axis=0) / resolution + 3.0).tolist()) < _MOST_VOXELS:
        grid = VoxelGrid.around(free, resolution)
        voxels = box_of(grid.origin, resolution, grid.flags.shape)
        flags = grid.flags.reshape(-1)
    else:
        inside, depth = inside[:0], depth[:0]
    return Coarse(
        box,
        values,
        known.known[:count].T.copy(),
        known.sdf[:count].copy(),
        1.0 / max(count, 1),
        inside.T.copy(),
        depth * (_WEIGHT / max(len(depth), 1)),
        voxels,
        flags,
    )


def _within_reach(problem: RegistrationProblem, reach: float) -> FloatArray:
    """The free points that the object can meet."""
    free, (lower, upper) = problem.points.free, problem.workspace.bounds
    return free[((free >= lower - reach) & (free <= upper + reach)).all(axis=1)]


def _values_and_depths(sdf: SdfGrid) -> tuple[Any, FloatArray, FloatArray]:
    """All signed distances, and points (P, 3) inside of the object with their depths (P,)."""
    deep = np.argwhere(sdf.values <= _DEEP * min(float(sdf.values.min()), 0.0))
    if len(deep) > _MOST_NODES:
        deep = deep[np.arange(_MOST_NODES) * len(deep) // _MOST_NODES]
    nodes = deep[far_apart(deep.astype(np.float64), MOST_INSIDE)]
    depth = -sdf.values[tuple(nodes.T)]
    return sdf.values.astype(np.float32).reshape(-1), sdf.origin + nodes * sdf.resolution, depth
