"""The compiled relaxed cost that the methods evaluate: the same bits on every machine."""

from __future__ import annotations

from functools import partial

import numpy as np

from chsel.cost.cost_kernels import LANES, Model, costs_of_poses, work_of
from chsel.cost.cost_settings import CostSettings, InteriorPoints, interior_points, warn_if_too_deep
from chsel.cost.free_kernels import FreeTerm
from chsel.errors import require_choice
from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import bounds_of, box_of, cell_set_of, triple
from chsel.numerics.near_points import PointTree, point_tree
from chsel.numerics.pose_tuples import Triple
from chsel.numerics.threads import parallel_for, require_ieee_arithmetic
from chsel.problem.points import KnownPoints, VoxelGrid, require_parts
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.sdf_lookup import cells_below, distance_field

CULLINGS = ("octree", "none")
_NO_BOX = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
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
        *,
        settings: CostSettings | None = None,
        free_resolution: float = 0.01,
        culling: str = "octree",
    ) -> None:
        require_ieee_arithmetic()
        require_choice("culling", culling, accepted=CULLINGS)
        require_parts(sdf=sdf, points=points)
        settings = (settings or CostSettings()).of_object(sdf, free_resolution)
        self.settings = settings
        self.model = Model(
            field=distance_field(sdf, settings.lookup, outside=settings.outside),
            free=_free_term(
                sdf,
                points.free,
                settings=settings,
                free_resolution=free_resolution,
                culling=culling,
            ),
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
        """Return the cost that a problem's points define."""
        resolution = problem.free_resolution
        return cls(problem.sdf, problem.points, settings=settings, free_resolution=resolution)

    def at_level(self, sdf: SdfGrid, level: float) -> Model:
        """Return the model of direct free points with another penetration tolerance."""
        lookup = self.settings.lookup
        centre, radius = _sphere_around_cells(sdf, level, lookup=lookup)
        free = self.model.free._replace(
            cells=cells_below(sdf, level, lookup=lookup),
            centre=centre,
            radius=radius,
        )
        return self.model._replace(free=free, alpha=level)

    def evaluate(self, object_from_world: FloatArray) -> FloatArray:
        """Return costs (B,) of transforms (B, 4, 4); infinite for one that is not finite."""
        return self.costs(Poses.of(object_from_world))

    def costs(self, poses: Poses) -> FloatArray:
        """Return costs (B,) of poses."""
        costs = np.empty(len(poses))
        run = partial(costs_of_poses, self.model, poses.numbers, costs)
        work = partial(work_of, self.model)
        parallel_for(run, len(poses), scratch=work, least=_POSES_PER_THREAD, multiple=LANES)
        return costs


def _free_term(
    sdf: SdfGrid, free: FloatArray, *, settings: CostSettings, free_resolution: float, culling: str
) -> FreeTerm:
    is_interior = settings.free_term == "interior" and len(free) > 0
    if is_interior:

        def make() -> tuple[PointTree, InteriorPoints]:
            found = interior_points(sdf, settings)
            tree = point_tree(found.points, found.spacing)
            return tree, found.in_order(tree.order)

        tree, interior = sdf.derived(("interior", settings), make)
        weights = interior.weights(settings, free_resolution)[:, None]
        weights = np.concatenate([weights, -weights * interior.normals], axis=1).reshape(-1)
        voxels = VoxelGrid.around(free, free_resolution)
        box = box_of(voxels.origin, free_resolution, shape=voxels.flags.shape)
        cells = cell_set_of(box, voxels.flags)
        centre, radius = _sphere_around(interior.points, 0.0)
        lower, upper = box.first, box.last
    else:
        alpha = settings.alpha
        lookup = settings.lookup
        weights = np.zeros(0)
        tree = point_tree(free, free_resolution)
        cells = cells_below(sdf, alpha, lookup=lookup)
        centre, radius = _sphere_around_cells(sdf, alpha, lookup=lookup)
        warn_if_too_deep(sdf, free, alpha=alpha)
        lower, upper = (triple(corner) for corner in bounds_of(free)) if len(free) else _NO_BOX
    return FreeTerm(
        interior=is_interior,
        exhaustive=culling == "none",
        tree=tree,
        cells=cells,
        weights=weights,
        centre=centre,
        radius=radius,
        lower=lower,
        upper=upper,
    )


def _sphere_around_cells(sdf: SdfGrid, level: float, *, lookup: str) -> tuple[Triple, float]:
    """Return centre and radius of a sphere around the cells that read any value below `level`."""

    def make() -> tuple[Triple, float]:
        box = cells_below(sdf, level, lookup=lookup).box
        cells = np.argwhere(sdf.active_cells(level, lookup))
        if len(cells) == 0:
            return (0.0, 0.0, 0.0), 0.0
        centres = np.array(box.first) + (cells + 0.5 * box.between) / box.inverse
        return _sphere_around(centres, 0.5 / box.inverse)

    return sdf.derived(("sphere", level, lookup), make)


def _sphere_around(points: FloatArray, margin: float) -> tuple[Triple, float]:
    """Return centre and radius of a sphere around boxes of half-side `margin` at points (N, 3)."""
    lower = points.min(axis=0) - margin
    upper = points.max(axis=0) + margin
    half = (upper - lower) / 2.0
    radius = float(np.sqrt((half**2).sum())) * (1.0 + 1e-9) + 1e-9
    return triple((lower + upper) / 2.0), radius
