"""The compiled relaxed cost: what the methods evaluate, to the bit the same on every machine."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from chsel.cost.cost_kernels import FreeTerm, Model
from chsel.cost.cost_settings import CostSettings
from chsel.cost.interior_points import InteriorPoints, VoxelGrid, interior_points, interior_spacing
from chsel.cost.objective_kernels import costs_of_poses, work_for
from chsel.errors import SettingError, require_choice
from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import Region, box_of, clearance_of, triple
from chsel.numerics.lattice import MOST_CELLS, NO_LATTICE, cell_centres, lattice_of
from chsel.numerics.octree import Tree, octree, rounding_margin
from chsel.numerics.threads import require_ieee_arithmetic, spread
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.sdf_lookup import distance_field

_POSES_PER_THREAD = 200  # fewer are costed faster than a thread wakes up
WAYS = ("fastest", "direct", "tree", "lattice")


class CompiledCost:
    """The relaxed cost (CHSEL, Eq. 7) of RelaxedCost, compiled and exactly culled.

    way: how free points are found that cost something, which changes no bit: "direct" asks all of
    them, "tree" an octree, "lattice" every cell of the object for its lattice point.
    Raises SettingError where the settings do not fit the object or the points, EngineError
    where this thread rounds numbers in another way than IEEE 754 says.
    """

    def __init__(
        self,
        sdf: SdfGrid,
        points: KnownPoints,
        settings: CostSettings | None = None,
        *,
        free_resolution: float = 0.01,
        way: str = "fastest",
    ) -> None:
        require_ieee_arithmetic()
        require_choice("way", way, WAYS)
        self.settings = settings = settings or CostSettings()
        self.model = Model(
            distance_field(sdf, settings.lookup, settings.outside),
            _free_term(sdf, points.free, settings, free_resolution, way),
            points.occupied.T.copy(),
            points.known.T.copy(),
            points.sdf.copy(),
            settings.penetration_tolerance,
            settings.free_scale,
            settings.occupied_scale,
            settings.known_scale,
            settings.known_tolerance,
            settings.gradient == "exact",
        )

    @classmethod
    def of(cls, problem: RegistrationProblem, settings: CostSettings | None = None) -> CompiledCost:
        """The cost that a problem's points define."""
        resolution = problem.free_resolution
        return cls(problem.sdf, problem.points, settings, free_resolution=resolution)

    def at_level(self, sdf: SdfGrid, level: float) -> Model:
        """The model with another penetration tolerance, of direct free points without a lattice."""
        lookup = self.settings.lookup
        region = sdf.derived(("region", level, lookup), lambda: _region_below(sdf, level, lookup))
        centre, radius = sdf.derived(("sphere", level, lookup), lambda: _sphere_of(region))
        free = self.model.free._replace(
            region=region, centre=centre, radius=radius, lattice=NO_LATTICE
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

        spread(run, len(poses), lambda: work_for(self.model), least=_POSES_PER_THREAD)
        return costs


def _free_term(
    sdf: SdfGrid, free: FloatArray, settings: CostSettings, free_resolution: float, way: str
) -> FreeTerm:
    if settings.free_term == "interior" and way == "lattice":
        raise SettingError(
            "way is lattice, which free_term interior has none of; accepted: fastest, tree, direct"
        )
    if settings.free_term == "interior" and len(free):
        return _interior_term(sdf, free, settings, free_resolution, way)
    alpha, lookup = settings.penetration_tolerance, settings.lookup
    region = sdf.derived(("region", alpha, lookup), lambda: _region_below(sdf, alpha, lookup))
    active = int((region.clearance < 0.0).sum())
    if len(free) and active == 0:
        warnings.warn(
            f"no node of the SDF is deeper than {-alpha} m: free points cannot be violated; use "
            "a smaller penetration_tolerance",
            stacklevel=4,
        )
    centre, radius = sdf.derived(("sphere", alpha, lookup), lambda: _sphere_of(region))
    tree = octree(free, free_resolution)
    none = np.zeros(0), np.zeros((0, 3))
    lattice = None
    if way == "lattice" or (way == "fastest" and active <= MOST_CELLS):
        lattice = lattice_of(tree, free_resolution, region)
    if lattice is None and way == "lattice":
        raise SettingError(
            "way is lattice, but free points are no lattice coarser than the diagonal of an SDF "
            "cell; accepted: fastest, tree, direct"
        )
    reach = np.inf if way == "direct" else 0.0, _margin(tree, region)
    return FreeTerm(False, tree, region, *none, centre, radius, *reach, lattice or NO_LATTICE)


def _margin(tree: Tree, region: Region) -> float:
    """More metres than rounding moves a point of either frame."""
    uppermost = tree.spheres[:, : tree.levels[min(1, len(tree.levels) - 1)]]
    corners = np.array([region.box.first, region.box.last])
    return rounding_margin(np.concatenate([2.0 * uppermost.reshape(-1), corners.reshape(-1)]))


def _region_below(sdf: SdfGrid, level: float, lookup: str) -> Region:
    """The cells of a grid that read any value below `level`."""
    box = box_of(sdf.origin, sdf.resolution, sdf.shape, between=lookup == "trilinear")
    active = sdf.active_cells(level, lookup).numpy().reshape(sdf.shape)
    return Region(box, clearance_of(active, sdf.resolution))


def _sphere_of(region: Region) -> tuple[tuple[float, float, float], float]:
    """Centre and radius of a sphere that holds the region."""
    centres = cell_centres(region)
    if centres.shape[1] == 0:
        return (0.0, 0.0, 0.0), 0.0
    margin = 0.5 / region.box.inverse
    return _sphere(centres.T, margin)


def _sphere(points: FloatArray, margin: float) -> tuple[tuple[float, float, float], float]:
    """Centre and radius of a sphere around points (N, 3), with boxes of half-side `margin`."""
    lower, upper = points.min(axis=0) - margin, points.max(axis=0) + margin
    half = (upper - lower) / 2.0
    radius = float(np.sqrt((half**2).sum())) * (1.0 + 1e-9) + 1e-9
    return triple((lower + upper) / 2.0), radius


def _interior_term(
    sdf: SdfGrid, free: FloatArray, settings: CostSettings, free_resolution: float, way: str
) -> FreeTerm:
    spacing = interior_spacing(sdf, settings)
    tree, interior = sdf.derived(("interior", settings), lambda: _interior_tree(sdf, settings))
    scale = settings.free_scale
    if settings.volume_normalise:
        scale *= (spacing / free_resolution) ** 3
    voxels = VoxelGrid.around(free, free_resolution)
    box = box_of(voxels.origin, free_resolution, voxels.flags.shape)
    region = Region(box, clearance_of(voxels.flags, free_resolution))
    centre, radius = _sphere(interior.points, 0.0)
    weights = scale * interior.depth
    reach = np.inf if way == "direct" else 0.0, _margin(tree, region)
    normals = interior.normals
    return FreeTerm(True, tree, region, weights, normals, centre, radius, *reach, NO_LATTICE)


def _interior_tree(sdf: SdfGrid, settings: CostSettings) -> tuple[Tree, InteriorPoints]:
    """The points inside of the object as a tree, and in the order of the tree."""
    interior = interior_points(sdf, settings)
    tree = octree(interior.points, interior_spacing(sdf, settings))
    return tree, interior.in_order(tree.order)
