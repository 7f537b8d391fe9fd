"""The compiled relaxed cost that the methods evaluate: the same bits on every machine."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from chsel.cost.cost_kernels import Model, costs_of_poses, work_of
from chsel.cost.cost_settings import CostSettings
from chsel.cost.free_kernels import FreeTerm
from chsel.cost.interior_points import InteriorPoints, interior_points
from chsel.cost.pose_lanes import LANES
from chsel.errors import require_choice
from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import CellSet, Region, box_of, cell_set_of, triple
from chsel.numerics.clearance import squared_gaps
from chsel.numerics.octree import Tree, octree, rounding_margin
from chsel.numerics.pose_tuples import Triple
from chsel.numerics.rough_tree import rough_tree
from chsel.numerics.threads import require_ieee_arithmetic, spread
from chsel.numerics.voxels import bounds_of
from chsel.problem.points import KnownPoints, VoxelGrid, require_parts
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.sdf_lookup import cells_below, distance_field

CULLINGS = ("octree", "none")
_NO_BOX = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
_NOWHERE = np.zeros(0, dtype=np.float32)
_NO_DEPTHS = np.zeros(0, dtype=np.uint8)
_POSES_PER_THREAD = 200  # fewer are evaluated faster than a thread wakes up


class CompiledCost:
    """The relaxed cost (CHSEL, Eq. 7) of RelaxedCost, compiled and exactly culled.

    culling: how the free points that cost something are found, which changes no bit: "octree"
    walks a tree of them, "none" looks up all of them.
    Raises SettingError if the settings do not fit the object or the points, EngineError if this
    thread does not round as IEEE 754 specifies.
    """

    def __init__(
        self,
        sdf: SdfGrid,
        points: KnownPoints,
        settings: CostSettings | None = None,
        *,
        free_resolution: float = 0.01,
        culling: str = "octree",
    ) -> None:
        require_ieee_arithmetic()
        require_choice("culling", culling, CULLINGS)
        require_parts(sdf=sdf, points=points)
        settings = (settings or CostSettings()).of_object(sdf, free_resolution)
        self.settings = settings
        self.model = Model(
            field=distance_field(sdf, settings.lookup, settings.outside),
            free=_free_term(sdf, points.free, settings, free_resolution, culling),
            occupied=points.occupied.T.copy(),
            known=points.known.T.copy(),
            known_sdf=points.sdf.copy(),
            alpha=settings.alpha,
            free_scale=settings.free_scale,
            occupied_scale=settings.occupied_scale,
            known_scale=settings.known_scale,
            known_tolerance=settings.known_tolerance,
            exact_gradient=settings.gradient == "exact",
        )

    @classmethod
    def of(cls, problem: RegistrationProblem, settings: CostSettings | None = None) -> CompiledCost:
        """The cost that a problem's points define."""
        resolution = problem.free_resolution
        return cls(problem.sdf, problem.points, settings, free_resolution=resolution)

    def at_level(self, sdf: SdfGrid, level: float) -> Model:
        """The model of direct free points with another penetration tolerance."""
        lookup = self.settings.lookup
        centre, radius = _sphere_around_cells(sdf, level, lookup)
        free = self.model.free._replace(
            region=cells_below(sdf, level, lookup),
            cells=_cell_set_below(sdf, level, lookup),
            centre=centre,
            radius=radius,
        )
        return self.model._replace(free=free, alpha=level)

    def evaluate(self, object_from_world: FloatArray) -> FloatArray:
        """Costs (B,) of transforms (B, 4, 4); infinite for one that is not finite."""
        return self.costs(Poses.of(object_from_world))

    def costs(self, poses: Poses) -> FloatArray:
        """Costs (B,) of poses."""
        costs = np.empty(len(poses))

        def run(first: int, last: int, work: Any) -> None:
            costs_of_poses(self.model, poses.numbers, costs, first, last, work)

        spread(
            run, len(poses), lambda: work_of(self.model), least=_POSES_PER_THREAD, multiple=LANES
        )
        return costs


def _free_term(
    sdf: SdfGrid, free: FloatArray, settings: CostSettings, free_resolution: float, culling: str
) -> FreeTerm:
    is_interior = settings.free_term == "interior" and len(free) > 0
    if is_interior:
        tree, interior = sdf.derived(("interior", settings), lambda: _interior_tree(sdf, settings))
        weights = interior.weights(settings, free_resolution)[:, None]
        weights = np.concatenate([weights, -weights * interior.normals], axis=1).reshape(-1)
        voxels = VoxelGrid.around(free, free_resolution)
        box = box_of(voxels.origin, free_resolution, voxels.flags.shape)
        region, cells = Region(box, _NOWHERE), cell_set_of(box, voxels.flags)
        depths: Any = np.empty(voxels.flags.shape, dtype=np.uint8)
        squared_gaps(voxels.flags, depths)
        centre, radius = _sphere_around(interior.points, 0.0)
        lower, upper = box.first, box.last
    else:
        alpha, lookup, weights = settings.alpha, settings.lookup, np.zeros(0)
        tree, region = octree(free, free_resolution), cells_below(sdf, alpha, lookup)
        cells, depths = _cell_set_below(sdf, alpha, lookup), _NO_DEPTHS
        centre, radius = _sphere_around_cells(sdf, alpha, lookup)
        if len(free) and not (region.clearance < 0.0).any():
            warnings.warn(
                f"no node of the SDF is deeper than {-alpha} m: free points cannot be violated; "
                "use a smaller penetration_tolerance",
                stacklevel=4,
            )
        lower, upper = (triple(corner) for corner in bounds_of(free)) if len(free) else _NO_BOX
    return FreeTerm(
        interior=is_interior,
        exhaustive=culling == "none",
        tree=tree,
        rough=rough_tree(tree),
        region=region,
        cells=cells,
        depths=depths.reshape(-1),
        weights=weights,
        centre=centre,
        radius=radius,
        lower=lower,
        upper=upper,
        margin=_margin(tree, region),
    )


def _cell_set_below(sdf: SdfGrid, level: float, lookup: str) -> CellSet:
    """The cells of a grid that read any value below `level`, derived once."""

    def make() -> CellSet:
        region = cells_below(sdf, level, lookup)
        return cell_set_of(region.box, (region.clearance < 0.0).reshape(sdf.shape))

    return sdf.derived(("cell set below", level, lookup), make)


def _interior_tree(sdf: SdfGrid, settings: CostSettings) -> tuple[Tree, InteriorPoints]:
    """The interior points of the object as a tree, and in the order of the tree."""
    interior = interior_points(sdf, settings)
    tree = octree(interior.points, interior.spacing)
    return tree, interior.in_order(tree.order)


def _margin(tree: Tree, region: Region) -> float:
    """More metres than rounding moves a point of either frame."""
    uppermost = tree.spheres[:, : tree.levels[min(1, len(tree.levels) - 1)]]
    corners = np.array([region.box.first, region.box.last])
    return rounding_margin(np.concatenate([2.0 * uppermost.reshape(-1), corners.reshape(-1)]))


def _sphere_around_cells(sdf: SdfGrid, level: float, lookup: str) -> tuple[Triple, float]:
    """Centre and radius of a sphere around the cells that read any value below `level`."""

    def make() -> tuple[Triple, float]:
        region = cells_below(sdf, level, lookup)
        centres = cell_centres(region).T
        if len(centres) == 0:
            return (0.0, 0.0, 0.0), 0.0
        return _sphere_around(centres, 0.5 / region.box.inverse)

    return sdf.derived(("sphere", level, lookup), make)


def cell_centres(region: Region) -> FloatArray:
    """Centres (3, A) of the cells of a region, in the order of their indices."""
    box, cells = region.box, np.flatnonzero(region.clearance < 0.0)
    plane, k = np.divmod(cells, int(box.along))
    index = np.stack([*np.divmod(plane, int(box.across / box.along)), k])
    return np.array(box.first)[:, None] + (index + 0.5 * box.between) / box.inverse


def _sphere_around(points: FloatArray, margin: float) -> tuple[Triple, float]:
    """Centre and radius of a sphere around boxes of half-side `margin` at points (N, 3)."""
    lower, upper = points.min(axis=0) - margin, points.max(axis=0) + margin
    half = (upper - lower) / 2.0
    radius = float(np.sqrt((half**2).sum())) * (1.0 + 1e-9) + 1e-9
    return triple((lower + upper) / 2.0), radius
