"""The Medial Constraint cost: balls of free space must miss the object, contacts must touch it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar

import numpy as np

from chsel.methods.medial_constraint.least_distances import LeastDistances, least_distances
from chsel.methods.medial_constraint.medial_balls import Balls, medial_balls
from chsel.methods.medial_constraint.medial_kernels import (
    MedialModel,
    medial_costs_of_poses,
    places_of,
)
from chsel.methods.medial_constraint.medial_search_kernels import (
    MedialSearch,
    SearchScratch,
    search_scratch,
)
from chsel.methods.medial_constraint.narrow_field_kernels import NarrowField
from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import Places, triple
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

    inflation: Annotated[float, not_negative] = 0.04  # of balls, to cover others, at most, metres
    # Weights of the two means; a ball_scale of 0 ignores free space, as the authors' released code
    # does, whose balls never enter the cost.
    ball_scale: Annotated[float, not_negative] = 1.0
    known_scale: Annotated[float, not_negative] = 1.0
    lookup: Annotated[str, one_of(*LOOKUPS)] = "trilinear"  # how the SDF is read, see SdfGrid.at
    outside: Annotated[str, one_of(*OUTSIDE)] = "surface_point"  # and beyond its box

    presets: ClassVar[Presets] = {
        "paper": {"inflation": 0.02, "lookup": "nearest"},
        "reference": {
            "inflation": 0.02,
            "ball_scale": 0.0,
            "lookup": "nearest",
            "outside": "bounding_box",
        },
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
        self._exact = _exact_model(problem, self.balls, settings)
        self.model = _search_model(problem, self.balls, settings)

    def costs(self, vectors: FloatArray) -> FloatArray:
        """Costs (B,) of vectors (B, d) of the search space."""
        return self.evaluate(self.space.poses(vectors))

    def evaluate(self, poses: Poses) -> FloatArray:
        """Costs (B,) of poses; infinite for one that is not finite."""
        costs = np.empty(len(poses))
        run = partial(medial_costs_of_poses, self._exact, poses.numbers, costs)
        spread(run, len(poses), self._places, least=_POSES_PER_THREAD)
        return costs

    def work(self) -> SearchScratch:
        """Scratch for one thread of a search, which looks up `model`."""
        return search_scratch(self.model)

    def _places(self) -> Places:
        return places_of(self._exact)


def _exact_model(
    problem: RegistrationProblem, balls: Balls, settings: MedialCostSettings
) -> MedialModel:
    return MedialModel(
        field=distance_field(problem.sdf, settings.lookup, settings.outside),
        centres=balls.centres.T.copy(),
        radii=balls.radii,
        known=problem.points.known.T.copy(),
        known_sdf=problem.points.sdf.copy(),
        ball_scale=settings.ball_scale,
        known_scale=settings.known_scale,
    )


def _search_model(
    problem: RegistrationProblem, balls: Balls, settings: MedialCostSettings
) -> MedialSearch:
    sdf, radii, known = problem.sdf, balls.radii, problem.points.known
    both = np.concatenate([balls.centres, known])
    middle = (both.min(axis=0) + both.max(axis=0)) / 2.0 if len(both) else np.zeros(3)
    bounds = least_distances(sdf, settings.outside, float(radii.max(initial=0.0)))
    square = sdf.resolution * sdf.resolution
    return MedialSearch(
        field=_narrow_field(sdf, settings, bounds),
        bounds=bounds,
        middle=triple(middle),
        span=float(np.abs(both - middle).max(initial=0.0)),
        centres=(balls.centres - middle).T.astype(np.float32, order="C"),
        radii=(radii / sdf.resolution).astype(np.float32),
        steps=np.ceil(radii / bounds.step).astype(np.uint8),
        known=(known - middle).T.astype(np.float32, order="C"),
        known_sdf=(problem.points.sdf / sdf.resolution).astype(np.float32),
        ball_scale=settings.ball_scale * square / max(len(radii), 1),
        known_scale=settings.known_scale * square / max(len(known), 1),
    )


def _narrow_field(
    sdf: SdfGrid, settings: MedialCostSettings, bounds: LeastDistances
) -> NarrowField:
    """An SDF grid in 32 bits, for points in cells of the bounds."""

    def rows() -> Any:
        return (sdf.table / np.array([sdf.resolution, 1.0, 1.0, 1.0])).astype(np.float32)

    in_cells = sdf.derived("rows in cells", rows)
    _, ny, nz = sdf.shape
    return NarrowField(
        rows=in_cells,
        values=sdf.derived("values in cells", lambda: in_cells[:, 0].copy()),
        last=triple(np.array(sdf.shape) - 1.0),
        across=ny * nz,
        along=nz,
        nearest=settings.lookup == "nearest",
        surface=0.0 if settings.outside == "bounding_box" else 1.0,
        side=1.0 / (bounds.inverse * sdf.resolution),
        margin=float(np.rint((sdf.origin[0] - bounds.first[0]) * bounds.inverse)),
    )


def _balls_of(problem: RegistrationProblem, settings: MedialCostSettings) -> Balls:
    if settings.ball_scale == 0.0:
        return Balls(np.zeros((0, 3)), np.zeros(0))
    free, resolution = problem.points.free, problem.free_resolution
    return medial_balls(free, problem.workspace, resolution, settings.inflation)
