"""Poses that put points of the object's surface onto contacts, and the best of many such poses."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.cell_set import Box
from chsel.numerics.compiler import compiled, inner, leaf, spliced
from chsel.numerics.elementary import sine_cosine
from chsel.numerics.pose_tuples import decode, moved, origin_within, turned, turned_back

DRAWS = 8  # random numbers that a pose takes
_TURN = 2.0 * np.pi
_ALIKE = 1e-9  # squared lengths below which a vector has no direction


class Coarse(NamedTuple):
    """What poses are scored by: some known points, and points inside of the object."""

    box: Box  # of the signed distance grid
    values: Any  # (nodes,), read at the nearest node
    contacts: FloatArray  # (3, A), world
    known_sdf: FloatArray  # (A,)
    scale: float  # cost of a metre of distance
    reach: float  # metres beyond which a known point costs no more
    inside: FloatArray  # (3, P), object frame
    weights: FloatArray  # (P,), cost of each in free space
    voxels: Box  # of the free space
    flags: Any  # (voxels,), whether free


class Anchors(NamedTuple):
    """Contacts, and the points of the object's surface that can be put onto them.

    A span is the first index and the last + 1.
    """

    contacts: FloatArray  # (3, A), world
    values: FloatArray  # (A,), signed distances at the contacts
    surface: FloatArray  # (3, Q), object frame
    normals: FloatArray  # (3, Q)
    by_distance: IntArray  # (P, 2), pairs of surface points by their distance
    pairs: IntArray  # (C, 2), two contacts
    pair_spans: IntArray  # (C, 2), in by_distance, of the surface pairs as far apart
    singles: IntArray  # (S,), a contact
    single_spans: IntArray  # (S, 2), in by_height, of the surface points that can meet it
    by_height: IntArray  # (Q,), surface points in the order of their heights over a plane
    pair_share: float  # of all poses, those that are placed by pairs
    anchored_share: float  # those that are placed by pairs or single contacts
    lower: FloatArray  # (3,), where the object's origin may be in the world
    upper: FloatArray  # (3,)


class DrawnRows(NamedTuple):
    """Random numbers of some of the poses."""

    draws: Any  # (n, DRAWS), uniform
    before: int  # how many poses were drawn before


class Best(NamedTuple):
    """The best poses so far, a heap with the worst first, and scratch of one thread."""

    size: IntArray  # (1,), how many there are
    scores: FloatArray  # (K,)
    numbers: IntArray  # (K,), of each among all poses drawn
    poses: FloatArray  # (K, 12)
    vector: FloatArray  # (9,), scratch


def best_for(most: int) -> Best:
    """No poses yet, and room for `most`."""
    size, numbers = np.zeros(1, dtype=np.int64), np.empty(most, dtype=np.int64)
    return Best(size, np.empty(most), numbers, np.empty((most, 12)), np.zeros(9))


@compiled
def sample(coarse, space, anchors, rows, first, last, best):
    """Keep the best of the poses that rows from `first` to `last` make.

    Those of the lowest scores, and of equal ones the first, so that the result does not depend on
    how the rows are split.
    """
    most = len(best.scores)
    for n in range(first, last):
        pose, fits = _pose_of(space, anchors, rows.draws[n], best.vector)
        if fits:
            full, number = best.size[0] == most, rows.before + n
            limit = best.scores[0] if full else np.inf
            score = score_below(coarse, pose, limit)
            if score < limit or (full and score == limit and number < best.numbers[0]):
                _put(best, score, number, pose, full)


@inner
def score_below(coarse, pose, limit):
    """The score of a pose, lower for a better fit; infinite if it is above the limit."""
    box, contacts = coarse.box, coarse.contacts
    first, inverse = box.first, box.inverse
    x, y, z = pose[9], pose[10], pose[11]
    offset = (x - first[0]) * inverse, (y - first[1]) * inverse, (z - first[2]) * inverse
    scaled = pose[:9] + offset
    total = 0.0
    for n in range(contacts.shape[1]):
        p, q, r = contacts[0, n] * inverse, contacts[1, n] * inverse, contacts[2, n] * inverse
        u, v, w = moved(scaled, p, q, r)
        k, m, o = _clamped(box, u, v, w)
        away = (abs(u - k) + abs(v - m) + abs(w - o)) / inverse
        s = coarse.values[_nearest_node(box, k, m, o)]
        total += coarse.scale * min(abs(s + away - coarse.known_sdf[n]), coarse.reach)
        if not total <= limit:
            return np.inf
    inside, voxels = coarse.inside, coarse.voxels
    first, inverse = voxels.first, voxels.inverse
    for n in range(inside.shape[1]):
        u, v, w = turned_back(pose, inside[0, n] - x, inside[1, n] - y, inside[2, n] - z)
        u, v, w = (u - first[0]) * inverse, (v - first[1]) * inverse, (w - first[2]) * inverse
        k, m, o = _clamped(voxels, u, v, w)
        if coarse.flags[_nearest_node(voxels, k, m, o)]:
            total += coarse.weights[n]
            if not total <= limit:
                return np.inf
    return total


@leaf
def _clamped(box, u, v, w):
    """Grid coordinates within the grid."""
    most = box.most
    return min(max(0.0, u), most[0]), min(max(0.0, v), most[1]), min(max(0.0, w), most[2])


@leaf
def _nearest_node(box, u, v, w):
    """Flat index of the node nearest to grid coordinates within the grid."""
    return int(np.rint(u) * box.across + np.rint(v) * box.along + np.rint(w))


@inner
def _put(best, score, number, pose, full):
    """Add a pose, in place of the worst if there is no room."""
    scores, numbers = best.scores, best.numbers
    if full:
        count, at = len(scores), 0
        while True:  # down, past worse ones
            child = 2 * at + 1
            if child >= count:
                break
            if child + 1 < count and _precedes(
                scores[child], numbers[child], scores[child + 1], numbers[child + 1]
            ):
                child += 1
            if not _precedes(score, number, scores[child], numbers[child]):
                break
            _copy(best, child, at)
            at = child
    else:
        at = best.size[0]
        best.size[0] += 1
        while at > 0:
            parent = (at - 1) // 2
            if _precedes(score, number, scores[parent], numbers[parent]):
                break
            _copy(best, parent, at)
            at = parent
    scores[at], numbers[at] = score, number
    for i in range(12):
        best.poses[at, i] = pose[i]


@leaf
def _precedes(score, number, other, other_number):
    return score < other or (score == other and number < other_number)


@spliced
def _copy(best, source, target):
    best.scores[target], best.numbers[target] = best.scores[source], best.numbers[source]
    for i in range(12):
        best.poses[target, i] = best.poses[source, i]


@inner
def _pose_of(space, anchors, draw, vector):
    """The pose of a row of draws, and whether the object is where it may be."""
    kind = draw[0]
    if kind < anchors.pair_share and len(anchors.pairs) > 0:
        pose = _on_pair(anchors, draw)
    else:
        r = _random_rotation(space, draw, vector)
        if kind < anchors.anchored_share and len(anchors.singles) > 0:
            pose = _on_contact(anchors, draw, r)
        else:
            pose = _in_workspace(anchors, draw, r)
        if space.planar:
            pose = _on_plane(space, pose)
    return pose, origin_within(pose, anchors.lower, anchors.upper)


@leaf
def _random_rotation(space, draw, vector):
    """A rotation, uniform on SO(3) (Shoemake, 1992), or about the plane's axis."""
    if space.planar:
        vector[0], vector[1], vector[2] = _TURN * draw[5], 0.0, 0.0
        return decode(space, vector)[:9]
    s, c = sine_cosine(_TURN * draw[5])
    sine, cosine = sine_cosine(_TURN * draw[6])
    inner_root, outer_root = np.sqrt(1.0 - draw[7]), np.sqrt(1.0 * draw[7])
    return _rotation_of(inner_root * s, inner_root * c, outer_root * sine, outer_root * cosine)


@leaf
def _rotation_of(w, x, y, z):
    """The rotation of a unit quaternion, row by row."""
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@leaf
def _in_workspace(anchors, draw, r):
    """A pose with the object's origin p uniform in the box: t = -R p."""
    low, high = anchors.lower, anchors.upper
    x = low[0] + draw[1] * (high[0] - low[0])
    y = low[1] + draw[2] * (high[1] - low[1])
    z = low[2] + draw[3] * (high[2] - low[2])
    u, v, w = turned(r, x, y, z)
    translation = -u, -v, -w
    return r + translation


@leaf
def _on_contact(anchors, draw, r):
    """A pose that puts a surface point, or one at the known distance from it, onto a contact."""
    single = int(draw[1] * len(anchors.singles))
    contact = anchors.singles[single]
    first, last = anchors.single_spans[single, 0], anchors.single_spans[single, 1]
    q = anchors.by_height[first + int(draw[2] * (last - first))]
    away, (a, b, c) = anchors.values[contact], _column(anchors.normals, q)
    x, y, z = _column(anchors.surface, q)
    onto = x + away * a, y + away * b, z + away * c
    return _moving(r, _column(anchors.contacts, contact), onto)


@leaf
def _on_plane(space, pose):
    """The pose moved along the plane's axis onto the plane: a . t = o."""
    a, b, c = space.axis
    off = space.offset - (a * pose[9] + b * pose[10] + c * pose[11])
    translation = pose[9] + off * a, pose[10] + off * b, pose[11] + off * c
    return pose[:9] + translation


@leaf
def _on_pair(anchors, draw):
    """A pose that puts two surface points onto the line of two contacts, turned about it."""
    pair = int(draw[1] * len(anchors.pairs))
    first, last = anchors.pair_spans[pair, 0], anchors.pair_spans[pair, 1]
    at = first + int(draw[2] * (last - first))
    k, m = anchors.by_distance[at, 0], anchors.by_distance[at, 1]
    if draw[3] < 0.5:
        k, m = m, k
    start = _column(anchors.contacts, anchors.pairs[pair, 0])
    end = _column(anchors.contacts, anchors.pairs[pair, 1])
    surface_start, surface_end = _column(anchors.surface, k), _column(anchors.surface, m)
    sine, cosine = sine_cosine(_TURN * draw[4])
    f = _frame(start, end, 1.0, 0.0)
    g = _frame(surface_start, surface_end, cosine, sine)
    a, d, u = turned_back(g, f[0], f[3], f[6])  # R = G^T F, with frames as rows
    b, e, v = turned_back(g, f[1], f[4], f[7])
    c, h, w = turned_back(g, f[2], f[5], f[8])
    r = (a, b, c, d, e, h, u, v, w)
    return _moving(r, _middle(start, end), _middle(surface_start, surface_end))


@leaf
def _column(points, n):
    return points[0, n], points[1, n], points[2, n]


@leaf
def _middle(p, q):
    return 0.5 * (p[0] + q[0]), 0.5 * (p[1] + q[1]), 0.5 * (p[2] + q[2])


@leaf
def _moving(r, point, onto):
    """The pose with rotation R that moves a point p onto another: t = q - R p."""
    u, v, w = turned(r, point[0], point[1], point[2])
    translation = onto[0] - u, onto[1] - v, onto[2] - w
    return r + translation


@leaf
def _frame(start, end, cosine, sine):
    """Three orthonormal vectors, one after the other: from start to end, others turned about it."""
    x, y, z = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    length = np.sqrt(max(x * x + y * y + z * z, _ALIKE))
    x, y, z = x / length, y / length, z / length
    if abs(x) < 0.6:  # cross product with an axis that it is far from
        a, b, c = 0.0, -z, y
    else:
        a, b, c = z, 0.0, -x
    length = np.sqrt(max(a * a + b * b + c * c, _ALIKE))
    a, b, c = a / length, b / length, c / length
    d, e, f = y * c - z * b, z * a - x * c, x * b - y * a
    return (
        x, y, z,
        cosine * a + sine * d, cosine * b + sine * e, cosine * c + sine * f,
        cosine * d - sine * a, cosine * e - sine * b, cosine * f - sine * c,
    )  # fmt: skip
