"""Where a hand that moves straight ahead first meets an object, in many poses of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from chsel.next_probe.decision_problem import Actions, Belief
from chsel.next_probe.hand_shape import HandShape
from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import compiled, inner
from chsel.numerics.threads import spread
from chsel.problem.poses import Poses
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.surface import surface_points

POINTS = 1200  # on the object's surface
_CELL = 0.005  # metres: of two points that a hand sees in one cell, the nearer counts
_MOST_CELLS = 400  # along a side of what a hand sees: cells of an object above 2 m are larger


class FirstContacts(NamedTuple):
    """Outcomes of A actions in K poses."""

    travel: FloatArray  # (K, A): way to the first contact, metres; inf where there is none
    contact: FloatArray  # (K, A, 3): that place on the object, world frame; 0 where there is none


class Moves(NamedTuple):
    """Actions of one orientation of the hand."""

    rotation: FloatArray  # (9,): hand_from_world, row by row
    starts: FloatArray  # (A', 3): the hand's position in axes of the hand, metres
    length: FloatArray  # (A',)
    which: Any  # (A',): their indices among all actions


class _View(NamedTuple):
    """Scratch: what of an object a hand sees that moves towards it, nearest points by rows of x."""

    nearest: Any  # (G, G): index of the point seen in a cell, -1 for none
    seen: FloatArray  # (N, 3): points in axes of the hand, as they are computed
    rows: Any  # (G + 1,): where the points of each row begin in `order`
    order: Any  # (N,): indices of the points that are seen, row by row


def first_contacts(
    sdf: SdfGrid, belief: Belief, actions: Actions, hand: HandShape
) -> FirstContacts:
    """Follow every action in every pose to the first contact of the hand's front.

    The object is points of its surface, some millimetres apart, and where the hand starts beyond
    one of them, the way to the first contact is negative: it would have met it on its way to the
    start. Longer ways than an action's are inf.
    """
    points = touched_points(sdf)
    poses = np.array(Poses.of(belief.object_from_world).numbers)
    count, front = len(poses), hand.front
    travel = np.full((count, len(actions)), np.inf)
    contact = np.zeros((count, len(actions), 3))
    width = 2.0 * _radius(points)
    cell = max(_CELL, width / _MOST_CELLS)
    size = int(width / cell) + 3
    groups = list(moves_by_orientation(actions))

    def scratch() -> _View:
        return _View(
            np.empty((size, size), dtype=np.int64),
            np.empty((len(points), 3)),
            np.empty(size + 1, dtype=np.int64),
            np.empty(len(points), dtype=np.int64),
        )

    def run(first: int, last: int, view: _View) -> None:
        for moves in groups:
            meet(points, poses, moves, front, view, cell, (travel, contact), (first, last))

    spread(run, count, scratch, least=10)
    return FirstContacts(travel, contact)


def touched_points(sdf: SdfGrid) -> FloatArray:
    """Points (N, 3) on the object's surface, in its frame, that a hand can touch."""
    stream = StreamKey(0, 0).stream(Purpose.MESH_SAMPLES)
    return sdf.derived("touched", lambda: surface_points(sdf, POINTS, stream))


def _radius(points: FloatArray) -> float:
    """The largest distance of points (N, 3) from the middle of their bounds, metres."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return float(np.sqrt(((points - middle) ** 2).sum(axis=1).max()))


def moves_by_orientation(actions: Actions) -> Iterator[Moves]:
    """The actions by the orientation of the hand, in the order of their first ones."""
    rotations = actions.world_from_hand[:, :3, :3]
    left = np.ones(len(actions), dtype=bool)
    while left.any():
        first = int(np.argmax(left))
        same = left & (rotations == rotations[first]).all(axis=(1, 2))
        which = np.flatnonzero(same)
        left &= ~same
        turn = rotations[first].T
        position = actions.world_from_hand[which, :3, 3]
        starts = position[:, 0, None] * turn[:, 0]
        starts = starts + position[:, 1, None] * turn[:, 1] + position[:, 2, None] * turn[:, 2]
        yield Moves(np.ascontiguousarray(turn).reshape(-1), starts, actions.length[which], which)


@compiled
def meet(
    points: Any, poses: Any, moves: Any, front: Any, view: Any, cell: Any, out: Any, some: Any
) -> None:
    """Fill the rows of some poses (first, last) in `out`, travel and contact of FirstContacts."""
    travel, contact = out
    heights, hx, hy, side = front.heights, front.lower[0], front.lower[1], front.cell
    nx, ny = heights.shape
    seen = view.seen
    for k in range(some[0], some[1]):
        lower = _look(points, poses[k], moves.rotation, view, cell)
        rows = len(view.rows) - 1
        for a in range(len(moves.which)):
            x, y, z = moves.starts[a, 0] + hx, moves.starts[a, 1] + hy, moves.starts[a, 2]
            first = int(min(max((x - lower) / cell, 0.0), rows + 0.0))
            last = int(min(max((x + nx * side - lower) / cell + 1.0, 0.0), rows + 0.0))
            least, met = np.inf, -1
            for n in range(view.rows[first], view.rows[last]):
                p = view.order[n]
                i, j = (seen[p, 0] - x) / side, (seen[p, 1] - y) / side
                if i >= 0.0 and i < nx and j >= 0.0 and j < ny:
                    way = seen[p, 2] - z - heights[int(i), int(j)]
                    if way < least:
                        least, met = way, p
            if least <= moves.length[a]:
                column = moves.which[a]
                travel[k, column] = least
                for axis in range(3):
                    r = moves.rotation
                    contact[k, column, axis] = (
                        r[axis] * seen[met, 0] + r[3 + axis] * seen[met, 1]
                    ) + r[6 + axis] * seen[met, 2]


@inner
def _look(points: Any, pose: Any, turn: Any, view: Any, cell: Any) -> Any:
    """Turn the object into the axes of the hand, and order what is seen of it by rows of x.

    Returns the x of the first row's edge.
    """
    seen, nearest = view.seen, view.nearest
    size = len(nearest)
    low_x, low_y = np.inf, np.inf
    for n in range(len(points)):
        p, q, r = points[n, 0] - pose[9], points[n, 1] - pose[10], points[n, 2] - pose[11]
        x = pose[0] * p + pose[3] * q + pose[6] * r
        y = pose[1] * p + pose[4] * q + pose[7] * r
        z = pose[2] * p + pose[5] * q + pose[8] * r
        seen[n, 0] = turn[0] * x + turn[1] * y + turn[2] * z
        seen[n, 1] = turn[3] * x + turn[4] * y + turn[5] * z
        seen[n, 2] = turn[6] * x + turn[7] * y + turn[8] * z
        low_x, low_y = min(low_x, seen[n, 0]), min(low_y, seen[n, 1])
    for i in range(size):
        for j in range(size):
            nearest[i, j] = -1
    for n in range(len(points)):
        i = min(int((seen[n, 0] - low_x) / cell), size - 1)
        j = min(int((seen[n, 1] - low_y) / cell), size - 1)
        before = nearest[i, j]
        if before < 0 or seen[n, 2] < seen[before, 2]:
            nearest[i, j] = n
    count = 0
    for i in range(size):
        view.rows[i] = count
        for j in range(size):
            if nearest[i, j] >= 0:
                view.order[count] = nearest[i, j]
                count += 1
    view.rows[size] = count
    return low_x
