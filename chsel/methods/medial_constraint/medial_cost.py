"""The Medial Constraint cost: balls of free space must miss the object, contacts must touch it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from chsel.errors import SettingError, require_choice, require_positive
from chsel.methods.medial_constraint.medial_kernels import (
    MedialModel,
    covering,
    mark_medial,
    medial_costs_of_poses,
    medial_places,
    squared_clearances,
)
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.numerics.cell_set import Places
from chsel.numerics.threads import require_ieee_arithmetic, spread
from chsel.problem.points import Lattice, Workspace
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import LOOKUPS, OUTSIDE, SdfGrid
from chsel.problem.sdf_lookup import field_of
from chsel.problem.search_space import SearchSpace
from chsel.problem.settings import Presets

MOST_VOXELS = 30_000_000


@dataclass(frozen=True, eq=False)
class Balls:
    """Balls in the world: centres (N_b, 3) and radii (N_b,), metres."""

    centres: FloatArray
    radii: FloatArray

    def __len__(self) -> int:
        return len(self.radii)


def medial_balls(
    free: FloatArray, workspace: Workspace, resolution: float, inflation: float
) -> Balls:
    """Balls within the known-free voxels of a workspace that cover them but for `inflation`.

    Largest first. Each is the largest that touches no voxel that is not free, around a centre that
    no ball covers so far; of equals, the first in row-major order.

    free (N, 3): centres of free voxels of side `resolution`, metres, or any points, each of which
    makes the voxel free that it falls into. All else is not free, beyond the workspace, too.
    inflation: metres by which a ball may be inflated to cover another.
    Raises SettingError where the free points span too many voxels.
    """
    inside = _within(free, workspace, resolution)
    if len(inside) == 0:
        return Balls(np.zeros((0, 3)), np.zeros(0))
    lattice = Lattice(tuple(inside.min(axis=0).tolist()), resolution)
    squared = _clearances(_free_voxels(inside, lattice))
    medial = np.zeros(squared.shape, dtype=np.bool_)
    mark_medial(squared, medial)
    voxels = np.argwhere(medial)
    radii = np.sqrt(squared[medial].astype(np.float64))  # half sides
    largest_first = np.argsort(-squared[medial], kind="stable")
    chosen = covering(
        voxels, radii, _row_starts(medial), largest_first, 2.0 * inflation / resolution
    )
    return Balls(lattice.centres(voxels[chosen] - 1), radii[chosen] * (resolution / 2.0))


def _within(free: FloatArray, workspace: Workspace, resolution: float) -> FloatArray:
    """The points of free voxels whose centre is in the workspace, but for rounding."""
    margin = 1e-6 * resolution
    lower, upper = workspace.bounds
    return free[((free >= lower - margin) & (free <= upper + margin)).all(axis=1)]


def _free_voxels(points: FloatArray, lattice: Lattice) -> BoolArray:
    """Flags of the voxels that hold a point, with a layer of others around."""
    count = math.prod((np.ptp(points, axis=0) / lattice.spacing + 3.0).tolist())
    if not count <= MOST_VOXELS:
        raise SettingError(
            f"free points span {count:.1e} voxels of {lattice.spacing} m; "
            f"accepted: at most {MOST_VOXELS:.0e}, so a coarser free_resolution"
        )
    voxels = lattice.voxels(points)
    flags = np.zeros(voxels.max(axis=0) + 3, dtype=np.bool_)
    flags[tuple((voxels + 1).T)] = True
    return flags


def _clearances(free: BoolArray) -> IntArray:
    """Squared clearances of voxels in half sides; 0 where they are not free."""
    squared = np.empty(free.shape, dtype=np.int64)
    squared_clearances(free, squared)
    return squared


def _row_starts(medial: BoolArray) -> IntArray:
    """Where each row along the last axis starts among the voxels (nx, ny + 1), see `covering`."""
    in_row = np.count_nonzero(medial, axis=2)
    ends = np.cumsum(in_row).reshape(in_row.shape)
    return np.concatenate([ends[:, :1] - in_row[:, :1], ends], axis=1)


_POSES_PER_THREAD = 100  # fewer are costed faster than a thread wakes up
_NO_BALLS = Balls(np.zeros((0, 3)), np.zeros(0))


@dataclass(frozen=True)
class MedialCostSettings:
    """Settings of the Medial Constraint cost.

    inflation: metres by which a ball of free space may be inflated to stand for others.
    ball_scale, known_scale: weights of the two means; a ball_scale of 0 ignores free space, as
    the authors' released code does, whose balls never enter the cost. lookup, outside: how the
    SDF grid is read, see SdfGrid.query.
    """

    inflation: float = 0.02
    ball_scale: float = 1.0
    known_scale: float = 1.0
    lookup: str = "trilinear"
    outside: str = "surface_point"

    presets: ClassVar[Presets] = {
        "paper": {"lookup": "nearest"},
        "reference": {"ball_scale": 0.0, "lookup": "nearest", "outside": "bounding_box"},
    }

    def __post_init__(self) -> None:
        for name in ("inflation", "ball_scale", "known_scale"):
            require_positive(name, getattr(self, name), zero=True)
        require_choice("lookup", self.lookup, LOOKUPS)
        require_choice("outside", self.outside, OUTSIDE)


class MedialCost:
    """C_M(X) = mean_b max(0, r_b - s(R c_b + t))^2 + mean_k (s(R x_k + t) - v_k)^2, in m^2.

    Over the balls (c_b, r_b) of the free voxels in the workspace, and the points x_k of known
    signed distance v_k. Occupied points have no term. A mean over nothing is 0. balls: others than
    those of the problem's free points.
    """

    def __init__(
        self,
        problem: RegistrationProblem,
        settings: MedialCostSettings | None = None,
        *,
        balls: Balls | None = None,
    ) -> None:
        require_ieee_arithmetic()
        self.settings = settings = settings or MedialCostSettings()
        self.balls = _balls_of(problem, settings) if balls is None else balls
        self.model = MedialModel(
            field_of(problem.sdf, settings.lookup, settings.outside),
            _least_values(problem.sdf, settings.lookup),
            self.balls.centres.T.copy(),
            self.balls.radii,
            problem.points.known.T.copy(),
            problem.points.sdf.copy(),
            settings.ball_scale,
            settings.known_scale,
        )

    def evaluate(self, object_from_world: FloatArray) -> FloatArray:
        """Costs (B,) of transforms (B, 4, 4); infinite for one that is not finite."""
        return self.costs(Poses.of(object_from_world))

    def costs(self, poses: Poses) -> FloatArray:
        """Costs (B,) of poses."""
        costs = np.empty(len(poses))

        def run(first: int, last: int, work: Any) -> None:
            medial_costs_of_poses(self.model, poses.numbers, costs, first, last, work)

        spread(run, len(poses), lambda: medial_places(self.model), least=_POSES_PER_THREAD)
        return costs


def _balls_of(problem: RegistrationProblem, settings: MedialCostSettings) -> Balls:
    if settings.ball_scale == 0.0:
        return _NO_BALLS
    free, resolution = problem.points.free, problem.free_resolution
    return medial_balls(free, problem.workspace, resolution, settings.inflation)


def _least_values(sdf: SdfGrid, lookup: str) -> FloatArray:
    """The least value (nodes,) that is read in each cell of a grid, less a margin for rounding."""
    return sdf.derived(("least values", lookup), lambda: _least_values_of(sdf, lookup))


def _least_values_of(sdf: SdfGrid, lookup: str) -> FloatArray:
    least = sdf.values.copy()
    if lookup == "trilinear":  # a cell is named after the lowest of its eight nodes
        for axis in range(3):
            lower, upper = [slice(None)] * 3, [slice(None)] * 3
            lower[axis], upper[axis] = slice(None, -1), slice(1, None)
            least[tuple(lower)] = np.minimum(least[tuple(lower)], least[tuple(upper)])
    return (least - 1e-9 * (1.0 + np.abs(least))).reshape(-1)


class MedialObjective:
    """The Medial Constraint cost over the vectors of a search space."""

    def __init__(self, cost: MedialCost, space: SearchSpace) -> None:
        self._cost = cost
        self.space = space
        self.model = cost.model
        self.space_arrays = space.arrays

    def work(self) -> Places:
        """Scratch for one thread."""
        return medial_places(self.model)

    def costs(self, vectors: FloatArray) -> FloatArray:
        """Costs (B,) of vectors (B, d)."""
        return self._cost.costs(self.space.poses(vectors))
