"""The Medial Constraint cost: balls of free space must miss the object, contacts must touch it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from chsel.arrays import FloatArray
from chsel.engine import poses_of
from chsel.errors import require_choice, require_positive
from chsel.kernels.arithmetic import require_ieee_arithmetic
from chsel.kernels.field import field_of
from chsel.kernels.measures import all_measures
from chsel.kernels.medial import MedialModel, medial_costs_of_poses, medial_places
from chsel.kernels.pose import decode_all
from chsel.kernels.region import Places
from chsel.measures import Measure
from chsel.medial_balls import Balls, medial_balls
from chsel.problem import RegistrationProblem
from chsel.sdf import LOOKUPS, OUTSIDE, SdfGrid
from chsel.space import SearchSpace
from chsel.threads import spread

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
        return self.costs(poses_of(object_from_world))

    def costs(self, poses: FloatArray) -> FloatArray:
        """Costs (B,) of poses (B, 12): rotation row by row, then translation."""
        costs = np.empty(len(poses))

        def run(first: int, last: int, work: Any) -> None:
            medial_costs_of_poses(self.model, poses, costs, first, last, work)

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
    """The Medial Constraint cost and measures over the vectors of a search space."""

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
        poses = np.empty((len(vectors), 12))
        decode_all(self.space_arrays, vectors, poses)
        return self._cost.costs(poses)

    def measures(self, measure: Measure, vectors: FloatArray) -> FloatArray:
        """Measures (B, k) of vectors (B, d)."""
        values = np.empty((len(vectors), measure.count))
        all_measures(self.space_arrays, measure.code, vectors, values)
        return values
