"""The Medial Constraint cost: balls of free space must miss the object, contacts must touch it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, ClassVar

import numpy as np

from chsel.methods.medial_constraint.least_distances import least_distances
from chsel.methods.medial_constraint.medial_balls import Balls, medial_balls
from chsel.methods.medial_constraint.medial_kernels import (
    MedialModel,
    MedialScratch,
    medial_costs_of_poses,
    medial_scratch,
)
from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import triple
from chsel.numerics.threads import require_ieee_arithmetic, spread
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import LOOKUPS, OUTSIDE, SdfGrid
from chsel.problem.sdf_lookup import distance_field
from chsel.problem.search_space import SE3Space, SearchSpace
from chsel.problem.settings import CheckedSettings, Presets, not_negative, one_of

_POSES_PER_THREAD = 100  # fewer are costed faster than a thread wakes up


@dataclass(frozen=True)
class MedialCostSettings(CheckedSettings):
    """Settings of the Medial Constraint cost."""

    inflation: Annotated[float, not_negative] = 0.02  # of balls, to cover others, at most, metres
    # Weights of the two means; a ball_scale of 0 ignores free space, as the authors' released code
    # does, whose balls never enter the cost.
    ball_scale: Annotated[float, not_negative] = 1.0
    known_scale: Annotated[float, not_negative] = 1.0
    lookup: Annotated[str, one_of(*LOOKUPS)] = "trilinear"  # how the SDF is read, see SdfGrid.at
    outside: Annotated[str, one_of(*OUTSIDE)] = "surface_point"  # and beyond its box

    presets: ClassVar[Presets] = {
        "paper": {"lookup": "nearest"},
        "reference": {"ball_scale": 0.0, "lookup": "nearest", "outside": "bounding_box"},
    }


class MedialCost:
    """C_M(X) = mean_b max(0, r_b - s(R c_b + t))^2 + mean_k (s(R x_k + t) - v_k)^2, in m^2.

    Over the balls (c_b, r_b) of the free voxels in the workspace, and the points x_k of known
    signed distance v_k. Occupied points have no term. A mean over nothing is 0. space: of the
    vectors whose costs are asked for. balls: others than those of the problem's free points.
    """

    def __init__(
        self,
        problem: RegistrationProblem,
        settings: MedialCostSettings | None = None,
        *,
        space: SearchSpace | None = None,
        balls: Balls | None = None,
    ) -> None:
        require_ieee_arithmetic()
        settings = settings or MedialCostSettings()
        self.space = space or SE3Space()
        self.space_arrays = self.space.arrays
        self.balls = _balls_of(problem, settings) if balls is None else balls
        self.model = _model(problem, self.balls, settings)

    def costs(self, vectors: FloatArray) -> FloatArray:
        """Costs (B,) of vectors (B, d) of the search space."""
        return self.evaluate(self.space.poses(vectors))

    def evaluate(self, poses: Poses) -> FloatArray:
        """Costs (B,) of poses; infinite for one that is not finite."""
        costs = np.empty(len(poses))
        run = partial(medial_costs_of_poses, self.model, poses.numbers, costs)
        spread(run, len(poses), self.work, least=_POSES_PER_THREAD)
        return costs

    def work(self) -> MedialScratch:
        """Scratch for one thread."""
        return medial_scratch(self.model)


def _model(problem: RegistrationProblem, balls: Balls, settings: MedialCostSettings) -> MedialModel:
    sdf, centres, radii = problem.sdf, balls.centres.T, balls.radii
    middle = np.zeros(3)
    if len(balls):
        middle = (centres.min(axis=1) + centres.max(axis=1)) / 2.0
    from_middle = np.empty((4, len(radii)), dtype=np.float32)
    from_middle[:3], from_middle[3] = centres - middle[:, None], radii
    from_middle[3] = np.nextafter(from_middle[3], np.float32(np.inf))
    return MedialModel(
        field=distance_field(sdf, settings.lookup, settings.outside),
        values=sdf.values.reshape(-1),
        least=_least_values(sdf, settings.lookup),
        bounds=least_distances(sdf, settings.outside, float(radii.max(initial=0.0))),
        centres=centres.copy(),
        radii=radii,
        middle=triple(middle),
        span=float(np.abs(from_middle[:3]).max(initial=0.0)),
        balls=from_middle,
        known=problem.points.known.T.copy(),
        known_sdf=problem.points.sdf.copy(),
        ball_scale=settings.ball_scale,
        known_scale=settings.known_scale,
    )


def _balls_of(problem: RegistrationProblem, settings: MedialCostSettings) -> Balls:
    if settings.ball_scale == 0.0:
        return Balls(np.zeros((0, 3)), np.zeros(0))
    free, resolution = problem.points.free, problem.free_resolution
    return medial_balls(free, problem.workspace, resolution, settings.inflation)


def _least_values(sdf: SdfGrid, lookup: str) -> FloatArray:
    """The least value (nodes,) that is read in each cell of a grid, less a margin for rounding."""

    def least_values() -> FloatArray:
        least = sdf.values.copy()
        if lookup == "trilinear":  # a cell is named after the lowest of its eight nodes
            for axis in range(3):
                nodes = np.moveaxis(least, axis, 0)
                nodes[:-1] = np.minimum(nodes[:-1], nodes[1:])
        return (least - 1e-9 * (1.0 + np.abs(least))).reshape(-1)

    return sdf.derived(("least values", lookup), least_values)
