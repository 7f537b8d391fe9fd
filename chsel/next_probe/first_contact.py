"""First contacts of a hand that moves straight ahead with an object in many poses."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from chsel.next_probe.decision_problem import Actions, HandShape, WeightedPoses
from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.pose_tuples import pose_at, turned, turned_back
from chsel.numerics.threads import parallel_for
from chsel.problem.poses import Poses, rotated
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.sdf_lookup import distance_field, distance_with_gradient
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.subset import farthest_points
from chsel.problem.surface import surface_points

POINTS = 800  # on the object's surface, evenly spread, among which a first contact is sought
_FINE_POINTS = 20_000  # on it as well, of which those around the best of the others decide
_CANDIDATES = 5000  # of these, from which the others are taken
_CELL = 0.005  # metres: of two points that a hand sees in one cell, the nearer counts
_SHORTEST = 1e-12  # the least length that gradients are divided by
_MOST_CELLS = 60  # along a side of what a hand sees: of a larger object cells are larger


class FirstContacts(NamedTuple):
    """Outcomes of A actions in K poses."""

    travel: FloatArray  # (K, A): way to the first contact, metres; inf where there is none
    contact: FloatArray  # (K, A, 3): that place on the object, world frame; 0 where there is none


class ContactNormals(NamedTuple):
    """Normals of the object at its first contacts, by A actions in K poses."""

    normals: FloatArray  # (K, A, 3): unit vectors out of it, world frame; 0 where there is none
    variances: FloatArray  # (K, A): of measured normals about each of two axes, radians^2


class TouchedPoints(NamedTuple):
    """Points on an object's surface, in its frame, metres."""

    points: FloatArray  # (N, 3)
    fine: FloatArray  # (F, 3): many more, by which of `points` is the nearest
    first: Any  # (N + 1,): where the fine points of each begin


class Moves(NamedTuple):
    """Actions of one orientation of the hand."""

    rotation: FloatArray  # (9,): hand_from_world, row by row
    starts: FloatArray  # (A', 3): the hand's position in axes of the hand, metres
    length: FloatArray  # (A',)
    which: Any  # (A',): their indices among all actions


class _View(NamedTuple):
    """Scratch: what of an object a hand sees that moves towards it, nearest points by cells."""

    nearest: Any  # (G, G): index of the point seen in a cell, -1 for none
    seen: FloatArray  # (N, 3): points in axes of the hand, as they are computed
    begin: Any  # (G, G + 1): where the points of each cell begin in `order`
    order: Any  # (N,): indices of the points that are seen, by rows of x, then by y


def first_contacts(
    sdf: SdfGrid, belief: WeightedPoses, *, actions: Actions, hand: HandShape
) -> FirstContacts:
    """Follow every action in every pose to the first contact of the hand's front.

    The object is points of its surface: some, then the many around those three of them that the
    hand meets first. Where it starts beyond a point, the way to it is negative: it would have met
    it on its way to the start. Longer ways than an action's are inf.
    """
    surface = touched_points(sdf)
    points = surface.points
    poses = np.array(Poses.of(belief.object_from_world).numbers)
    count = len(poses)
    front = hand.front
    travel = np.full((count, len(actions)), np.inf)
    contact = np.zeros((count, len(actions), 3))
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    width = 2.0 * float(np.sqrt(((points - middle) ** 2).sum(axis=1).max()))
    cell = max(_CELL, width / _MOST_CELLS)
    size = int(width / cell) + 3
    groups = list(moves_by_orientation(actions))

    def scratch() -> _View:
        nearest = np.empty((size, size), np.int64)
        begin = np.empty((size, size + 1), np.int64)
        return _View(
            nearest, np.empty(points.shape), begin=begin, order=np.empty(len(points), np.int64)
        )

    def run(first: int, last: int, view: _View) -> None:
        for moves in groups:
            meet(surface, poses, moves, front, view, cell, (travel, contact), (first, last))

    parallel_for(run, count, scratch=scratch, least=10)
    return FirstContacts(travel, contact)


def contact_normals(
    sdf: SdfGrid, belief: WeightedPoses, *, first: FirstContacts, variance: float
) -> ContactNormals:
    """Return the normals at first contacts: directions of the gradient of the signed distance.

    variance: of a normal that is measured on a flat face, about each of two axes, radians^2. Where
    gradients cancel, as around an edge, the variance is larger by 1 less the gradient's length.
    """
    field = distance_field(sdf, "trilinear", outside="surface_point")
    poses = np.array(Poses.of(belief.object_from_world).numbers)
    found = ContactNormals(np.zeros(first.contact.shape), np.full(first.travel.shape, variance))

    def run(begin: int, end: int, _: Any) -> None:
        find_normals(field, poses, first, found, begin, end)

    parallel_for(run, len(poses), scratch=lambda: None, least=50)
    return found


def touched_points(sdf: SdfGrid) -> TouchedPoints:
    """Return points on the object's surface that a hand can touch."""

    def make() -> TouchedPoints:
        stream = StreamKey(0, 0).stream(Purpose.MESH_SAMPLES)
        fine = surface_points(sdf, _FINE_POINTS, stream=stream)
        points = fine[farthest_points(fine[:_CANDIDATES], POINTS)]
        owner = np.empty(len(fine), dtype=np.int64)
        find_nearest(points, fine, owner)
        order = np.argsort(owner, kind="stable")
        first = np.searchsorted(owner[order], np.arange(len(points) + 1))
        return TouchedPoints(points, np.ascontiguousarray(fine[order]), first=first)

    return sdf.derived("touched", make)


def moves_by_orientation(actions: Actions) -> Iterator[Moves]:
    """Yield the actions by the orientation of the hand, in the order of their first ones."""
    rotations = actions.world_from_hand[:, :3, :3]
    left = np.ones(len(actions), dtype=bool)
    while left.any():
        first = int(np.argmax(left))
        same = left & (rotations == rotations[first]).all(axis=(1, 2))
        which = np.flatnonzero(same)
        left &= ~same
        turn = np.ascontiguousarray(rotations[first].T)
        starts = rotated(turn, actions.world_from_hand[which, :3, 3])
        yield Moves(turn.reshape(-1), starts, length=actions.length[which], which=which)


@compiled
def find_nearest(points: Any, others: Any, nearest: Any) -> None:
    """Fill nearest (F,) with the index of the nearest of points (N, 3) to each of others (F, 3)."""
    for f in range(len(others)):
        least = np.inf
        for n in range(len(points)):
            x, y = points[n, 0] - others[f, 0], points[n, 1] - others[f, 1]
            z = points[n, 2] - others[f, 2]
            squared = x * x + y * y + z * z
            if squared < least:
                least, nearest[f] = squared, n


@compiled
def find_normals(field: Any, poses: Any, first: Any, found: Any, begin: Any, end: Any) -> None:
    """Fill the rows of some poses (begin, end) in `found`, whose variances are of flat faces."""
    for k in range(begin, end):
        pose = pose_at(poses, k)
        for a in range(first.travel.shape[1]):
            if first.travel[k, a] == np.inf:
                continue
            x, y, z = first.contact[k, a, 0], first.contact[k, a, 1], first.contact[k, a, 2]
            _, u, v, w = distance_with_gradient(field, pose, x, y, z)
            length = np.sqrt(u * u + v * v + w * w)
            found.variances[k, a] += max(1.0 - length, 0.0)
            x, y, z = turned_back(pose, u, v, w)
            per_length = 1.0 / max(length, _SHORTEST)
            found.normals[k, a, 0] = per_length * x
            found.normals[k, a, 1] = per_length * y
            found.normals[k, a, 2] = per_length * z


@compiled
def meet(
    surface: Any, poses: Any, moves: Any, front: Any, view: Any, cell: Any, out: Any, some: Any
) -> None:
    """Fill the rows of some poses (first, last) in `out`, travel and contact of FirstContacts."""
    travel, contact = out
    heights = front.heights
    hx = front.lower[0]
    hy = front.lower[1]
    side = front.cell
    nx, ny = heights.shape
    seen = view.seen
    turn = moves.rotation
    fine = surface.fine
    width_x = nx * side
    width_y = ny * side
    per_side = 1.0 / side
    per_cell = 1.0 / cell
    best = np.empty(3, dtype=np.int64)
    for k in range(some[0], some[1]):
        hand_from_object = _hand_from_object(turn, poses[k])
        low_x, low_y = _look(surface.points, hand_from_object, view, cell)
        size = len(view.nearest)
        for a in range(len(moves.which)):
            x, y, z = moves.starts[a, 0] + hx, moves.starts[a, 1] + hy, moves.starts[a, 2]
            first = int(min(max((x - low_x) * per_cell, 0.0), size + 0.0))
            last = int(min(max((x + width_x - low_x) * per_cell + 1.0, 0.0), size + 0.0))
            left = int(min(max((y - low_y) * per_cell, 0.0), size + 0.0))
            right = int(min(max((y + width_y - low_y) * per_cell + 1.0, 0.0), size + 0.0))
            least = np.inf
            second = np.inf
            third = np.inf
            best[:] = -1
            for row in range(first, last):
                for n in range(view.begin[row, left], view.begin[row, right]):
                    p = view.order[n]
                    i, j = (seen[p, 0] - x) * per_side, (seen[p, 1] - y) * per_side
                    if i >= 0.0 and i < nx and j >= 0.0 and j < ny:
                        way = seen[p, 2] - z - heights[int(i), int(j)]
                        if way < least:
                            least, second, third = way, least, second
                            best[2], best[1], best[0] = best[1], best[0], p
                        elif way < second:
                            second, third = way, second
                            best[2], best[1] = best[1], p
                        elif way < third:
                            third, best[2] = way, p
            if best[0] < 0:
                continue
            point = (seen[best[0], 0], seen[best[0], 1], seen[best[0], 2])
            for b in range(3):
                if best[b] < 0:
                    break
                for n in range(surface.first[best[b]], surface.first[best[b] + 1]):
                    u, v, w = _turned(hand_from_object, fine[n, 0], fine[n, 1], fine[n, 2])
                    i, j = (u - x) * per_side, (v - y) * per_side
                    if i >= 0.0 and i < nx and j >= 0.0 and j < ny:
                        way = w - z - heights[int(i), int(j)]
                        if way < least:
                            least, point = way, (u, v, w)
            if least <= moves.length[a]:
                column = moves.which[a]
                travel[k, column] = least
                x, y, z = turned_back(turn, point[0], point[1], point[2])
                contact[k, column, 0], contact[k, column, 1], contact[k, column, 2] = x, y, z


@leaf
def _hand_from_object(turn: Any, pose: Any) -> Any:
    """Return the rotation into axes of the hand, then the translation of a pose (12,)."""
    a, d, g = turned(turn, pose[0], pose[1], pose[2])
    b, e, h = turned(turn, pose[3], pose[4], pose[5])
    c, f, i = turned(turn, pose[6], pose[7], pose[8])
    return a, b, c, d, e, f, g, h, i, pose[9], pose[10], pose[11]


@leaf
def _turned(pose: Any, x: Any, y: Any, z: Any) -> Any:
    """Return a point of the object in axes of the hand."""
    return turned(pose, x - pose[9], y - pose[10], z - pose[11])


@inner
def _look(points: Any, hand_from_object: Any, view: Any, cell: Any) -> Any:
    """Order the object's points that the hand sees by cells; return the first cell's corner."""
    seen, nearest = view.seen, view.nearest
    size, per_cell = len(nearest), 1.0 / cell
    low_x, low_y = np.inf, np.inf
    for n in range(len(points)):
        x, y, z = _turned(hand_from_object, points[n, 0], points[n, 1], points[n, 2])
        seen[n, 0], seen[n, 1], seen[n, 2] = x, y, z
        low_x, low_y = min(low_x, x), min(low_y, y)
    for i in range(size):
        for j in range(size):
            nearest[i, j] = -1
    for n in range(len(points)):
        i = min(int((seen[n, 0] - low_x) * per_cell), size - 1)
        j = min(int((seen[n, 1] - low_y) * per_cell), size - 1)
        before = nearest[i, j]
        if before < 0 or seen[n, 2] < seen[before, 2]:
            nearest[i, j] = n
    count = 0
    for i in range(size):
        for j in range(size):
            view.begin[i, j] = count
            if nearest[i, j] >= 0:
                view.order[count] = nearest[i, j]
                count += 1
        view.begin[i, size] = count
    return low_x, low_y
