"""The plausible set: all poses on a grid that cost hardly more than the true one (CHSEL, Sec. V).

    P_eps = {X : C(X) < C(X*) + eps}

With means over points, C may fall as points are added, so that a pose that was rejected comes
back: every step looks at all poses, unless it is told otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from chsel.errors import PoseError
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray, digest, frozen
from chsel.numerics.octree import rounding_margin
from chsel.numerics.threads import spread
from chsel.plausible.mode_search import CANDIDATES, modes_found, nearly_plausible
from chsel.plausible.plausible_kernels import Blocks, Room, Scan, room_for, scan_rotations
from chsel.plausible.plausible_settings import Offsets, PlausibleSettings, PoseGridSettings
from chsel.plausible.pose_metrics import EvaluationError
from chsel.plausible.scan import EvaluationCost, blocks_of, bounds_of, local_members
from chsel.problem.poses import axis_angle, check_rigid, compose, inverse, random_rotations
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.streams import Purpose, StreamKey, uniforms
from chsel.problem.subset import farthest_points

MOST_MEMBERS = 2_000_000
_CAPACITY = 50_000  # poses that a thread finds before it hands them over, at least
_ROTATIONS_PER_THREAD = 200
_FIRST_ROTATIONS = 60  # that are looked at for poses to climb from; then twice as many, and so on
_PER_MODE = 4  # members that a mode gets, where there are few modes
_MOST_TELLING = 256  # known points that are put in order
_ROUNDING = 1e-9  # of a sum, that adding in another order may change


@dataclass(frozen=True, eq=False)
class PlausibleSet:
    """Members of the plausible set of one step.

    world_from_object (P, 4, 4): those kept for evaluation, the true pose first. cost (P,): C of
    each. local (P,): True for one that was sought off the grid. index, index_cost (G,): all
    members on the grid: rotation number times positions plus position number, ascending, and C.
    true_cost: C(X*). settings; seed: of the rotations. points_digest, sdf_digest: of the known
    points and of the grid to which the set belongs.
    """

    world_from_object: FloatArray
    cost: FloatArray
    local: BoolArray
    index: IntArray
    index_cost: FloatArray
    true_cost: float
    settings: PlausibleSettings
    seed: int
    points_digest: str
    sdf_digest: str

    @property
    def truth(self) -> FloatArray:
        """The true pose T* (4, 4), world_from_object."""
        return self.world_from_object[0]

    @property
    def filled(self) -> bool:
        """Whether members off the grid were added."""
        return bool(self.local.any())

    @property
    def digest(self) -> str:
        """Digest of the members and their costs."""
        parts = self.world_from_object, self.cost, self.local, self.index, self.index_cost
        return digest(*parts)


def plausible_set(
    problem: RegistrationProblem,
    world_from_object: FloatArray,
    settings: PlausibleSettings,
    *,
    survivors: PlausibleSet | None = None,
) -> PlausibleSet:
    """The plausible set of a problem around the true pose (4, 4).

    What the true pose itself violates counts into C(X*), so that as much is allowed to others.
    survivors: the set of the step before, for settings without rescan. Raises EvaluationError if
    there are more than MOST_MEMBERS members.
    """
    truth = _checked(world_from_object)
    cost = EvaluationCost(problem, settings.cost)
    true_cost = float(cost.evaluate(inverse(truth)[None])[0])
    limit = true_cost + settings.epsilon
    seed = rotation_seed(problem, settings)
    grid = grid_around(truth, settings.grid, seed)
    if survivors is None or settings.rescan:
        index, costs = scan(cost, problem, grid, limit)
    else:
        _check_survivors(survivors, problem, truth, settings, seed)
        costs = cost.evaluate(inverse(grid.poses(survivors.index)), limit=limit)
        index, costs = survivors.index[costs < limit], costs[costs < limit]
    chosen = _kept(index, settings.members - 1, seed)
    members = np.concatenate([truth[None], grid.poses(index[chosen])])
    member_costs = np.concatenate([[true_cost], costs[chosen]])
    again = (members[1:] == truth).all(axis=(1, 2))  # a grid may hold the true pose itself
    keep = np.concatenate([[True], ~again])
    found = PlausibleSet(
        members[keep],
        member_costs[keep],
        np.zeros(int(keep.sum()), dtype=bool),
        index,
        costs,
        true_cost,
        settings,
        seed,
        problem.points.digest,
        problem.sdf.digest,
    )
    if settings.modes is not None:
        found = _with_modes(found, problem, cost, grid, limit)
    return _filled(found, cost, limit, problem.sdf.diameter)


def rotation_seed(problem: RegistrationProblem, settings: PlausibleSettings) -> int:
    """The seed of the rotations that are looked at."""
    return problem.key.seed if settings.grid.seed is None else settings.grid.seed


@dataclass(frozen=True, eq=False)
class PoseGrid:
    """Poses: every rotation at every position. Pose n has rotation n // P and position n % P.

    centre (3,): in the world. offsets: from it, by axis. rotations (R, 3, 3): world_from_object.
    """

    centre: FloatArray
    offsets: Offsets
    rotations: FloatArray

    @cached_property
    def positions(self) -> FloatArray:
        """Positions (P, 3) in the world."""
        return self.centre + self.offsets.points()

    def poses(self, index: IntArray) -> FloatArray:
        """The poses (N, 4, 4), world_from_object, of these numbers (N,)."""
        rotation, position = np.divmod(index, len(self.positions))
        return compose(self.rotations[rotation], self.positions[position])

    def __len__(self) -> int:
        return len(self.positions) * len(self.rotations)


def grid_around(truth: FloatArray, settings: PoseGridSettings, seed: int) -> PoseGrid:
    """The grid of a definition around the true pose (4, 4)."""
    rotations = _rotations(settings, truth[:3, :3], seed)
    return PoseGrid(truth[:3, 3], settings.offsets, rotations)


def scan(
    cost: EvaluationCost, problem: RegistrationProblem, grid: PoseGrid, limit: float
) -> tuple[IntArray, FloatArray]:
    """Numbers and costs (G,) of all poses of a grid that cost less than a limit, ascending."""
    model = cost.model
    margin = rounding_margin(
        np.concatenate([grid.positions.reshape(-1), cost.points.all_points().reshape(-1)])
    )
    blocks, radii = _blocks(grid.offsets, margin)
    blocks = blocks._replace(centres=blocks.centres + grid.centre[:, None])
    bounds = bounds_of(problem.sdf, cost.settings.lookup, cost.settings.outside, radii)
    order = _telling_order(cost.points.known)
    known_limit = limit * model.divisors[2] * (1.0 + _ROUNDING)
    what = Scan(
        grid.rotations.reshape(-1, 9),
        grid.positions,
        cost.points.known[order].T.copy(),
        cost.points.sdf[order],
        limit,
        known_limit + 10.0 * margin * len(order),
    )
    found: dict[int, list[tuple[IntArray, FloatArray]]] = {}
    total = [0]

    def run(first: int, last: int, room: Room) -> None:
        pieces = found[first] = []
        while first < last and total[0] <= MOST_MEMBERS:
            first, count = scan_rotations(model, blocks, bounds, what, first, last, room)
            pieces.append((room.pose[:count].copy(), room.cost[:count].copy()))
            total[0] += count

    def scratch() -> Room:
        capacity = len(grid.positions) + _CAPACITY
        return room_for(model, len(order), len(blocks.layer), capacity)

    spread(run, len(grid.rotations), scratch, least=_ROTATIONS_PER_THREAD)
    pieces = [piece for first in sorted(found) for piece in found[first]]
    index = np.concatenate([piece[0] for piece in pieces])
    if len(index) > MOST_MEMBERS:
        raise EvaluationError(_too_many(cost, limit))
    ascending = np.argsort(index, kind="stable")
    return index[ascending], np.concatenate([piece[1] for piece in pieces])[ascending]


def _too_many(cost: EvaluationCost, limit: float) -> str:
    count, violation = cost.points.count, cost.model.violation / cost.model.divisors[0]
    text = f"more than {MOST_MEMBERS:_} poses cost less than {limit:.4g} with {count} known points"
    if limit >= violation:
        text += f", as the true pose costs that much itself (a violated point: {violation:.4g})"
    return text + "; accepted: more known points, a smaller epsilon or a larger cost.tolerance"


@lru_cache(maxsize=8)
def _blocks(offsets: Offsets, margin: float) -> tuple[Blocks, FloatArray]:
    return blocks_of(offsets.points(), margin)


def _rotations(settings: PoseGridSettings, true: FloatArray, seed: int) -> FloatArray:
    """world_from_object rotations (R, 3, 3); the same at every step of a session."""
    stream = StreamKey(seed, 0).stream(Purpose.PLAUSIBLE_ROTATIONS)
    rotations = random_rotations(stream, settings.rotations)
    if settings.extra == "none":
        return rotations
    upward = np.broadcast_to([0.0, 0.0, 1.0], (settings.upright, 3))
    if settings.extra == "replaced":
        step = 2.0 * np.pi / max(settings.upright - 1, 1)
        upright = axis_angle(upward, np.arange(float(settings.upright)) * step)
        return np.concatenate([upright, true[None], rotations[settings.upright + 1 :]])
    turns = np.arange(float(settings.upright)) * (2.0 * np.pi / max(settings.upright, 1))
    return np.concatenate([rotations, axis_angle(upward, turns), true[None]])


def _checked(world_from_object: FloatArray) -> FloatArray:
    truth = frozen("world_from_object", world_from_object, (4, 4), error=PoseError)
    check_rigid("world_from_object", truth[None])
    return truth


def _check_survivors(
    survivors: PlausibleSet,
    problem: RegistrationProblem,
    truth: FloatArray,
    settings: PlausibleSettings,
    seed: int,
) -> None:
    fits = survivors.settings.grid == settings.grid and survivors.seed == seed
    fits = fits and survivors.sdf_digest == problem.sdf.digest
    if not fits or not (survivors.truth == truth).all():
        raise EvaluationError(
            "survivors are of another grid of poses; accepted: a set of the same object, true "
            "pose, grid and seed"
        )


def _telling_order(known: FloatArray) -> IntArray:
    """Known points, each far from those before it, then at random: to reject poses early."""
    first = farthest_points(known, _MOST_TELLING)
    stream = StreamKey(0, 0).stream(Purpose.PLAUSIBLE_ROTATIONS)
    rest = np.argsort(uniforms(stream, 0.0, 1.0, len(known)), kind="stable")
    return np.concatenate([first, rest[~np.isin(rest, first)]])


def _kept(index: IntArray, most: int, seed: int) -> IntArray:
    """Which members are kept for evaluation: a random subset, the same ones wherever it runs."""
    if len(index) <= most:
        return np.arange(len(index))
    stream = StreamKey(seed, 0).stream(Purpose.PLAUSIBLE_ROTATIONS, 1)
    drawn = uniforms(stream, 0.0, 1.0, len(index))
    return np.sort(np.argsort(drawn, kind="stable")[:most])


def _with_modes(
    found: PlausibleSet,
    problem: RegistrationProblem,
    cost: EvaluationCost,
    grid: PoseGrid,
    limit: float,
) -> PlausibleSet:
    """With members in modes that the grid passes by, in place of others if they are too many."""
    settings, known = found.settings, len(found.cost)
    assert settings.modes is not None
    nearly = _nearly_plausible(problem, found.truth, grid, settings)
    box = np.stack([grid.positions.min(axis=0), grid.positions.max(axis=0)])
    room = max(settings.members - known, settings.members // 2)
    poses, costs = modes_found(
        problem,
        cost,
        limit,
        members=found.world_from_object,
        nearly=nearly,
        box=box,
        settings=settings.modes,
        most=room,
        seed=found.seed,
    )
    others = _kept(np.arange(1, known), settings.members - 1 - len(poses), found.seed) + 1
    rows = np.concatenate([[0], others])
    kept = replace(
        found,
        world_from_object=found.world_from_object[rows],
        cost=found.cost[rows],
        local=found.local[rows],
    )
    return _with(kept, poses, costs)


def _nearly_plausible(
    problem: RegistrationProblem, truth: FloatArray, grid: PoseGrid, settings: PlausibleSettings
) -> FloatArray:
    """Poses (N, 4, 4) of a grid to climb from, of as many of its rotations as give enough."""
    assert settings.modes is not None
    cost, limit = nearly_plausible(problem, truth, settings.cost, settings.modes)
    most = max(1, MOST_MEMBERS // len(grid.positions))
    poses, count, first, size = [], 0, 0, min(_FIRST_ROTATIONS, most)
    while first < len(grid.rotations) and count < CANDIDATES:
        part = PoseGrid(grid.centre, grid.offsets, grid.rotations[first : first + size])
        index, _ = scan(cost, problem, part, limit)
        poses.append(part.poses(index))
        count, first, size = count + len(index), first + size, min(2 * size, most)
    return np.concatenate(poses)


def _filled(
    found: PlausibleSet, cost: EvaluationCost, limit: float, diameter: float
) -> PlausibleSet:
    """With members off the grid around others, if there are too few, or too few in its modes."""
    settings, members = found.settings, found.world_from_object
    wanted = settings.fill_to - len(members)
    if wanted <= 0:
        members = members[found.local]  # one of each mode
        room = settings.members - len(found.cost)
        wanted = min(_PER_MODE * len(members), settings.fill_to, len(members) + room)
        wanted -= len(members)
    if wanted <= 0:
        return found
    # As far as a turn by a radian moves the object's surface, about.
    lever = diameter / 4.0
    more, costs = local_members(cost, members, limit, wanted, lever=lever, seed=found.seed)
    return _with(found, more, costs)


def _with(found: PlausibleSet, poses: FloatArray, costs: FloatArray) -> PlausibleSet:
    """With members off the grid: poses (N, 4, 4), world_from_object, and their costs."""
    return replace(
        found,
        world_from_object=np.concatenate([found.world_from_object, poses]),
        cost=np.concatenate([found.cost, costs]),
        local=np.concatenate([found.local, np.ones(len(poses), dtype=bool)]),
    )
