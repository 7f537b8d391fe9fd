"""The coarse score of poses: mean contact distance, and depths of points inside in free space."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from chsel.cost.cost_settings import uncertain_depth
from chsel.methods.anchored.scoring_kernels import UNIT, Box32, Coarse
from chsel.methods.anchored.voxel_kernels import bounds_of_points, mark_voxels
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.subset import farthest_points

MOST_CONTACTS = 32  # that poses are scored by
MOST_INSIDE = 150
_DEEP = 0.3  # of the greatest depth: points inside are at least so deep
_MOST_NODES = 4000  # of which they are chosen
_WEIGHT, _BEYOND = 5.0, 20.0  # of their mean depths in free space, all and those beyond tolerance
_MOST_VOXELS = 20_000_000
_MOST_COST = 2**30  # of all points inside
_REACH = 0.06  # metres beyond which known points cost no more
_FARTHEST = 1e6  # metres: coordinates beyond are taken for it
_LONGEST = 32767  # UNITs: distances beyond are taken for it


def coarse_of(
    problem: RegistrationProblem,
    known: KnownPoints,
    middle: FloatArray,
    margin: float,
    tolerance: float = 0.0,
) -> Coarse:
    """The score of poses of a problem.

    Voxels of free space are coarse, so depths count little up to a tolerance, which is at least
    half of a voxel.
    known: the problem's points, see most_informative_first. middle (3,): of the world for the
    score. margin: metres by which the object's origin may be beside the workspace; free space
    beyond its reach is left out, and all of it if it needs too many voxels. tolerance: depth (m)
    that free points may have at no cost.
    """
    sdf, resolution = problem.sdf, problem.free_resolution
    tolerance = max(tolerance, uncertain_depth(sdf, 0.5 * resolution))
    values = sdf.derived("coarse values", lambda: _in_units(sdf.values).reshape(-1))
    inside, costs = sdf.derived(("inside", tolerance), lambda: _inside(sdf, tolerance))
    contacts = known.known[:MOST_CONTACTS]
    first, flags = _free_voxels(problem, margin + sdf.diameter)
    if flags.size == 1:
        inside, costs = inside[:0], costs[:0]
    costs = max(len(contacts), 1) / (max(len(costs), 1) * UNIT) * costs
    return Coarse(
        box=box_in_32_bits(sdf.origin, sdf.resolution, sdf.shape),
        values=values,
        contacts=in_32_bits(contacts - middle).T.copy(),
        known_sdf=in_32_bits(known.sdf[:MOST_CONTACTS] / UNIT),
        reach=np.float32(_REACH / UNIT),
        inside=in_32_bits(inside).T.copy(),
        weights=np.rint(np.minimum(costs, _MOST_COST / max(len(costs), 1))).astype(np.int32),
        voxels=box_in_32_bits(first - middle, resolution, flags.shape),
        flags=flags.reshape(-1),
    )


def _free_voxels(problem: RegistrationProblem, reach: float) -> tuple[FloatArray, Any]:
    """Centre (3,) of the first voxel, and flags (nx, ny, nz) of those with a free point in reach.

    With a layer of empty ones around; a single empty one if there are none, or too many.
    """
    free, side = problem.points.free, problem.free_resolution
    lower, upper = problem.workspace.bounds
    lower, upper, bounds = lower - reach, upper + reach, np.zeros((2, 3))
    if bounds_of_points(free, lower, upper, bounds):
        first, counts = bounds[0] - side, np.rint((bounds[1] - bounds[0]) / side) + 3.0
        if math.prod(counts.tolist()) < _MOST_VOXELS:
            flags = np.zeros(counts.astype(np.int64), dtype=np.uint8)
            mark_voxels(free, lower, upper, first, side, flags)
            return first, flags
    return np.zeros(3), np.zeros((1, 1, 1), dtype=np.uint8)


def in_32_bits(values: FloatArray) -> Any:
    """The numbers as kernels of 32 bits take them, none so large that sums would overflow."""
    return np.clip(values, -_FARTHEST, _FARTHEST).astype(np.float32)


def box_in_32_bits(first: FloatArray, resolution: float, shape: Sequence[int]) -> Box32:
    """The box of a grid of nodes (nx, ny, nz) whose first node is at `first` (3,)."""
    x, y, z = (np.float32(value) for value in in_32_bits(first))
    a, b, c = (np.float32(count - 1) for count in shape)
    inverse, (_, along, last) = np.float32(1.0 / resolution), shape
    return Box32((x, y, z), inverse, (a, b, c), np.int32(along * last), np.int32(last))


def _in_units(metres: FloatArray) -> Any:
    """Distances in UNITs, 16 bits."""
    return np.clip(np.rint(metres / UNIT), -_LONGEST, _LONGEST).astype(np.int16)


def _inside(sdf: SdfGrid, tolerance: float) -> tuple[FloatArray, FloatArray]:
    """Points (P, 3) inside of the object, the deepest first, and costs (P,) of them all, metres."""
    deep = np.argwhere(sdf.values <= _DEEP * min(float(sdf.values.min()), 0.0))
    if len(deep) > _MOST_NODES:
        deep = deep[np.arange(_MOST_NODES) * len(deep) // _MOST_NODES]
    nodes = deep[farthest_points(deep.astype(np.float64), MOST_INSIDE)]
    depths = -sdf.values[tuple(nodes.T)]
    order = np.argsort(-depths, kind="stable")
    nodes, depths = nodes[order], depths[order]
    costs = _WEIGHT * depths + _BEYOND * np.maximum(depths - tolerance, 0.0)
    return sdf.origin + nodes * sdf.resolution, costs
