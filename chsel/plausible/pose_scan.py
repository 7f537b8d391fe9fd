"""A grid of poses around the true one, and all its poses that cost less than a limit.

A block of positions is skipped if a lower bound of what the known points cost anywhere in it is
too high. Bounds allow for rounding, and every pose that remains gets its exact cost.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from chsel.errors import EvaluationError
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.compiler import compiled, leaf
from chsel.numerics.octree import Candidates, rounding_margin
from chsel.numerics.pose_tuples import turned
from chsel.numerics.threads import spread
from chsel.plausible.evaluation_cost import (
    EvaluationCost,
    EvaluationModel,
    cost_below,
    scratch_for,
)
from chsel.plausible.plausible_settings import Offsets, PoseGridSettings
from chsel.plausible.position_blocks import Blocks, DistanceBounds, blocks_of, bounds_of
from chsel.problem.poses import axis_angle, compose, random_rotations
from chsel.problem.streams import Purpose, StreamKey, uniforms
from chsel.problem.subset import farthest_points

MOST_MEMBERS = 2_000_000
_CAPACITY = 50_000  # poses that a thread finds before it hands them over, at least
_ROTATIONS_PER_THREAD = 200
_MOST_INFORMATIVE = 256  # known points that are put in order
_ROUNDING = 1e-9  # of a sum, that adding in another order may change


def plausible_stream(seed: int, index: int = 0) -> np.random.Generator:
    """A random stream of a plausible set, the same at every step of a session.

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
        """The poses (N, 4, 4), world_from_object, of these numbers (N,)."""
        rotation, position = np.divmod(index, len(self.positions))
        return compose(self.rotations[rotation], self.positions[position])

    def __len__(self) -> int:
        return len(self.positions) * len(self.rotations)


def grid_around(truth: FloatArray, settings: PoseGridSettings, seed: int) -> PoseGrid:
    """The grid of a definition around the true pose (4, 4), world_from_object.

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
    return PoseGrid(truth[:3, 3], settings.offsets, rotations)


def scan_grid(cost: EvaluationCost, grid: PoseGrid, limit: float) -> tuple[IntArray, FloatArray]:
    """Numbers and costs (G,) of all poses of a grid that cost less than a limit, ascending.

    Raises EvaluationError if there are more than MOST_MEMBERS.
    """
    points, settings = cost.problem.points, cost.settings
    margin = rounding_margin(
        np.concatenate([grid.positions.reshape(-1), points.all_points().reshape(-1)])
    )
    blocks = _blocks(grid.offsets, margin)
    order = _most_informative_first(points.known)
    known_limit = limit * cost.model.divisors.known * (1.0 + _ROUNDING)
    scan = Scan(
        model=cost.model,
        blocks=blocks._replace(centres=blocks.centres + grid.centre[:, None]),
        bounds=bounds_of(cost.problem.sdf, settings.lookup, settings.outside, blocks.radii),
        rotations=np.swapaxes(grid.rotations, 1, 2).reshape(-1, 9),
        positions=grid.positions,
        known=points.known[order].T.copy(),
        known_sdf=points.sdf[order],
        limit=limit,
        known_limit=known_limit + 10.0 * margin * len(order),
    )
    parts: dict[int, list[tuple[IntArray, FloatArray]]] = {}
    total = [0]

    def run(first: int, last: int, buffer: ScanBuffer) -> None:
        pieces = parts[first] = []
        while first < last and total[0] <= MOST_MEMBERS:
            first, count = scan_rotations(scan, first, last, buffer)
            pieces.append((buffer.pose[:count].copy(), buffer.cost[:count].copy()))
            total[0] += count

    def make_buffer() -> ScanBuffer:
        capacity = len(grid.positions) + _CAPACITY
        return ScanBuffer(
            cost_scratch=scratch_for(cost.model),
            turned=np.empty((3, len(order))),
            stack=np.empty(len(blocks.layer), dtype=np.int64),
            pose=np.empty(capacity, dtype=np.int64),
            cost=np.empty(capacity),
        )

    spread(run, len(grid.rotations), make_buffer, least=_ROTATIONS_PER_THREAD)
    pieces = [piece for first in sorted(parts) for piece in parts[first]]
    index = np.concatenate([piece[0] for piece in pieces])
    if len(index) > MOST_MEMBERS:
        raise EvaluationError(_too_many(cost, limit))
    ascending = np.argsort(index, kind="stable")
    return index[ascending], np.concatenate([piece[1] for piece in pieces])[ascending]


def _too_many(cost: EvaluationCost, limit: float) -> str:
    count, violation = cost.problem.points.count, cost.model.violation / cost.model.divisors.free
    text = f"more than {MOST_MEMBERS:_} poses cost less than {limit:.4g} with {count} known points"
    if limit >= violation:
        text += f", as the true pose costs that much itself (a violated point: {violation:.4g})"
    return text + "; accepted: more known points, a smaller epsilon or a larger cost.tolerance"


@lru_cache(maxsize=8)
def _blocks(offsets: Offsets, margin: float) -> Blocks:
    return blocks_of(offsets.points(), margin)


def _most_informative_first(known: FloatArray) -> IntArray:
    """Known points, each far from those before it, then at random: to reject poses early."""
    first = farthest_points(known, _MOST_INFORMATIVE)
    rest = np.argsort(uniforms(plausible_stream(0), 0.0, 1.0, len(known)), kind="stable")
    return np.concatenate([first, rest[~np.isin(rest, first)]])


class Scan(NamedTuple):
    """All that a scan reads: every rotation with every position."""

    model: EvaluationModel
    blocks: Blocks  # of the positions, with centres in the world
    bounds: DistanceBounds
    rotations: FloatArray  # (R, 9), object_from_world
    positions: FloatArray  # (P, 3), world
    known: FloatArray  # (3, M), world, the most informative first
    known_sdf: FloatArray  # (M,), m
    limit: float  # costs are below it
    known_limit: float  # more than the sum over known points of any such pose, rounding included


class ScanBuffer(NamedTuple):
    """Scratch of one thread, and the poses below the limit that it collects."""

    cost_scratch: Candidates
    turned: FloatArray  # (3, M)
    stack: IntArray  # (N,) of blocks
    pose: IntArray  # (C,) their numbers
    cost: FloatArray  # (C,)


@compiled
def scan_rotations(scan: Scan, first: int, last: int, buffer: ScanBuffer) -> tuple[int, int]:
    """Collect the poses below the limit, of rotations from `first` to before `last`.

    Returns the rotation to go on with, which is less than `last` where the buffer may be too small
    for it, and the number of poses in the buffer.
    """
    positions, blocks, known = scan.positions, scan.blocks, scan.known
    centres, stack, count = blocks.centres, buffer.stack, 0
    for n in range(first, last):
        if len(buffer.pose) - count < len(positions):
            return n, count
        rotation = _rotation_at(scan.rotations, n)
        for m in range(known.shape[1]):
            x, y, z = turned(rotation, known[0, m], known[1, m], known[2, m])
            buffer.turned[0, m], buffer.turned[1, m], buffer.turned[2, m] = x, y, z
        height = blocks.tops
        for node in range(height):
            stack[node] = node
        while height > 0:
            height -= 1
            node = stack[height]
            x, y, z = turned(rotation, centres[0, node], centres[1, node], centres[2, node])
            if not _may_hold(scan, blocks.layer[node], buffer.turned, x, y, z):
                continue
            position = blocks.position[node]
            if position < 0:
                for child in range(blocks.starts[node], blocks.starts[node + 1]):
                    stack[height] = child
                    height += 1
            else:
                x, y, z = positions[position]
                x, y, z = turned(rotation, x, y, z)
                a, b, c, d, e, f, g, h, i = rotation
                pose = (a, b, c, d, e, f, g, h, i, -x, -y, -z)
                cost = cost_below(scan.model, pose, scan.limit, buffer.cost_scratch)
                if cost < scan.limit:
                    buffer.pose[count] = n * len(positions) + position
                    buffer.cost[count] = cost
                    count += 1
    return last, count


@leaf
def _rotation_at(rotations: FloatArray, n: int) -> Any:
    """Row n of rotations (R, 9)."""
    a, b, c, d = rotations[n, 0], rotations[n, 1], rotations[n, 2], rotations[n, 3]
    e, f, g, h = rotations[n, 4], rotations[n, 5], rotations[n, 6], rotations[n, 7]
    return a, b, c, d, e, f, g, h, rotations[n, 8]


@leaf
def _may_hold(
    scan: Scan, layer: int, rotated_points: FloatArray, x: float, y: float, z: float
) -> bool:
    """Whether a block with its centre at x, y, z, turned, can hold a pose below the limit."""
    bounds = scan.bounds.layers[layer]
    table, reach, inverse, low = scan.bounds.table, scan.bounds.reach, bounds.inverse, bounds.low
    high_x, high_y, high_z = bounds.high_x, bounds.high_y, bounds.high_z
    most_x, most_y, most_z = bounds.most_x, bounds.most_y, bounds.most_z
    across, along, row = bounds.across, bounds.along, bounds.row
    radius, unsure, total = bounds.radius, bounds.unsure, 0.0
    x, y, z = x + bounds.corner_x, y + bounds.corner_y, z + bounds.corner_z
    for m in range(rotated_points.shape[1]):
        u = (rotated_points[0, m] - x) * inverse
        v = (rotated_points[1, m] - y) * inverse
        w = (rotated_points[2, m] - z) * inverse
        p, q, r = min(max(u, low), high_x), min(max(v, low), high_y), min(max(w, low), high_z)
        cell = min(np.floor(p), most_x) * across + min(np.floor(q), most_y) * along
        at = int(row + cell + min(np.floor(r), most_z))
        least, most = float(table[at, 0]), float(table[at, 1])
        if unsure > 0.0 and (
            (abs(u - np.rint(u)) < unsure and u == p)
            or (abs(v - np.rint(v)) < unsure and v == q)
            or (abs(w - np.rint(w)) < unsure and w == r)
        ):
            continue
        squared = (u - p) * (u - p) + (v - q) * (v - q) + (w - r) * (w - r)
        if squared > 0.0:
            away = np.sqrt(squared) / inverse - radius
            if away > 0.0:  # all of the block is beyond the grid
                least = max(least, 0.0)
                least = np.sqrt(reach * away * away + least * least)
                most = np.inf
        value = scan.known_sdf[m]
        # Where `most` is positive, the block may reach beyond the grid, where it does not hold.
        below = value - most if most < 0.0 else 0.0
        total += max(max(least - value, below), 0.0)
        if total > scan.known_limit:
            return False
    return True
