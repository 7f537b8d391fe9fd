"""The plausible set: all poses on a grid that cost hardly more than the true one (CHSEL, Sec. V).

    P_eps = {X : C(X) < C(X*) + eps}

With means over points, C may fall as points are added, so that a pose that was rejected comes
back: every step scans all poses.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from warnings import catch_warnings, simplefilter

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_settings import CostSettings
from chsel.cost.objective import Objective
from chsel.errors import ChselError, EvaluationError, PoseError
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray, digest, frozen, read_npz
from chsel.plausible.evaluation_cost import EvaluationCost
from chsel.plausible.plausible_settings import PlausibleSettings
from chsel.plausible.pose_scan import (
    MOST_MEMBERS,
    PoseGrid,
    PoseScan,
    grid_around,
    plausible_stream,
    scan_grid,
)
from chsel.plausible.surface_distance import SQUARE_MILLIMETRES, DistanceSettings, SurfaceDistance
from chsel.problem.poses import Poses, check_rigid, compose, inverse, product, rotation_vector
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import SE3Space
from chsel.problem.settings import build_settings
from chsel.problem.streams import normals, uniforms
from chsel.problem.subset import farthest_points
from chsel.problem.surface import surface_points

_PER_MODE = 4  # members that a mode gets, where there are few modes
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
MOST_BYTES = 4 * 2**30  # of a file, unpacked: 30 million members
_ARRAYS = "world_from_object", "cost", "local", "index", "index_cost"  # of a file, and
_NUMBERS = "true_cost", "seed", "points_digest", "sdf_digest"


@dataclass(frozen=True, eq=False)
class PlausibleSet:
    """Members of the plausible set of one step."""

    world_from_object: FloatArray  # (P, 4, 4), kept for evaluation, the true pose first
    cost: FloatArray  # (P,), C of each
    local: BoolArray  # (P,), True for one that was sought off the grid
    index: IntArray  # (G,), all members on the grid, see PoseGrid, ascending
    index_cost: FloatArray  # (G,)
    true_cost: float  # C(X*)
    settings: PlausibleSettings  # its definition
    seed: int  # of the rotations
    points_digest: str  # of the known points to which the set belongs
    sdf_digest: str  # of their object's SDF grid

    @property
    def truth(self) -> FloatArray:
        """The true pose T* (4, 4), world_from_object."""
        return self.world_from_object[0]

    @property
    def digest(self) -> str:
        """Digest of the members and their costs."""
        return digest(*(getattr(self, name) for name in _ARRAYS))

    def with_members(self, world_from_object: FloatArray, cost: FloatArray) -> PlausibleSet:
        """Return the set with members off the grid (N, 4, 4), and their costs (N,), added."""
        return replace(
            self,
            world_from_object=np.concatenate([self.world_from_object, world_from_object]),
            cost=np.concatenate([self.cost, cost]),
            local=np.concatenate([self.local, np.ones(len(cost), dtype=bool)]),
        )


def plausible_set(
    problem: RegistrationProblem, world_from_object: FloatArray, *, settings: PlausibleSettings
) -> PlausibleSet:
    """Return the plausible set of a problem around the true pose (4, 4).

    What the true pose itself violates counts into C(X*), so that as much is allowed to others.
    Raises EvaluationError if there are more than MOST_MEMBERS members.
    """
    truth = frozen("world_from_object", world_from_object, shape=(4, 4), error=PoseError)
    check_rigid("world_from_object", truth[None])
    cost = EvaluationCost(problem, settings.cost)
    true_cost = cost.at(truth)
    limit = true_cost + settings.epsilon
    seed = rotation_seed(problem, settings)
    grid = grid_around(truth, settings.grid, seed=seed)
    index, costs = scan_grid(cost, grid, limit=limit)
    kept = random_subset(len(index), settings.members - 1, stream=plausible_stream(seed, 1))
    poses = grid.poses(index[kept])
    others = ~(poses == truth).all(axis=(1, 2))  # a grid may hold the true pose itself
    members = PlausibleSet(
        world_from_object=np.concatenate([truth[None], poses[others]]),
        cost=np.concatenate([[true_cost], costs[kept][others]]),
        local=np.zeros(1 + int(others.sum()), dtype=bool),
        index=index,
        index_cost=costs,
        true_cost=true_cost,
        settings=settings,
        seed=seed,
        points_digest=problem.points.digest,
        sdf_digest=problem.sdf.digest,
    )
    if settings.modes is not None:
        members = _with_modes(members, cost, grid=grid, limit=limit)
    return _filled(members, cost, limit=limit)


def rotation_seed(problem: RegistrationProblem, settings: PlausibleSettings) -> int:
    """Return the seed of the rotations that are looked at."""
    return problem.key.seed if settings.grid.seed is None else settings.grid.seed


def _with_modes(
    members: PlausibleSet, cost: EvaluationCost, *, grid: PoseGrid, limit: float
) -> PlausibleSet:
    """Return the set with members in modes that the grid passes by, in place of others if too many.

    Between the poses of the grid, a mode that is a few millimetres thick fits many times. But
    around it poses nearly are members: the grid is scanned for those, and they climb from there.
    Each is far from all members and from the other ones, the farthest first. No position is farther
    outside of the grid's than the separation.
    """
    settings = members.settings.modes
    sdf = cost.problem.sdf
    seed = members.seed
    assert settings is not None
    starts = _nearly_plausible(grid, cost, members=members)
    starts = starts[
        random_subset(len(starts), _CANDIDATES, stream=plausible_stream(seed, _MODE_STREAM))
    ]
    starts = starts[farthest_points(_places(starts, sdf), settings.starts)]
    if len(starts) == 0:
        return members
    poses, costs = _climbed(cost, starts, limit=limit, seed=seed)
    lower = grid.positions.min(axis=0) - settings.separation
    upper = grid.positions.max(axis=0) + settings.separation
    inside = ((poses[:, :3, 3] >= lower) & (poses[:, :3, 3] <= upper)).all(axis=1)
    poses, costs = poses[inside], costs[inside]
    most = members.settings.members
    count = len(members.cost)
    chosen = _far_from(members, poses, sdf=sdf, most=max(most - count, most // 2))
    others = random_subset(count - 1, most - 1 - len(chosen), stream=plausible_stream(seed, 1)) + 1
    kept = np.concatenate([[0], others])
    on_grid = replace(members, **{name: getattr(members, name)[kept] for name in _ARRAYS[:3]})
    return on_grid.with_members(poses[chosen], costs[chosen])


def _filled(members: PlausibleSet, cost: EvaluationCost, *, limit: float) -> PlausibleSet:
    """Return the set with members off the grid around others, where those of the grid are too few.

    Rounds of normal steps in position and rotation vector from members, those of earlier rounds
    among them, so that the search walks along the set; the steps get shorter after a round
    without a new member, and in a thin set, where the first rounds give too few, after one with
    few. Those are taken that are the farthest from each other and from the members. They show how
    far the set reaches around its known members, not where else it has any.
    """
    settings, around = members.settings, members.world_from_object
    wanted = settings.fill_to - len(around)
    if wanted <= 0:
        around = around[members.local]  # one of each mode
        left = settings.members - len(members.cost)
        wanted = min((_PER_MODE - 1) * len(around), settings.fill_to - len(around), left)
    if wanted <= 0:
        return members
    known = len(around)
    pool = around
    costs = np.zeros(0)
    scale = 1.0
    for n in range(_MOST_ROUNDS):
        if n == _ROUNDS and len(costs) >= wanted:
            break
        stream = plausible_stream(members.seed, 2 + n)
        steps = normals(stream, (_DRAWN, 6)) * scale
        starts = pool[
            np.floor(uniforms(stream, 0.0, upper=float(len(pool)), shape=_DRAWN)).astype(int)
        ]
        drawn = stepped(starts, _POSITION * steps[:, :3], turns=_ANGLE * steps[:, 3:])
        drawn_costs = cost.evaluate(inverse(drawn), limit=limit)
        good = drawn_costs < limit
        pool = np.concatenate([pool, drawn[good]])
        costs = np.concatenate([costs, drawn_costs[good]])
        few = _FEW * _DRAWN if n >= _ROUNDS - 1 else 1
        scale = scale if good.sum() >= few else max(_SHRINK * scale, _LEAST_SCALE)
        if n >= _ROUNDS // 2 and len(costs) >= _ENOUGH * wanted:
            break
    places = _places(pool, cost.problem.sdf)
    chosen = np.sort(farthest_points(places, known + wanted, chosen_first=known))[known:]
    return members.with_members(pool[chosen], costs[chosen - known])


def random_subset(count: int, most: int, *, stream: np.random.Generator) -> IntArray:
    """Return at most so many of the numbers below `count`, drawn at random, ascending."""
    if count <= most:
        return np.arange(count)
    drawn = uniforms(stream, 0.0, upper=1.0, shape=count)
    return np.sort(np.argsort(drawn, kind="stable")[:most])


def stepped(poses: FloatArray, shifts: FloatArray, *, turns: FloatArray) -> FloatArray:
    """Return poses (..., 4, 4) shifted (..., 3), and turned about their origins (..., 3).

    The latter are rotation vectors about the axes of the world.
    """
    rotation = product(rotation_vector(turns), poses[..., :3, :3])
    return compose(rotation, poses[..., :3, 3] + shifts)


def _places(poses: FloatArray, sdf: SdfGrid) -> FloatArray:
    """Return vectors (N, 12) that compare poses (N, 4, 4): position, and scaled rotation."""
    lever = sdf.diameter / 4.0
    return np.concatenate([poses[:, :3, 3], lever * poses[:, :3, :3].reshape(-1, 9)], axis=1)


def _nearly_plausible(grid: PoseGrid, cost: EvaluationCost, *, members: PlausibleSet) -> FloatArray:
    """Return poses (N, 4, 4) of a grid to climb from, of as many of its rotations as give enough.

    They cost at most `distance` more than the true pose: the mean over known points, and a
    millimetre for every point that is deeper on the wrong side than is allowed by `depth`.
    """
    settings = members.settings.modes
    assert settings is not None
    violation = _PENALTY * max(len(cost.problem.points.free), 1)
    tolerance = cost.settings.tolerance + settings.depth
    changes = replace(cost.settings, combine="means", violation=violation, tolerance=tolerance)
    relaxed = EvaluationCost(cost.problem, changes)
    limit = relaxed.at(members.truth) + settings.distance
    scan = PoseScan(relaxed, grid, limit=limit)
    most = max(1, MOST_MEMBERS // len(grid.positions))
    poses = []
    count = 0
    first = 0
    size = min(_FIRST_ROTATIONS, most)
    while first < len(grid.rotations) and count < _CANDIDATES:
        last = min(first + size, len(grid.rotations))
        index, _ = scan.poses_below(first, last)
        poses.append(grid.poses(index))
        count = count + len(index)
        first = last
        size = min(2 * size, most)
    return np.concatenate(poses)


def _climbed(
    cost: EvaluationCost, starts: FloatArray, *, limit: float, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Return members (M, 4, 4) reached from poses (N, 4, 4), world_from_object, and costs (M,).

    Down the gradient of the relaxed cost, then by random steps that lower C itself, ever shorter
    ones where none does; after every round some that still cost the most are given up.
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
        steps *= uniforms(stream, 0.05, upper=1.0, shape=(len(climbing), _CLIMB_DRAWN, 1))
        shifts, turns = _CLIMB_POSITION * steps[..., :3], _CLIMB_ANGLE * steps[..., 3:]
        drawn = stepped(poses[climbing, None], shifts, turns=turns)
        drawn_costs = cost.evaluate(inverse(drawn).reshape(-1, 4, 4)).reshape(-1, _CLIMB_DRAWN)
        rows = np.arange(len(climbing))
        best = np.argmin(drawn_costs, axis=1)
        better = drawn_costs[rows, best] < costs[climbing]
        scale[climbing[~better]] *= _CLIMB_SHRINK
        poses[climbing[better]] = drawn[rows, best][better]
        costs[climbing[better]] = drawn_costs[rows, best][better]
        climbing = climbing[np.argsort(costs[climbing], kind="stable")]
        climbing = climbing[costs[climbing] >= limit]
        climbing = np.sort(climbing[: int((1.0 - _GIVEN_UP) * len(climbing)) + 1])
    return poses[costs < limit], costs[costs < limit]


def _descended(cost: EvaluationCost, starts: FloatArray) -> FloatArray:
    """Return poses (N, 4, 4), world_from_object, after iterations of Adam on the relaxed cost."""
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
        vectors = objective.descended(
            objective.space.encode(poses), 1.0, rate=rate, iterations=_ITERATIONS
        )
        poses = objective.space.poses(vectors)
    return poses.world_from_object


def _far_from(members: PlausibleSet, poses: FloatArray, *, sdf: SdfGrid, most: int) -> IntArray:
    """Return indices of poses (N, 4, 4) far from members and each other, the farthest first."""
    assert members.settings.modes is not None
    least = SQUARE_MILLIMETRES * members.settings.modes.separation**2
    points = surface_points(
        sdf, _SURFACE_POINTS, stream=plausible_stream(members.seed, _MODE_STREAM + 1)
    )
    distance = SurfaceDistance(
        sdf, None, points=points, settings=DistanceSettings(_SURFACE_POINTS, "grid")
    )
    nearest = distance.between(inverse(members.world_from_object), poses).min(axis=0)
    chosen: list[int] = []
    while len(chosen) < min(most, len(poses)) and nearest.max() > least:
        farthest = int(np.argmax(nearest))
        chosen.append(farthest)
        from_it = distance.between(inverse(poses[farthest : farthest + 1]), poses)[0]
        nearest = np.minimum(nearest, from_it)
    return np.array(chosen, dtype=np.int64)


def plausible_path(
    folder: Path, problem: RegistrationProblem, *, settings: PlausibleSettings
) -> Path:
    """Return the path of a problem's set: FOLDER/<points digest>_<definition digest>.npz."""
    seed = rotation_seed(problem, settings)
    return folder / _name(problem.points.digest, settings, seed=seed, sdf=problem.sdf.digest)


def save_plausible(folder: Path, members: PlausibleSet) -> Path:
    """Write a set into a folder, under the name by which `load_plausible` finds it."""
    name = _name(members.points_digest, members.settings, seed=members.seed, sdf=members.sdf_digest)
    path = folder / name
    beside = folder / f".{name}.{os.urandom(4).hex()}"
    arrays: dict[str, Any] = {n: getattr(members, n) for n in (*_ARRAYS, *_NUMBERS, "digest")}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with beside.open("wb") as file:
            np.savez_compressed(file, settings=np.array(members.settings.text), **arrays)
        beside.replace(path)
    except OSError as error:
        raise EvaluationError(
            f"plausible set {path} cannot be written ({error.strerror or error}); accepted: a "
            "folder that can be written"
        ) from None
    return path


def load_plausible(
    folder: Path,
    problem: RegistrationProblem,
    *,
    settings: PlausibleSettings,
    world_from_object: FloatArray | None = None,
) -> PlausibleSet | None:
    """Return the stored set of a problem by a definition, around a true pose if given; else None.

    Raises EvaluationError for a file under that name that is damaged, of other points or another
    definition, or around another true pose.
    """
    path = plausible_path(folder, problem, settings=settings)
    if not path.exists():
        return None
    members = read_plausible(path)
    name = _name(members.points_digest, members.settings, seed=members.seed, sdf=members.sdf_digest)
    moved = world_from_object is not None and not (members.truth == world_from_object).all()
    if moved or name != path.name:
        raise EvaluationError(
            f"plausible set {path} belongs to other points or another true pose; accepted: these, "
            "so remove the file to have it computed again"
        )
    return members


def read_plausible(path: Path) -> PlausibleSet:
    """Return the set in a file, its digest checked. Raises EvaluationError if it is damaged."""
    try:
        arrays = read_npz(path, most_bytes=MOST_BYTES, error=EvaluationError)
        settings = json.loads(str(arrays["settings"]))
        values: dict[str, Any] = {name: arrays[name] for name in _ARRAYS}
        values |= {name: arrays[name].item() for name in _NUMBERS}
        values["settings"] = build_settings(PlausibleSettings, settings, where="settings")
        members = PlausibleSet(**values)
    except (ChselError, KeyError, ValueError) as error:
        text = " ".join(str(error).split())
        raise EvaluationError(
            f"plausible set {path} is damaged or not a plausible set ({text}); accepted: a file "
            "that runners.plausible has written"
        ) from None
    if str(arrays["digest"]) != members.digest:
        raise EvaluationError(
            f"plausible set {path} does not hold what was written (digest {members.digest}); "
            f"accepted: {arrays['digest']}"
        )
    return members


def _name(points: str, settings: PlausibleSettings, *, seed: int, sdf: str) -> str:
    text = "|".join([settings.digest, str(seed), sdf])
    definition = digest(np.frombuffer(text.encode(), dtype=np.uint8))
    return f"{points}_{definition}.npz"
