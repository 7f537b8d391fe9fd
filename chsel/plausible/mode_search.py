"""Members of the plausible set in modes that its grid of poses passes by.

Between the poses of the grid, a mode that is a few millimetres thick fits many times. But around
it poses nearly are members: the grid is looked through for those, and they climb from there.
"""

from __future__ import annotations

from dataclasses import replace
from warnings import catch_warnings, simplefilter

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_settings import CostSettings
from chsel.cost.objective import Objective
from chsel.errors import SdfError
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.plausible.plausible_settings import EvaluationCostSettings, ModeSearchSettings
from chsel.plausible.pose_metrics import EvaluationError
from chsel.plausible.scan import EvaluationCost
from chsel.plausible.surface_distance import SQUARE_MILLIMETRES, DistanceSettings, SurfaceDistance
from chsel.problem.poses import Poses, compose, inverse, product, rotation_vector
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import SE3Space
from chsel.problem.streams import Purpose, StreamKey, normals, uniforms
from chsel.problem.subset import farthest_points
from chsel.problem.surface import surface_points

_STREAM = 200  # of the plausible rotations' streams, and those after it
_PENALTY = 0.001  # metres that a violated free point adds to the mean of the known ones
CANDIDATES = 10_000  # among which those to climb from are chosen
_RATES = (0.01, 0.004, 0.0015)  # of Adam: in a block of iterations each
_ITERATIONS = 40
_SCALE = 20.0  # of the violations in it
_ROUNDS, _DRAWN = 16, 8  # of random steps, and how many poses a round for each that climbs
_POSITION, _ANGLE = 0.003, 0.03  # standard deviations at first, metres and radians
_SHRINK = 0.7
_GIVEN_UP = 0.2  # of those still climbing, after every round
_SURFACE_POINTS = 50


def nearly_plausible(
    problem: RegistrationProblem,
    truth: FloatArray,
    by: EvaluationCostSettings,
    settings: ModeSearchSettings,
) -> tuple[EvaluationCost, float]:
    """A cost, and what poses to climb from cost less than; truth (4, 4): world_from_object.

    The mean over known points and a millimetre for every point that is deeper on the wrong side
    than the definition allows by `depth`; `distance` more than the true pose costs.
    """
    penalty = _PENALTY * max(len(problem.points.free), 1)
    depth = by.tolerance + settings.depth
    relaxed = replace(by, combine="means", violation=penalty, tolerance=depth)
    cost = EvaluationCost(problem, relaxed)
    return cost, float(cost.evaluate(inverse(truth)[None])[0]) + settings.distance


def modes_found(
    problem: RegistrationProblem,
    cost: EvaluationCost,
    limit: float,
    *,
    members: FloatArray,
    nearly: FloatArray,
    box: FloatArray,
    settings: ModeSearchSettings,
    most: int,
    seed: int,
) -> tuple[FloatArray, FloatArray]:
    """Up to `most` poses (M, 4, 4) that cost less than the limit, and their costs.

    Each far from members (P, 4, 4) and from the other ones, the farthest first. nearly (N, 4, 4):
    poses to climb from, world_from_object. box (2, 3): its lower and upper corner; no position is
    farther outside of it than the separation.
    """
    lever = problem.sdf.diameter / 4.0  # as local members count radians
    starts = _spread_out(nearly, settings.starts, lever, seed)
    if len(starts) == 0:
        return np.zeros((0, 4, 4)), np.zeros(0)
    poses, costs = _climbed(problem, cost, starts, limit, seed)
    first, last = box[0] - settings.separation, box[1] + settings.separation
    inside = ((poses[:, :3, 3] >= first) & (poses[:, :3, 3] <= last)).all(axis=1)
    poses, costs = poses[inside], costs[inside]
    distance = _distance(problem.sdf, seed)
    chosen = _far_from(members, poses, distance, settings.separation, most)
    return poses[chosen], costs[chosen]


def _climbed(
    problem: RegistrationProblem,
    cost: EvaluationCost,
    starts: FloatArray,
    limit: float,
    seed: int,
) -> tuple[FloatArray, FloatArray]:
    """Members (M, 4, 4) that are reached from poses (N, 4, 4), world_from_object, and their costs.

    Down the gradient of the relaxed cost, whose terms are depths where C counts, then by random
    steps that lower C itself, ever shorter ones where none does; after every round some of those
    that still cost the most are given up.
    """
    poses = _descended(problem, cost, starts)
    costs = cost.evaluate(inverse(poses))
    scale = np.ones(len(poses))
    climbing = np.flatnonzero(costs >= limit)
    for n in range(_ROUNDS):
        if len(climbing) == 0:
            break
        drawn, drawn_costs = _drawn(cost, poses[climbing], scale[climbing], n, seed)
        best = np.argmin(drawn_costs, axis=1)
        rows = np.arange(len(climbing))
        better = drawn_costs[rows, best] < costs[climbing]
        scale[climbing[~better]] *= _SHRINK
        poses[climbing[better]] = drawn[rows, best][better]
        costs[climbing[better]] = drawn_costs[rows, best][better]
        climbing = climbing[np.argsort(costs[climbing], kind="stable")]
        climbing = climbing[costs[climbing] >= limit]
        climbing = np.sort(climbing[: int((1.0 - _GIVEN_UP) * len(climbing)) + 1])
    found = costs < limit
    return poses[found], costs[found]


def _descended(
    problem: RegistrationProblem, cost: EvaluationCost, starts: FloatArray
) -> FloatArray:
    by = cost.settings
    smooth = CostSettings(
        penetration_tolerance=-by.tolerance,
        occupied_scale=_SCALE if by.occupied else 0.0,
        free_scale=_SCALE,
        outside=by.outside,
    )
    with catch_warnings():
        simplefilter("ignore")  # objects that are too thin to be violated are fine here
        relaxed = CompiledCost.of(problem, smooth)
    objective = Objective(relaxed, SE3Space())
    poses = Poses.of(inverse(starts))
    for rate in _RATES:
        vectors = objective.descended(objective.space.encode(poses), 1.0, rate, _ITERATIONS)
        poses = objective.space.poses(vectors)
    return poses.world_from_object


def _drawn(
    cost: EvaluationCost, poses: FloatArray, scale: FloatArray, n: int, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Poses (N, D, 4, 4) at random around poses (N, 4, 4), and their costs (N, D)."""
    stream = StreamKey(seed, 0).stream(Purpose.PLAUSIBLE_ROTATIONS, _STREAM + 2 + n)
    steps = normals(stream, (len(poses), _DRAWN, 6)) * scale[:, None, None]
    steps *= uniforms(stream, 0.05, 1.0, (len(poses), _DRAWN, 1))
    turned = product(rotation_vector(_ANGLE * steps[..., 3:]), poses[:, None, :3, :3])
    drawn = compose(turned, poses[:, None, :3, 3] + _POSITION * steps[..., :3])
    return drawn, cost.evaluate(inverse(drawn.reshape(-1, 4, 4))).reshape(len(poses), _DRAWN)


def _spread_out(poses: FloatArray, most: int, lever: float, seed: int) -> FloatArray:
    """Up to `most` of poses (N, 4, 4), far from each other."""
    if len(poses) > CANDIDATES:
        stream = StreamKey(seed, 0).stream(Purpose.PLAUSIBLE_ROTATIONS, _STREAM)
        drawn = uniforms(stream, 0.0, 1.0, len(poses))
        poses = poses[np.sort(np.argsort(drawn, kind="stable")[:CANDIDATES])]
    places = np.concatenate([poses[:, :3, 3], lever * poses[:, :3, :3].reshape(-1, 9)], axis=1)
    return poses[farthest_points(places, most)]


def _distance(sdf: SdfGrid, seed: int) -> SurfaceDistance:
    """The distance that coverage reads, but from the grid."""
    stream = StreamKey(seed, 0).stream(Purpose.PLAUSIBLE_ROTATIONS, _STREAM + 1)
    try:
        points = surface_points(sdf, _SURFACE_POINTS, stream)
    except SdfError as error:
        raise EvaluationError(f"modes cannot be told apart: {error}") from None
    return SurfaceDistance(sdf, None, points, DistanceSettings(_SURFACE_POINTS, "grid"))


def _far_from(
    members: FloatArray,
    poses: FloatArray,
    distance: SurfaceDistance,
    separation: float,
    most: int,
) -> IntArray:
    """Which poses (N, 4, 4) are far from members (P, 4, 4) and each other, the farthest first."""
    nearest = distance.between(inverse(members), poses).min(axis=0)
    chosen: list[int] = []
    while len(chosen) < min(most, len(poses)):
        farthest = int(np.argmax(nearest))
        if not nearest[farthest] > SQUARE_MILLIMETRES * separation * separation:
            break
        chosen.append(farthest)
        from_it = distance.between(inverse(poses[farthest : farthest + 1]), poses)[0]
        nearest = np.minimum(nearest, from_it)
    return np.array(chosen, dtype=np.int64)
