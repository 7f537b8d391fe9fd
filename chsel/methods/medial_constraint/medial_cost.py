"""The Medial Constraint cost: balls of free space must miss the object, contacts must touch it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, ClassVar, NamedTuple

import numpy as np

from chsel.cost.objective import costs_of
from chsel.methods.medial_constraint.medial_balls import Balls, medial_balls
from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import Places, locate, places_for
from chsel.numerics.compiler import compiled, implements, inner, spliced
from chsel.numerics.pose_tuples import all_finite, decode, finite, pose_at
from chsel.numerics.threads import require_ieee_arithmetic, spread
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import LOOKUPS, OUTSIDE
from chsel.problem.sdf_lookup import DistanceField, distance_field, distance_in_place
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


class MedialModel(NamedTuple):
    """All that determines the cost of a pose."""

    field: DistanceField
    centres: FloatArray  # (3, N_b), of the balls, world, metres
    radii: FloatArray  # (N_b,)
    known: FloatArray  # (3, N_k), world, metres
    known_sdf: FloatArray  # (N_k,)
    ball_scale: float
    known_scale: float


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
        if balls is None:
            free = problem.points.free if settings.ball_scale > 0.0 else np.zeros((0, 3))
            resolution, inflation = problem.free_resolution, settings.inflation
            balls = medial_balls(free, problem.workspace, resolution, inflation)
        self.balls = balls
        self.model = MedialModel(
            field=distance_field(problem.sdf, settings.lookup, settings.outside),
            centres=balls.centres.T.copy(),
            radii=balls.radii,
            known=problem.points.known.T.copy(),
            known_sdf=problem.points.sdf.copy(),
            ball_scale=settings.ball_scale,
            known_scale=settings.known_scale,
        )

    def costs(self, vectors: FloatArray) -> FloatArray:
        """Costs (B,) of vectors (B, d) of the search space."""
        return self.evaluate(self.space.poses(vectors))

    def evaluate(self, poses: Poses) -> FloatArray:
        """Costs (B,) of poses; infinite for one that is not finite."""
        costs = np.empty(len(poses))
        run = partial(_fill_costs, self.model, poses.numbers, costs)
        spread(run, len(poses), self.work, least=_POSES_PER_THREAD)
        return costs

    def work(self) -> Places:
        """Scratch for one thread."""
        return places_for(max(len(self.model.radii), len(self.model.known_sdf)))


@compiled
def _fill_costs(model, poses, out, first, last, places):
    """Fill out (B,) with the costs of poses (B, 12), from `first` to before `last`."""
    for n in range(first, last):
        out[n] = _cost(model, pose_at(poses, n), places)


@implements(costs_of, MedialModel)
def _medial_costs_of(model, space, vectors, costs, places):
    for n in range(len(vectors)):
        costs[n] = np.inf
        if all_finite(vectors[n]):
            costs[n] = _cost(model, decode(space, vectors[n]), places)


@inner
def _cost(model, pose, places):
    """C_M, each mean scaled; infinite for a pose that is not finite."""
    if not finite(pose):
        return np.inf
    cost = model.ball_scale * _ball_mean(model, pose, places)
    cost += model.known_scale * _known_mean(model, pose, places)
    return cost if cost < np.inf else np.inf  # NaN is infinite, too


@spliced
def _ball_mean(model, pose, places):
    """The mean square of how deep balls reach into the object."""
    field, radii = model.field, model.radii
    xs, ys, zs = model.centres[0], model.centres[1], model.centres[2]
    locate(pose, field.box, xs, ys, zs, places, len(radii))
    total = 0.0
    for n in range(len(radii)):
        if places.beyond[n] < radii[n] * radii[n]:
            s = distance_in_place(field, pose, xs[n], ys[n], zs[n], places, n)[0]
            depth = max(radii[n] - s, 0.0)
            total += depth * depth
    return total / max(len(radii), 1)


@spliced
def _known_mean(model, pose, places):
    """The mean square of s - v over points of known signed distance v, 0 for contacts."""
    field, known_sdf = model.field, model.known_sdf
    xs, ys, zs = model.known[0], model.known[1], model.known[2]
    locate(pose, field.box, xs, ys, zs, places, len(known_sdf))
    total = 0.0
    for n in range(len(known_sdf)):
        s = distance_in_place(field, pose, xs[n], ys[n], zs[n], places, n)[0]
        difference = s - known_sdf[n]
        total += difference * difference
    return total / max(len(known_sdf), 1)
