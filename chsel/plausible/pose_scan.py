"""A grid of poses around the true one, and all its poses that cost less than a limit.

A block of positions is skipped if a lower bound of what the known points cost anywhere in it is
too high. Bounds allow for rounding, and every pose that remains gets its exact cost.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import numpy as np

from chsel.errors import EvaluationError
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.octree import rounding_margin
from chsel.numerics.threads import spread
from chsel.plausible.evaluation_cost import EvaluationCost
from chsel.plausible.plausible_settings import Offsets, PoseGridSettings
from chsel.plausible.position_blocks import Blocks, blocks_of, bounds_of
from chsel.plausible.scan_kernels import Scan, ScanBuffer, scan_buffer, scan_rotations
from chsel.problem.poses import axis_angle, compose, random_rotations
from chsel.problem.streams import Purpose, StreamKey, uniforms
from chsel.problem.subset import farthest_points

MOST_MEMBERS = 2_000_000
_CAPACITY = 50_000  # poses that a thread finds before it hands them over, at least
_ROTATIONS_PER_THREAD = 200
_MOST_INFORMATIVE = 256  # known points that are put in order
_ROUNDING = 1e-6  # more than a few numbers of 32 bits are rounded by, of the greatest
_SLACK = 1e-3  # cells of the SDF grid that rounding may move a point


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
    known, values = points.known[order] - grid.centre, points.sdf[order]
    sdf, slack = cost.problem.sdf, _SLACK
    parts = known, blocks.centres, sdf.bounds
    farthest = max(float(np.abs(part).max(initial=0.0)) for part in parts)
    while slack * sdf.resolution < _ROUNDING * farthest:
        slack *= 2.0
    known_limit = limit * cost.model.divisors.known + 10.0 * margin * len(order)
    rounding = len(order) * _ROUNDING
    scan = Scan(
        model=cost.model,
        blocks=blocks,
        bounds=bounds_of(
            sdf,
            settings.lookup,
            settings.outside,
            blocks.radii,
            value=float(values[0]) if (values == values[:1]).all() and len(order) else None,
            slack=slack,
        ),
        rotations=np.swapaxes(grid.rotations, 1, 2).reshape(-1, 9),
        positions=grid.positions,
        known=known.T.copy(),
        known_sdf=values.astype(np.float32),
        limit=limit,
        known_limit=np.float32(
            known_limit * (1.0 + rounding) + rounding * np.abs(values).max(initial=0.0)
        ),
    )
    found: dict[int, list[tuple[IntArray, FloatArray]]] = {}
    total = [0]

    def run(first: int, last: int, buffer: ScanBuffer) -> None:
        pieces = found[first] = []
        while first < last and total[0] <= MOST_MEMBERS:
            first, count = scan_rotations(scan, first, last, buffer)
            pieces.append((buffer.pose[:count].copy(), buffer.cost[:count].copy()))
            total[0] += count

    capacity = len(grid.positions) + _CAPACITY
    make_buffer = partial(scan_buffer, scan, capacity)
    spread(run, len(grid.rotations), make_buffer, least=_ROTATIONS_PER_THREAD)
    pieces = [piece for first in sorted(found) for piece in found[first]]
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
