"""A grid of poses around the true one, and all its poses that cost less than a limit.

A group of neighbouring positions is rejected as soon as what the first known points cost at least
is too much all around its centre, then a pose of a group that remains by what they cost at its own
position. Bounds allow for rounding, and every pose that remains gets its exact cost.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Annotated, Any, NamedTuple

import numpy as np

from chsel.errors import EvaluationError, PoseError
from chsel.numerics.arrays import FloatArray, IntArray, frozen
from chsel.numerics.cell_set import node_of
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.pose_tuples import pose_at, turned
from chsel.numerics.threads import parallel_for
from chsel.plausible.evaluation_cost import (
    EvaluationCost,
    EvaluationModel,
    EvaluationScratch,
    Pose,
    cost_below,
    scratch_for,
)
from chsel.plausible.plausible_settings import (
    MOST_ROTATIONS,
    EvaluationCostSettings,
    Offsets,
    PoseGridSettings,
)
from chsel.problem.poses import (
    Poses,
    axis_angle,
    compose,
    inverse,
    nearest_rigid,
    product,
    random_rotations,
    rotation_vector,
)
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.settings import CheckedSettings, at_most, positive
from chsel.problem.streams import Purpose, StreamKey, normals, uniforms
from chsel.problem.subset import farthest_points

MOST_MEMBERS = 2_000_000
_CAPACITY = 50_000  # poses that a thread finds before it hands them over, at least
_ROTATIONS_PER_THREAD = 200
_MOST_INFORMATIVE = 256  # known points that are put in order
_ROUNDING = 1e-9  # share of a sum that is more than rounding changes
_LEAST_OUTWARD = 1e-9  # of a gradient along the normal of a face, so that rounding is no matter
_LANES = 32  # groups, or positions of one, that are looked at together
_GROUP_SIDES = (3, 3, 3)  # positions of a group along each axis, at most _LANES in all
_FIRST_LOOK = 4000  # poses that show which costs are worth looking for
_STREAM = 100  # of the plausible rotations' streams, and those after it


def plausible_stream(seed: int, index: int = 0) -> np.random.Generator:
    """Return a random stream of a plausible set, the same at every step of a session.

    index: 0 rotations of the grid, 1 members that are kept, from 2 on members around others, from
    200 on the search for modes.
    """
    return StreamKey(seed, 0).stream(Purpose.PLAUSIBLE_ROTATIONS, index)


@dataclass(frozen=True, eq=False)
class PoseGrid:
    """Poses: every rotation at every position. Pose n has rotation n // P and position n % P."""

    centre: FloatArray  # (3,), world
    offsets: Offsets  # of the positions from the centre
    rotations: FloatArray  # (R, 3, 3), world_from_object

    @cached_property
    def positions(self) -> FloatArray:
        """Positions (P, 3) in the world."""
        return self.centre + self.offsets.points()

    def poses(self, index: IntArray) -> FloatArray:
        """Return the poses (N, 4, 4), world_from_object, of these numbers (N,)."""
        rotation, position = np.divmod(index, len(self.positions))
        return compose(self.rotations[rotation], self.positions[position])

    def __len__(self) -> int:
        return len(self.positions) * len(self.rotations)


def grid_around(truth: FloatArray, settings: PoseGridSettings, *, seed: int) -> PoseGrid:
    """Return the grid of a definition around the true pose (4, 4), world_from_object.

    Its rotations are the same at every step of a session.
    """
    rotations = random_rotations(plausible_stream(seed), settings.rotations)
    if settings.extra != "none":
        replaced = settings.extra == "replaced"
        step = 2.0 * np.pi / max(settings.upright - replaced, 1)
        upward = np.broadcast_to([0.0, 0.0, 1.0], (settings.upright, 3))
        upright = axis_angle(upward, np.arange(float(settings.upright)) * step)
        true = truth[None, :3, :3]
        if replaced:
            parts = [upright, true, rotations[settings.upright + 1 :]]
        else:
            parts = [rotations, upright, true]
        rotations = np.concatenate(parts)
    return PoseGrid(truth[:3, 3], settings.offsets, rotations=rotations)


def scan_grid(cost: EvaluationCost, grid: PoseGrid, *, limit: float) -> tuple[IntArray, FloatArray]:
    """Return numbers and costs (G,) of all poses of a grid that cost less than a limit, ascending.

    Raises EvaluationError if there are more than MOST_MEMBERS.
    """
    return PoseScan(cost, grid, limit=limit).poses_below(0, len(grid.rotations))


class PoseScan:
    """A scan of a grid for the poses that cost less than a limit."""

    def __init__(self, cost: EvaluationCost, grid: PoseGrid, *, limit: float) -> None:
        points = cost.problem.points
        sdf = cost.problem.sdf
        order = _most_informative_first(points.known)
        margin = _ROUNDING * (limit * cost.model.divisors.known + np.abs(points.sdf).sum())
        groups = position_groups(grid)
        box = cost.model.field.box
        self._cost = cost
        self._scan = Scan(
            model=cost.model,
            groups=groups,
            around_groups=_bounds_around(sdf, cost.settings.lookup, groups.radius * box.inverse),
            around_poses=_bounds_around(sdf, cost.settings.lookup, 0.0),
            beyond=_beyond(sdf, cost.settings.outside),
            rotations=Poses.of(inverse(compose(grid.rotations, np.zeros(3)))).numbers,
            known=points.known[order].T.copy(),
            known_sdf=points.sdf[order],
            limit=limit,
            known_limit=limit * cost.model.divisors.known + margin,
        )

    def poses_below(self, first: int, last: int) -> tuple[IntArray, FloatArray]:
        """Return numbers and costs (G,) of the poses of these rotations, as scan_grid does."""
        scan = self._scan
        found: dict[int, list[tuple[IntArray, FloatArray]]] = {}
        total = [0]

        def run(start: int, stop: int, buffer: ScanBuffer) -> None:
            pieces = found[start] = []
            rotation = first + start
            while rotation < first + stop and total[0] <= MOST_MEMBERS:
                rotation, filled = scan_rotations(scan, rotation, first + stop, buffer)
                pieces.append((buffer.pose[:filled].copy(), buffer.cost[:filled].copy()))
                total[0] += filled

        make_buffer = partial(scan_buffer, scan)
        parallel_for(run, last - first, scratch=make_buffer, least=_ROTATIONS_PER_THREAD)
        pieces = [piece for start in sorted(found) for piece in found[start]]
        index = np.concatenate([piece[0] for piece in pieces])
        if len(index) > MOST_MEMBERS:
            self._raise_too_many()
        costs = np.concatenate([piece[1] for piece in pieces])
        ascending = np.argsort(index)
        return index[ascending], costs[ascending]

    def _raise_too_many(self) -> None:
        model = self._cost.model
        violation = model.violation / model.divisors.free
        raise EvaluationError(
            f"more than {MOST_MEMBERS:_} poses cost less than {self._scan.limit:.4g} with "
            f"{self._cost.problem.points.count} known points (a violated point: {violation:.4g}); "
            "accepted: more known points, a smaller epsilon or a larger cost.tolerance"
        )


def _most_informative_first(known: FloatArray) -> IntArray:
    """Return known points, each far from those before it, then at random: to reject poses early."""
    first = farthest_points(known, _MOST_INFORMATIVE)
    rest = np.argsort(
        uniforms(plausible_stream(0), 0.0, upper=1.0, shape=len(known)), kind="stable"
    )
    return np.concatenate([first, rest[~np.isin(rest, first)]])


def position_groups(grid: PoseGrid) -> PositionGroups:
    """Return the positions of a grid in groups of at most _LANES neighbours along all axes."""
    counts = [sum(piece[2] for piece in axis) for axis in grid.offsets.axes]
    of_axis = [np.arange(count) // side for count, side in zip(counts, _GROUP_SIDES, strict=True)]
    i, j, k = np.meshgrid(*of_axis, indexing="ij")
    group = (i * (1 + of_axis[1][-1]) + j) * (1 + of_axis[2][-1]) + k
    number = np.argsort(group.reshape(-1), kind="stable")
    first = np.concatenate([[0], np.cumsum(np.bincount(group.reshape(-1)))])
    positions = grid.positions[number]
    lowest = np.minimum.reduceat(positions, first[:-1])
    highest = np.maximum.reduceat(positions, first[:-1])
    radius = 0.5 * np.sqrt(((highest - lowest) ** 2).sum(axis=1)).max()
    return PositionGroups(
        centres=0.5 * (lowest + highest),
        radius=float(radius) * (1.0 + _ROUNDING),
        first=first,
        positions=positions,
        number=number,
    )


def _bounds_around(sdf: SdfGrid, lookup: str, nodes: float) -> FloatArray:
    """Return the least and the greatest distance (N, 2) read within so many nodes of each cell, m.

    N: the cells of the grid, each numbered by its lowest node.
    """
    reach = int(np.ceil(nodes + _ROUNDING)) if nodes else 0
    return sdf.derived(("scan", lookup, reach), lambda: _found_bounds(sdf, lookup, reach))


def _found_bounds(sdf: SdfGrid, lookup: str, reach: int) -> FloatArray:
    from scipy.ndimage import maximum_filter, minimum_filter

    least = greatest = sdf.values
    if lookup != "nearest":
        ends = np.pad(sdf.values, [(0, 1)] * 3, mode="edge")
        nx, ny, nz = sdf.shape
        corners = [ends[i : i + nx, j : j + ny, k : k + nz] for i, j, k in np.ndindex(2, 2, 2)]
        rounding = 1e-12 * (1.0 + np.abs(sdf.values).max())  # of interpolation
        least = np.minimum.reduce(corners) - rounding
        greatest = np.maximum.reduce(corners) + rounding
    if reach:
        side = 2 * reach + 1
        least = minimum_filter(least, side, mode="nearest")
        greatest = maximum_filter(greatest, side, mode="nearest")
    return np.stack([least, greatest], axis=-1).reshape(-1, 2)


def _beyond(sdf: SdfGrid, outside: str) -> tuple[float, float]:
    """Return weights of d^2 and s^2 in the least squared distance beyond the grid.

    d: to its box; s: what its nearest point reads. With gradients that point out of the box, the
    way to the surface is at least as long as both together; with others, it may be of any length.
    """
    ends = [(axis, end, sign) for axis in range(3) for end, sign in ((0, -1.0), (-1, 1.0))]
    faces = [sign * np.take(sdf.gradients[..., axis], end, axis=axis) for axis, end, sign in ends]
    outward = float(min(face.min() for face in faces) > _LEAST_OUTWARD)
    return (1.0, 0.0) if outside == "bounding_box" else (outward, outward)


class PositionGroups(NamedTuple):
    """Positions of a grid in groups of neighbours."""

    centres: FloatArray  # (G, 3), world
    radius: float  # metres, of a ball around each centre that holds the group
    first: IntArray  # (G + 1,) where each group begins among the positions, and their count
    positions: FloatArray  # (P, 3), world, group by group
    number: IntArray  # (P,) of each position on the grid


class Scan(NamedTuple):
    """Data of a scan of every rotation with every position."""

    model: EvaluationModel  # of the evaluation cost
    groups: PositionGroups  # all positions
    around_groups: FloatArray  # (N, 2), see _bounds_around, within a group's radius
    around_poses: FloatArray  # (N, 2), of the cell itself
    beyond: tuple[float, float]  # see _beyond
    rotations: FloatArray  # (R, 12), object_from_world, of poses at the origin
    known: FloatArray  # (3, M), world, the most informative first
    known_sdf: FloatArray  # (M,), m
    limit: float  # costs are below it
    known_limit: float  # more than the sum over known points of any such pose, m


class Lanes(NamedTuple):
    """Groups, or positions, that are looked at together with one rotation."""

    shifts: FloatArray  # (3, _LANES) translations of poses, m
    total: FloatArray  # (_LANES,) lower bounds of sums over known points, m
    beyond: FloatArray  # (_LANES,) distances to the box of the grid, m, squared
    depth: FloatArray  # (_LANES,) distances to the nearest face of that box, below 0 outside, m
    cell: Any  # (_LANES,) int32


class ScanBuffer(NamedTuple):
    """EvaluationScratch of one thread, and the poses below the limit that it collects."""

    cost_scratch: EvaluationScratch  # of the evaluation cost
    points: FloatArray  # (3, M) turned known points, m
    groups: Lanes  # that are looked at
    poses: Lanes  # of one group
    pose: IntArray  # (C,) numbers of poses
    cost: FloatArray  # (C,)


def scan_buffer(scan: Scan) -> ScanBuffer:
    """Return the buffer of one thread."""
    capacity = len(scan.groups.positions) + _CAPACITY
    return ScanBuffer(
        cost_scratch=scratch_for(scan.model),
        points=np.empty_like(scan.known),
        groups=_lanes(),
        poses=_lanes(),
        pose=np.empty(capacity, dtype=np.int64),
        cost=np.empty(capacity),
    )


def _lanes() -> Lanes:
    return Lanes(
        shifts=np.zeros((3, _LANES)),
        total=np.empty(_LANES),
        beyond=np.empty(_LANES),
        depth=np.empty(_LANES),
        cell=np.empty(_LANES, dtype=np.int32),
    )


@compiled
def scan_rotations(scan: Scan, first: int, last: int, buffer: ScanBuffer) -> tuple[int, int]:
    """Collect the poses below the limit, of rotations from `first` to before `last`.

    Returns the rotation to go on with, before `last` where the buffer may be too small, and the
    number of poses in the buffer.
    """
    known = scan.known
    points = buffer.points
    groups = scan.groups
    all_positions = len(groups.positions)
    all_groups = len(groups.centres)
    count = 0
    for n in range(first, last):
        if len(buffer.pose) - count < all_positions:
            return n, count
        rotation = pose_at(scan.rotations, n)
        for m in range(known.shape[1]):
            x, y, z = turned(rotation, known[0, m], known[1, m], known[2, m])
            points[0, m], points[1, m], points[2, m] = x, y, z
        for start in range(0, all_groups, _LANES):
            stop = min(start + _LANES, all_groups)
            _put(rotation, groups.centres, start, stop, buffer.groups)
            bounds = scan.around_groups
            if not _may_be_below(scan, bounds, groups.radius, points, buffer.groups, stop - start):
                continue
            for g in range(start, stop):
                if buffer.groups.total[g - start] <= scan.known_limit:
                    count = _scan_group(scan, n, rotation, g, buffer, count)
    return last, count


@inner
def _scan_group(
    scan: Scan, n: int, rotation: Pose, group: int, buffer: ScanBuffer, count: int
) -> int:
    """Collect the poses of the n-th rotation in a group; return how many are in the buffer now."""
    groups = scan.groups
    poses = buffer.poses
    shifts = poses.shifts
    first, last = groups.first[group], groups.first[group + 1]
    _put(rotation, groups.positions, first, last, poses)
    if not _may_be_below(scan, scan.around_poses, 0.0, buffer.points, poses, last - first):
        return count
    for i in range(last - first):
        if poses.total[i] <= scan.known_limit:
            pose = (*rotation[:9], shifts[0, i], shifts[1, i], shifts[2, i])
            cost = cost_below(scan.model, pose, scan.limit, buffer.cost_scratch)
            if cost < scan.limit:
                buffer.pose[count] = n * len(groups.positions) + groups.number[first + i]
                buffer.cost[count] = cost
                count += 1
    return count


@leaf
def _put(rotation: Pose, positions: FloatArray, first: int, last: int, lanes: Lanes) -> None:
    """Fill the lanes' translations, of poses with a rotation at positions (P, 3) from `first`."""
    shifts = lanes.shifts
    for i in range(last - first):
        at = first + i
        x, y, z = turned(rotation, positions[at, 0], positions[at, 1], positions[at, 2])
        shifts[0, i], shifts[1, i], shifts[2, i] = -x, -y, -z


@leaf
def _may_be_below(
    scan: Scan, bounds: FloatArray, radius: float, points: FloatArray, lanes: Lanes, count: int
) -> bool:
    """Fill the totals of lanes; False as soon as all of the first `count` are too high.

    points (3, M): turned. radius: metres around a lane's translation for which bounds (N, 2) hold.
    """
    total = lanes.total
    for i in range(_LANES):
        total[i] = 0.0 if i < count else np.inf
    for m in range(points.shape[1]):
        _add_bounds(scan, bounds, radius, points, m, lanes)
        left = 0
        for i in range(_LANES):
            left += 1 if total[i] <= scan.known_limit else 0
        if left == 0:
            return False
    return True


@leaf
def _add_bounds(
    scan: Scan, bounds: FloatArray, radius: float, points: FloatArray, m: int, lanes: Lanes
) -> None:
    """Add what the m-th known point costs at least within the radius of every lane."""
    box = scan.model.field.box
    beyond = lanes.beyond
    depth = lanes.depth
    cell = lanes.cell
    total = lanes.total
    first = box.first
    last = box.last
    most = box.most
    inverse = box.inverse
    x, y, z = points[0, m], points[1, m], points[2, m]
    us, vs, ws = lanes.shifts[0], lanes.shifts[1], lanes.shifts[2]
    for i in range(_LANES):
        a, b, c = x + us[i], y + vs[i], z + ws[i]
        d = min(max(first[0], a), last[0])
        e = min(max(first[1], b), last[1])
        f = min(max(first[2], c), last[2])
        beyond[i] = (a - d) * (a - d) + (b - e) * (b - e) + (c - f) * (c - f)
        depth[i] = min(
            min(min(a - first[0], last[0] - a), min(b - first[1], last[1] - b)),
            min(c - first[2], last[2] - c),
        )
        d = node_of((d - first[0]) * inverse, box.between, most[0])
        e = node_of((e - first[1]) * inverse, box.between, most[1])
        f = node_of((f - first[2]) * inverse, box.between, most[2])
        cell[i] = np.int32(d * box.across + e * box.along + f)
    value, weights = scan.known_sdf[m], scan.beyond
    for i in range(_LANES):
        at = np.uint64(cell[i])
        least, greatest = bounds[at, 0], bounds[at, 1]
        inside = max(least - value, value - greatest)
        least = max(least, 0.0)
        way = max(np.sqrt(beyond[i]) - radius, 0.0)
        outside = np.sqrt(weights[0] * (way * way) + weights[1] * (least * least)) - value
        # Within the radius of a lane near the boundary of the box are points on both sides.
        if depth[i] >= radius:
            bound = inside
        elif way > 0.0:
            bound = outside
        else:
            bound = min(inside, outside)
        total[i] += max(bound, 0.0)


@dataclass(frozen=True)
class TruePoseSettings(CheckedSettings):
    """The poses to look at around the guess.

    Each pass after the first looks around the best pose so far, with a reach of one spacing, and
    spacing and angle scaled alike.
    """

    reach: Annotated[float, positive] = 0.08  # along each axis, metres to either side of the guess
    spacing: Annotated[float, positive] = 0.01  # metres between positions
    rotations: Annotated[int, positive, at_most(MOST_ROTATIONS)] = 2000  # beside the guess's
    angle: Annotated[float, positive] = 0.02  # standard deviation of these rotations, radians
    passes: Annotated[int, positive, at_most(10)] = 2  # in all
    cost: EvaluationCostSettings = field(default_factory=EvaluationCostSettings)  # that is lowered


class TruePose(NamedTuple):
    """The pose of least evaluation cost near a guess."""

    world_from_object: FloatArray  # (4, 4)
    cost: float  # of this pose
    guess_cost: float  # of the guess


def find_true_pose(
    problem: RegistrationProblem, guess: FloatArray, *, settings: TruePoseSettings | None = None
) -> TruePose:
    """Return the pose of least evaluation cost near a guess, world_from_object (4, 4).

    problem: that of the last step, when most is known. The least of all poses looked at, exactly.
    So the authors made T* of real data from a pose set by hand; plausible sets are around it.
    """
    settings = settings or TruePoseSettings()
    guess = frozen("guess", guess, shape=(4, 4), error=PoseError)
    best = nearest_rigid("guess", guess[None])[0]
    cost = EvaluationCost(problem, settings.cost)
    least = guess_cost = cost.at(best)
    reach = settings.reach
    spacing = settings.spacing
    angle = settings.angle
    for n in range(settings.passes):
        half = round(reach / spacing)
        axis = ((-half * spacing, half * spacing, 2 * half + 1),)
        stream = problem.key.stream(Purpose.PLAUSIBLE_ROTATIONS, _STREAM + n)
        turns = rotation_vector(angle * normals(stream, (settings.rotations, 3)))
        rotations = np.concatenate([best[None, :3, :3], product(turns, best[:3, :3])])
        grid = PoseGrid(best[:3, 3], Offsets(axis, axis, z=axis), rotations=rotations)
        best, least = _best(cost, grid, best=best, least=least)
        reach, spacing, angle = spacing, spacing * spacing / reach, angle * spacing / reach
    return TruePose(best, least, guess_cost=guess_cost)


def _best(
    cost: EvaluationCost, grid: PoseGrid, *, best: FloatArray, least: float
) -> tuple[FloatArray, float]:
    """Return the cheapest pose of a grid and its cost; the best one before if none is cheaper."""
    look = np.arange(0, len(grid), max(1, len(grid) // _FIRST_LOOK))
    look_costs = cost.evaluate(inverse(grid.poses(look)))
    index, costs = scan_grid(cost, grid, limit=min(least, float(look_costs.min())))
    if len(index) == 0:  # none is cheaper than those
        index, costs = look, look_costs
    cheapest = int(np.argmin(costs))
    if not costs[cheapest] < least:
        return best, least
    return grid.poses(index[cheapest : cheapest + 1])[0], float(costs[cheapest])
