"""Members of the plausible set off its grid: around other members, and in modes between poses.

Between the poses of the grid, a mode that is a few millimetres thick fits many times. But around
it poses nearly are members: the grid is scanned for those, and they climb from there.
"""

from __future__ import annotations

from dataclasses import replace
from warnings import catch_warnings, simplefilter

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_settings import CostSettings
from chsel.cost.objective import Objective
from chsel.errors import EvaluationError, SdfError
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.plausible.evaluation_cost import EvaluationCost
from chsel.plausible.plausible_settings import ModeSearchSettings
from chsel.plausible.pose_scan import MOST_MEMBERS, PoseGrid, plausible_stream, scan_grid
from chsel.plausible.surface_distance import SQUARE_MILLIMETRES, DistanceSettings, SurfaceDistance
from chsel.problem.poses import Poses, compose, inverse, product, rotation_vector
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import SE3Space
from chsel.problem.streams import normals, uniforms
from chsel.problem.subset import farthest_points
from chsel.problem.surface import surface_points

_SHRINK = 0.5  # of the steps of local members
_ROUNDS, _MOST_ROUNDS = 8, 64  # the latter where the former find fewer than wanted
_DRAWN = 4000  # poses a round
_ENOUGH = 20  # times as many as wanted, to choose from
_POSITION, _ANGLE = 0.01, 0.1  # standard deviations at first, metres and radians
_LEAST_SCALE = _SHRINK ** (_ROUNDS - 1)
_FEW = 0.02  # members among those drawn, of which a later round makes steps shorter

_MODE_STREAM = 200
_PENALTY = 0.001  # metres that a violated free point adds to the mean of the known ones
_FIRST_ROTATIONS = 60  # that are scanned for poses to climb from; then twice as many, and so on
_CANDIDATES = 10_000  # among which those to climb from are chosen
_RATES = (0.01, 0.004, 0.0015)  # of Adam: in a block of iterations each
_ITERATIONS = 40
_SCALE = 20.0  # of the violations in it
_CLIMB_ROUNDS, _CLIMB_DRAWN = 16, 8  # of random steps, and poses a round for each that climbs
_CLIMB_POSITION, _CLIMB_ANGLE = 0.003, 0.03  # standard deviations at first, metres and radians
_CLIMB_SHRINK = 0.7
_GIVEN_UP = 0.2  # of those still climbing, after every round
_SURFACE_POINTS = 50


def random_subset(count: int, most: int, stream: np.random.Generator) -> IntArray:
    """At most so many of the numbers below `count`, drawn at random, ascending."""
    if count <= most:
        return np.arange(count)
    drawn = uniforms(stream, 0.0, 1.0, count)
    return np.sort(np.argsort(drawn, kind="stable")[:most])


def local_members(
    cost: EvaluationCost, members: FloatArray, limit: float, wanted: int, *, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Up to `wanted` poses (W, 4, 4) near members (P, 4, 4), world_from_object, and their costs.

    Rounds of normal steps in position and rotation vector from members, those of earlier rounds
    among them, so that the search walks along the set; the steps get shorter after a round
    without a new member, and in a thin set, where the first rounds give too few, after one with
    few. Of all that cost less than the limit, those are taken that are the farthest from each
    other and from the members. They show how far the set reaches around its known members, not
    where else it has any.
    """
    known, pool, costs, scale = len(members), members, np.zeros(0), 1.0
    for n in range(_MOST_ROUNDS):
        if n == _ROUNDS and len(costs) >= wanted:
            break
        stream = plausible_stream(seed, 2 + n)
        steps = normals(stream, (_DRAWN, 6)) * scale
        starts = pool[np.floor(uniforms(stream, 0.0, float(len(pool)), _DRAWN)).astype(int)]
        drawn = stepped(starts, _POSITION * steps[:, :3], _ANGLE * steps[:, 3:])
        drawn_costs = cost.evaluate(inverse(drawn), limit=limit)
        good = drawn_costs < limit
        pool = np.concatenate([pool, drawn[good]])
        costs = np.concatenate([costs, drawn_costs[good]])
        few = _FEW * _DRAWN if n >= _ROUNDS - 1 else 1
        scale = scale if good.sum() >= few else max(_SHRINK * scale, _LEAST_SCALE)
        if n >= _ROUNDS // 2 and len(costs) >= _ENOUGH * wanted:
            break
    places = _places(pool, cost.problem.sdf)
    chosen = np.sort(farthest_points(places, known + wanted, given=known))[known:]
    return pool[chosen], costs[chosen - known]


def stepped(poses: FloatArray, shifts: FloatArray, turns: FloatArray) -> FloatArray:
    """Poses (..., 4, 4) moved by shifts (..., 3), turned about their origins by vectors (..., 3).

    The latter are rotation vectors about the axes of the world.
    """
    rotation = product(rotation_vector(turns), poses[..., :3, :3])
    return compose(rotation, poses[..., :3, 3] + shifts)


def _places(poses: FloatArray, sdf: SdfGrid) -> FloatArray:
    """Vectors (N, 12) whose distances compare poses (N, 4, 4): position, and scaled rotation.

    A radian counts for about as far as it moves the surface of the object.
    """
    lever = sdf.diameter / 4.0
    return np.concatenate([poses[:, :3, 3], lever * poses[:, :3, :3].reshape(-1, 9)], axis=1)


def modes_between(
    grid: PoseGrid,
    cost: EvaluationCost,
    limit: float,
    *,
    members: FloatArray,
    settings: ModeSearchSettings,
    most: int,
    seed: int,
) -> tuple[FloatArray, FloatArray]:
    """Up to `most` poses (M, 4, 4) that cost less than the limit, and their costs.

    Each far from members (P, 4, 4), the true pose first, and from the other ones, the farthest
    first. No position is farther outside of the grid's than the separation. All poses are
    world_from_object.
    """
    sdf = cost.problem.sdf
    starts = _nearly_plausible(grid, cost, members[0], settings)
    starts = starts[random_subset(len(starts), _CANDIDATES, plausible_stream(seed, _MODE_STREAM))]
    starts = starts[farthest_points(_places(starts, sdf), settings.starts)]
    if len(starts) == 0:
        return np.zeros((0, 4, 4)), np.zeros(0)
    poses, costs = _climbed(cost, starts, limit, seed)
    lower = grid.positions.min(axis=0) - settings.separation
    upper = grid.positions.max(axis=0) + settings.separation
    inside = ((poses[:, :3, 3] >= lower) & (poses[:, :3, 3] <= upper)).all(axis=1)
    poses, costs = poses[inside], costs[inside]
    chosen = _far_from(members, poses, _grid_distance(sdf, seed), settings.separation, most)
    return poses[chosen], costs[chosen]


def _nearly_plausible(
    grid: PoseGrid, cost: EvaluationCost, truth: FloatArray, settings: ModeSearchSettings
) -> FloatArray:
    """Poses (N, 4, 4) of a grid to climb from, of as many of its rotations as give enough.

    They cost at most `distance` more than the true pose (4, 4): the mean over known points, and a
    millimetre for every point that is deeper on the wrong side than is allowed by `depth`.
    """
    relaxed = EvaluationCost(
        cost.problem,
        replace(
            cost.settings,
            combine="means",
            violation=_PENALTY * max(len(cost.problem.points.free), 1),
            tolerance=cost.settings.tolerance + settings.depth,
        ),
    )
    limit = relaxed.at(truth) + settings.distance
    most = max(1, MOST_MEMBERS // len(grid.positions))
    poses, count, first, size = [], 0, 0, min(_FIRST_ROTATIONS, most)
    while first < len(grid.rotations) and count < _CANDIDATES:
        part = replace(grid, rotations=grid.rotations[first : first + size])
        index, _ = scan_grid(relaxed, part, limit)
        poses.append(part.poses(index))
        count, first, size = count + len(index), first + size, min(2 * size, most)
    return np.concatenate(poses)


def _climbed(
    cost: EvaluationCost, starts: FloatArray, limit: float, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Members (M, 4, 4) that are reached from poses (N, 4, 4), world_from_object, and their costs.

    Down the gradient of the relaxed cost, whose terms are depths where C counts, then by random
    steps that lower C itself, ever shorter ones where none does; after every round some of those
    that still cost the most are given up.
    """
    poses = _descended(cost, starts)
    costs = cost.evaluate(inverse(poses))
    scale = np.ones(len(poses))
    climbing = np.flatnonzero(costs >= limit)
    for n in range(_CLIMB_ROUNDS):
        if len(climbing) == 0:
            break
        stream = plausible_stream(seed, _MODE_STREAM + 2 + n)
        steps = normals(stream, (len(climbing), _CLIMB_DRAWN, 6)) * scale[climbing, None, None]
        steps *= uniforms(stream, 0.05, 1.0, (len(climbing), _CLIMB_DRAWN, 1))
        shifts, turns = _CLIMB_POSITION * steps[..., :3], _CLIMB_ANGLE * steps[..., 3:]
        drawn = stepped(poses[climbing, None], shifts, turns)
        drawn_costs = cost.evaluate(inverse(drawn).reshape(-1, 4, 4)).reshape(-1, _CLIMB_DRAWN)
        rows, best = np.arange(len(climbing)), np.argmin(drawn_costs, axis=1)
        better = drawn_costs[rows, best] < costs[climbing]
        scale[climbing[~better]] *= _CLIMB_SHRINK
        poses[climbing[better]] = drawn[rows, best][better]
        costs[climbing[better]] = drawn_costs[rows, best][better]
        climbing = climbing[np.argsort(costs[climbing], kind="stable")]
        climbing = climbing[costs[climbing] >= limit]
        climbing = np.sort(climbing[: int((1.0 - _GIVEN_UP) * len(climbing)) + 1])
    return poses[costs < limit], costs[costs < limit]


def _descended(cost: EvaluationCost, starts: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) after some iterations of Adam on the relaxed cost, world_from_object."""
    smooth = CostSettings(
        penetration_tolerance=-cost.settings.tolerance,
        occupied_scale=_SCALE if cost.settings.occupied else 0.0,
        free_scale=_SCALE,
        outside=cost.settings.outside,
    )
    with catch_warnings():
        simplefilter("ignore")  # objects that are too thin to be violated are fine here
        objective = Objective(CompiledCost.of(cost.problem, smooth), SE3Space())
    poses = Poses.of(inverse(starts))
    for rate in _RATES:
        vectors = objective.descended(objective.space.encode(poses), 1.0, rate, _ITERATIONS)
        poses = objective.space.poses(vectors)
    return poses.world_from_object


def _grid_distance(sdf: SdfGrid, seed: int) -> SurfaceDistance:
    """The distance that coverage reads, but from the grid."""
    try:
        points = surface_points(sdf, _SURFACE_POINTS, plausible_stream(seed, _MODE_STREAM + 1))
    except SdfError as error:
        raise EvaluationError(f"modes cannot be distinguished: {error}") from None
    return SurfaceDistance(sdf, None, points, DistanceSettings(_SURFACE_POINTS, "grid"))


def _far_from(
    members: FloatArray, poses: FloatArray, distance: SurfaceDistance, separation: float, most: int
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
