"""The evaluation cost, which defines the plausible set and is exact (CHSEL, Eq. 2)."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import (
    Box,
    CellSet,
    Places,
    box_of,
    locate,
    nearest_node,
    places_for,
    voxels_of,
)
from chsel.numerics.compiler import compiled, inner, leaf, spliced
from chsel.numerics.near_points import (
    NearPoints,
    PointTree,
    gather,
    near_points_for,
    point_tree,
    select,
    to_cells,
)
from chsel.numerics.pose_tuples import finite, pose_at, rigid, turned_back
from chsel.numerics.threads import parallel_for, require_ieee_arithmetic
from chsel.plausible.plausible_settings import EvaluationCostSettings
from chsel.problem.points import voxels_spanned
from chsel.problem.poses import Poses, inverse
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.sdf_lookup import (
    DistanceField,
    cells_below,
    distance_field,
    distance_in_box,
    distance_in_place,
)
from chsel.problem.subset import farthest_points

_POSES_PER_THREAD = 500
_MOST_DISTINCT = 32  # violated free points that are counted one by one at first
_MOST_INSIDE = 128  # points inside of the object that are looked up among free voxels
_MOST_CANDIDATES = 20_000
_MOST_VOXELS = 20_000_000
_LEVEL_ROUNDING = 1e-12  # metres: what interpolation may lie below all of its corners
Pose = tuple[float, ...]


class Divisors(NamedTuple):
    """Divisors of the sums over each class of points."""

    free: float  # of the count of free points
    occupied: float  # of the count of occupied points
    known: float  # of the sum over known points


class EvaluationModel(NamedTuple):
    """Data of the evaluation cost, but the pose."""

    field: DistanceField  # of the object
    tree: PointTree  # of the free points
    cells: CellSet  # of the object in which a free point can violate
    occupied: FloatArray  # (3, K), world
    known: FloatArray  # (3, M), world
    known_sdf: FloatArray  # (M,), m
    level: float  # free points violate at s <= level, occupied ones at s >= -level
    violation: float  # c_max
    divisors: Divisors  # of the three sums
    inside: FloatArray  # (3, I) points in the object, by which most violations are found early
    voxels: Box  # around the free points
    point_in: Any  # (voxels,) number of a free point in each, -1 for none; int32


class EvaluationCost:
    """C(X) = c_max violated free + c_max violated occupied + |s - v| of known points.

    Sums over points, or the means over each class. A free point at x is violated if
    s(X x) <= -tolerance, an occupied one if s(X x) >= tolerance.
    """

    def __init__(self, problem: RegistrationProblem, settings: EvaluationCostSettings) -> None:
        require_ieee_arithmetic()
        self.problem, self.settings = problem, settings
        points = problem.points
        sdf = problem.sdf
        level = -settings.tolerance
        counts = len(points.free), len(points.occupied), len(points.known)
        divided = settings.combine == "means"
        tree = point_tree(points.free, problem.free_resolution)
        voxels, point_in = _voxels(tree, problem.free_resolution)
        occupied = points.occupied if settings.occupied else np.zeros((0, 3))
        self.model = EvaluationModel(
            field=distance_field(sdf, settings.lookup, outside=settings.outside),
            tree=tree,
            cells=cells_below(sdf, level + _LEVEL_ROUNDING, lookup=settings.lookup),
            occupied=occupied.T.copy(),
            known=points.known.T.copy(),
            known_sdf=points.sdf.copy(),
            level=level,
            violation=settings.violation,
            divisors=Divisors(*(float(max(n, 1)) if divided else 1.0 for n in counts)),
            inside=sdf.derived(("inside", level), lambda: _inside(sdf, level)),
            voxels=voxels,
            point_in=point_in,
        )

    def evaluate(self, object_from_world: FloatArray, *, limit: float = np.inf) -> FloatArray:
        """Return costs (B,) of transforms (B, 4, 4); infinite for those not below `limit`."""
        poses = Poses.of(object_from_world)
        costs = np.empty(len(poses))
        run = partial(costs_below, self.model, poses.numbers, limit, costs)
        parallel_for(
            run, len(poses), scratch=partial(scratch_for, self.model), least=_POSES_PER_THREAD
        )
        return costs

    def at(self, world_from_object: FloatArray) -> float:
        """Return the cost of one pose (4, 4)."""
        return float(self.evaluate(inverse(world_from_object)[None])[0])


def _inside(sdf: SdfGrid, level: float) -> FloatArray:
    """Return points (3, I) inside of the object, far apart from each other."""
    nodes = np.argwhere(sdf.values <= level)
    nodes = nodes[:: max(1, len(nodes) // _MOST_CANDIDATES)]
    points = sdf.origin + nodes * sdf.resolution
    return points[farthest_points(points, _MOST_INSIDE)].T.copy()


def _voxels(tree: PointTree, resolution: float) -> tuple[Box, Any]:
    """Return the voxels of free points with an empty layer around, and a free point of each."""
    free = tree.points.T
    if len(free) == 0 or voxels_spanned(free, resolution) > _MOST_VOXELS:
        return box_of(np.zeros(3), 1.0, shape=(1, 1, 1)), np.full(1, -1, dtype=np.int32)
    first = free.min(axis=0) - resolution
    voxels = voxels_of(free, first, side=resolution)
    point_in = np.full(voxels.max(axis=0) + 2, -1, dtype=np.int32)
    point_in[tuple(voxels.T)] = np.arange(len(free))
    return box_of(first, resolution, shape=point_in.shape), point_in.reshape(-1)


class EvaluationScratch(NamedTuple):
    """Scratch of one thread: free points that are looked up, and places of points."""

    near: NearPoints  # free points that are looked up
    x: FloatArray  # (S,) metres, world
    y: FloatArray  # (S,)
    z: FloatArray  # (S,)
    places: Places  # of these points


def scratch_for(model: EvaluationModel) -> EvaluationScratch:
    """Return EvaluationScratch for one thread."""
    points = model.tree.points, model.occupied, model.known
    size = max(_MOST_DISTINCT, *(array.shape[1] for array in points))
    near = near_points_for(model.tree, 1)
    (x, y, z) = np.empty((3, size))
    return EvaluationScratch(near, x, y=y, z=z, places=places_for(size))


@compiled
def costs_below(model, poses, limit, out, first, last, scratch):
    """Fill out (B,) with the costs below a limit, else inf, of poses (B, 12) from first to last."""
    for n in range(first, last):
        out[n] = cost_below(model, pose_at(poses, n), limit, scratch)


@inner
def cost_below(model, pose, limit, scratch):
    """Return the evaluation cost of a pose; infinite if it is not below the limit."""
    if not finite(pose):
        return np.inf
    total = _known_sum(model, pose, scratch)
    if not _cost(model, 0, 0, total) < limit:
        return np.inf
    occupied = _occupied_count(model, pose, scratch)
    if not _cost(model, 0, occupied, total) < limit:
        return np.inf
    if rigid(pose) and not _may_be_below(model, pose, occupied, total, limit, scratch):
        return np.inf
    cost = _cost(model, _free_count(model, pose, scratch), occupied, total)
    return cost if cost < limit else np.inf


@leaf
def _cost(model: EvaluationModel, free: int, occupied: int, total: float) -> float:
    cost = model.violation * (free / model.divisors.free)
    cost += model.violation * (occupied / model.divisors.occupied)
    return cost + total / model.divisors.known


@spliced
def _known_sum(model: EvaluationModel, pose: Pose, scratch: EvaluationScratch) -> float:
    """Return sum |s - v| over the points of known signed distance, in their order."""
    xs = model.known[0]
    ys = model.known[1]
    zs = model.known[2]
    total = 0.0
    locate(pose, model.field.box, xs, ys, zs, scratch.places, len(xs))
    for n in range(len(xs)):
        s = distance_in_place(model.field, pose, xs[n], ys[n], zs[n], scratch.places, n)[0]
        total += abs(s - model.known_sdf[n])
    return total


@spliced
def _occupied_count(model: EvaluationModel, pose: Pose, scratch: EvaluationScratch) -> int:
    xs = model.occupied[0]
    ys = model.occupied[1]
    zs = model.occupied[2]
    count = 0
    locate(pose, model.field.box, xs, ys, zs, scratch.places, len(xs))
    for n in range(len(xs)):
        s = distance_in_place(model.field, pose, xs[n], ys[n], zs[n], scratch.places, n)[0]
        count += 1 if s >= -model.level else 0
    return count


@spliced
def _may_be_below(model, pose, occupied, total, limit, scratch):
    """Return False if the free points near some points inside of the object violate too often."""
    voxels = model.voxels
    inside = model.inside
    points = model.tree.points
    hits = 0
    for n in range(inside.shape[1]):
        x, y, z = inside[0, n] - pose[9], inside[1, n] - pose[10], inside[2, n] - pose[11]
        x, y, z = turned_back(pose, x, y, z)
        i, j, k = nearest_node(voxels.first, voxels.inverse, x, y, z)
        i = min(max(i, 0.0), voxels.most[0])
        j = min(max(j, 0.0), voxels.most[1])
        k = min(max(k, 0.0), voxels.most[2])
        point = model.point_in[int(i * voxels.across + j * voxels.along + k)]
        if point >= 0 and hits < _MOST_DISTINCT and _is_new(scratch.near.hits, hits, point):
            scratch.x[0], scratch.y[0] = points[0, point], points[1, point]
            scratch.z[0] = points[2, point]
            locate(pose, model.cells.box, scratch.x, scratch.y, scratch.z, scratch.places, 1)
            if _violates(model, scratch.places, 0):
                scratch.near.hits[hits] = point
                hits += 1
                if not _cost(model, hits, occupied, total) < limit:
                    return False
    return True


@leaf
def _is_new(hits: Any, count: int, point: int) -> bool:
    new = True
    for n in range(count):
        new &= hits[n] != point
    return new


@leaf
def _violates(model: EvaluationModel, places: Places, n: int) -> bool:
    """Return whether a free point at the n-th of the places is inside; none beyond the grid is."""
    if model.cells.steps[places.cell[n]] > 0 or places.beyond[n] > 0.0:
        return False
    return distance_in_box(model.field, places, n)[0] <= model.level


@spliced
def _free_count(model: EvaluationModel, pose: Pose, scratch: EvaluationScratch) -> int:
    tree = model.tree
    cells = model.cells
    near = scratch.near
    points = model.tree.points
    to_cell, rounding = to_cells(tree, cells.box, pose)
    if rounding >= 0.0 and rigid(pose):
        gather(tree, cells, to_cell, rounding, near, 0)
        count = select(tree, cells, to_cell, rounding, near, 0)
    else:
        count = points.shape[1]
        for n in range(count):
            near.hits[n] = n
    for n in range(count):
        at = near.hits[n]
        scratch.x[n] = points[0, at]
        scratch.y[n] = points[1, at]
        scratch.z[n] = points[2, at]
    locate(pose, cells.box, scratch.x, scratch.y, scratch.z, scratch.places, count)
    violations = 0
    for n in range(count):
        violations += 1 if _violates(model, scratch.places, n) else 0
    return violations
