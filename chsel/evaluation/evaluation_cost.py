"""The cost that defines the plausible set (CHSEL, Eq. 2), compiled and exactly culled."""

from __future__ import annotations

from typing import Any

import numpy as np

from chsel.arrays import FloatArray
from chsel.engine import poses_of
from chsel.evaluation.plausible_settings import EvaluationCostSettings
from chsel.far_apart import far_apart
from chsel.interior import VoxelGrid
from chsel.kernels.arithmetic import require_ieee_arithmetic
from chsel.kernels.field import field_of
from chsel.kernels.plausible import Evaluation, costs_below, room_for
from chsel.kernels.region import Box, Region, box_of, clearance_of
from chsel.kernels.tree import Tree, octree
from chsel.points import KnownPoints, Lattice
from chsel.problem import RegistrationProblem
from chsel.sdf import SdfGrid
from chsel.threads import spread

_POSES_PER_THREAD = 500
_MOST_INSIDE = 128  # points inside of the object that are asked whether they are in free space
_MOST_CANDIDATES = 20_000
_MOST_VOXELS = 20_000_000
_LEVEL_ROUNDING = 1e-12  # metres: what interpolation may lie below all of its corners


class EvaluationCost:
    """C(X) = c_max violated free + c_max violated occupied + |s - v| of known points.

    Sums over points, or the means over each class. A free point at x is violated if
    s(X x) <= -tolerance, an occupied one if s(X x) >= tolerance.
    """

    def __init__(self, problem: RegistrationProblem, settings: EvaluationCostSettings) -> None:
        require_ieee_arithmetic()
        self.settings = settings
        self.points = points = problem.points
        sdf, level = problem.sdf, -settings.tolerance
        tree = octree(points.free, problem.free_resolution)
        region = _region(sdf, level, settings.lookup)
        voxels, point_in = _voxels(tree, problem.free_resolution)
        occupied = points.occupied if settings.occupied else np.zeros((0, 3))
        self.model = Evaluation(
            field_of(sdf, settings.lookup, settings.outside),
            tree,
            region,
            occupied.T.copy(),
            points.known.T.copy(),
            points.sdf.copy(),
            level,
            settings.violation,
            _divisors(points, settings),
            sdf.derived(("inside", level), lambda: _inside(sdf, level)),
            voxels,
            point_in,
        )

    def evaluate(self, object_from_world: FloatArray, *, limit: float = np.inf) -> FloatArray:
        """Costs (B,) of transforms (B, 4, 4); infinite for those not below `limit`."""
        poses = poses_of(object_from_world)
        costs = np.empty(len(poses))

        def run(first: int, last: int, room: Any) -> None:
            costs_below(self.model, poses, limit, costs, first, last, room.found)

        def scratch() -> Any:
            return room_for(self.model, 0, 0, 0)

        spread(run, len(poses), scratch, least=_POSES_PER_THREAD)
        return costs


def _divisors(points: KnownPoints, settings: EvaluationCostSettings) -> tuple[float, float, float]:
    if settings.combine == "sums":
        return 1.0, 1.0, 1.0
    free, occupied, known = (
        float(max(len(part), 1)) for part in (points.free, points.occupied, points.known)
    )
    return free, occupied, known


def _region(sdf: SdfGrid, level: float, lookup: str) -> Region:
    """The cells that read any value of `level` or less."""

    def make() -> Region:
        box = box_of(sdf.origin, sdf.resolution, sdf.shape, between=lookup == "trilinear")
        active = sdf.active_cells(level + _LEVEL_ROUNDING, lookup).numpy().reshape(sdf.shape)
        return Region(box, clearance_of(active, sdf.resolution))

    return sdf.derived(("evaluation region", level, lookup), make)


def _inside(sdf: SdfGrid, level: float) -> FloatArray:
    """Points (3, I) inside of the object, far apart from each other."""
    nodes = np.argwhere(sdf.values <= level)
    nodes = nodes[:: max(1, len(nodes) // _MOST_CANDIDATES)]
    points = sdf.origin + nodes * sdf.resolution
    return points[far_apart(points, _MOST_INSIDE)].T.copy()


def _voxels(tree: Tree, resolution: float) -> tuple[Box, Any]:
    """A layer of empty voxels around those with free points, and a free point of each."""
    nodes = len(tree.starts) - 1
    free = tree.spheres[:3, nodes:].T
    nothing = box_of(np.zeros(3), 1.0, (1, 1, 1)), np.full(1, -1, dtype=np.int32)
    if len(free) == 0 or np.prod(np.ptp(free, axis=0) / resolution + 3.0) > _MOST_VOXELS:
        return nothing
    grid = VoxelGrid.around(free, resolution)
    point_in = np.full(grid.flags.shape, -1, dtype=np.int32)
    voxels = Lattice(tuple(grid.origin.tolist()), resolution).voxels(free)
    point_in[tuple(np.clip(voxels, 0, np.array(grid.flags.shape) - 1).T)] = np.arange(len(free))
    return box_of(grid.origin, resolution, grid.flags.shape), point_in.reshape(-1)
