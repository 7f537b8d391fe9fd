"""Poses that put points of the object's surface onto contacts, and the best of many such poses."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.cell_set import Box
from chsel.numerics.compiler import compiled, inner, leaf, spliced
from chsel.numerics.elementary import sine_cosine
from chsel.numerics.pose_tuples import decode, origin_within


class Coarse(NamedTuple):
    """What poses are scored by.

    box, values (nodes,): the signed distance grid, read at the nearest node. contacts (3, A),
    known_sdf (A,): some of the known points; scale: what a metre off costs. inside (3, P): points
    inside of the object; weights (P,): what each costs in free space. voxels, flags (voxels,):
    free space.
    """

    box: Box
    values: Any
    contacts: FloatArray
    known_sdf: FloatArray
    scale: float
    inside: FloatArray
    weights: FloatArray
    voxels: Box
    flags: Any


@inner
def score_below(coarse, pose, limit):
    """The score of a pose, less for a better fit; infinite if it is above the limit."""
    a, b, c, d, e, f, g, h, i, x, y, z = pose
    box, values, contacts, known_sdf = coarse.box, coarse.values, coarse.contacts, coarse.known_sdf
    first, most, inverse = box.first, box.most, box.inverse
    across, along = box.across, box.along
    x0, y0, z0 = (x - first[0]) * inverse, (y - first[1]) * inverse, (z - first[2]) * inverse
    total = 0.0
    for n in range(contacts.shape[1]):
        p, q, r = contacts[0, n] * inverse, contacts[1, n] * inverse, contacts[2, n] * inverse
        u = a * p + b * q + c * r + x0
        v = d * p + e * q + f * r + y0
        w = g * p + h * q + i * r + z0
        k, m, o = min(max(0.0, u), most[0]), min(max(0.0, v), most[1]), min(max(0.0, w), most[2])
        away = (abs(u - k) + abs(v - m) + abs(w - o)) / inverse
        s = values[int(np.rint(k) * across + np.rint(m) * along + np.rint(o))]
        total += coarse.scale * abs(s + away - known_sdf[n])
        if not total <= limit:
            return np.inf
    inside, weights, voxels, flags = coarse.inside, coarse.weights, coarse.voxels, coarse.flags
    first, most, inverse = voxels.first, voxels.most, voxels.inverse
    across, along = voxels.across, voxels.along
    for n in range(inside.shape[1]):
        u, v, w = inside[0, n] - x, inside[1, n] - y, inside[2, n] - z
        k = (a * u + d * v + g * w - first[0]) * inverse
        m = (b * u + e * v + h * w - first[1]) * inverse
        o = (c * u + f * v + i * w - first[2]) * inverse
        k, m, o = min(max(0.0, k), most[0]), min(max(0.0, m), most[1]), min(max(0.0, o), most[2])
        if flags[int(np.rint(k) * across + np.rint(m) * along + np.rint(o))]:
            total += weights[n]
            if not total <= limit:
                return np.inf
    return total


DRAWS = 8  # random numbers that a pose takes
_TURN = 2.0 * np.pi
_ALIKE = 1e-9  # of squared lengths, below which a direction is none


class Anchors(NamedTuple):
    """What can be put onto what.

    contacts (3, A), values (A,): of the world, with the signed distances there. surface,
    normals (3, Q): of the object. by_distance (P, 2): pairs of surface points by their distance.
    pairs (C, 4): two contacts, and the first and last + 1 of the surface pairs as far apart.
    singles (S, 3): a contact, and the first and last + 1 of `allowed` (Q,), the numbers of the
    surface points in the order of their heights over a plane. shares (2,): of all poses, those by
    pairs, and those by either way. lower, upper (3,): where the object may be in the world.
    """

    contacts: FloatArray
    values: FloatArray
    surface: FloatArray
    normals: FloatArray
    by_distance: IntArray
    pairs: IntArray
    singles: IntArray
    allowed: IntArray
    shares: FloatArray
    lower: FloatArray
    upper: FloatArray


class Best(NamedTuple):
    """The best poses so far, a heap with the worst first.

    state (1,): how many there are. scores, numbers (K,), poses (K, 12): of each.
    """

    state: IntArray
    scores: FloatArray
    numbers: IntArray
    poses: FloatArray
    vector: FloatArray


def best_for(most: int) -> Best:
    """Room for so many, for one thread."""
    return Best(
        np.zeros(1, dtype=np.int64),
        np.empty(most),
        np.empty(most, dtype=np.int64),
        np.empty((most, 12)),
        np.zeros(9),
    )


@compiled
def sample(coarse, space, anchors, draws, before, first, last, best):
    """Keep the best of the poses that rows of draws (n, 8) from `first` to `last` make.

    Those of the least scores, and of equal ones the first: which they are does not depend on
    how the rows are split. before: the number of poses drawn before the first row.
    """
    most = len(best.scores)
    for n in range(first, last):
        pose, fits = _pose_of(space, anchors, draws[n], best.vector)
        if fits:
            full = best.state[0] == most
            limit = best.scores[0] if full else np.inf
            score = score_below(coarse, pose, limit)
            if score < limit or (full and score == limit and before + n < best.numbers[0]):
                _put(best, score, before + n, pose, full)


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
            if child + 1 < count and _worse(scores, numbers, child + 1, child):
                child += 1
            if not _precedes(score, number, scores[child], numbers[child]):
                break
            _copy(best, child, at)
            at = child
    else:
        at = best.state[0]
        best.state[0] += 1
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


@leaf
def _worse(scores, numbers, i, j):
    return _precedes(scores[j], numbers[j], scores[i], numbers[i])


@spliced
def _copy(best, source, target):
    best.scores[target], best.numbers[target] = best.scores[source], best.numbers[source]
    for i in range(12):
        best.poses[target, i] = best.poses[source, i]


@inner
def _pose_of(space, anchors, draw, vector):
    """The pose of a row of draws, and whether it has the object where it may be."""
    way = draw[0]
    if way < anchors.shares[0] and len(anchors.pairs) > 0:
        pose = _on_pair(anchors, draw)
    else:
        r = _turned(space, draw, vector)
        if way < anchors.shares[1] and len(anchors.singles) > 0:
            pose = _on_contact(anchors, draw, r)
        else:
            pose = _placed(anchors, draw, r)
        if space.planar:
            pose = _on_plane(space, pose)
    return pose, origin_within(pose, anchors.lower, anchors.upper)


@leaf
def _turned(space, draw, vector):
    """A rotation, uniform on SO(3) (Shoemake, 1992), or about the plane's axis."""
    if space.planar:
        vector[0], vector[1], vector[2] = _TURN * draw[5], 0.0, 0.0
        return decode(space, vector)[:9]
    s, c = sine_cosine(_TURN * draw[5])
    sine, cosine = sine_cosine(_TURN * draw[6])
    inner_root, outer_root = np.sqrt(1.0 - draw[7]), np.sqrt(1.0 * draw[7])
    return matrix_of_quaternion(
        inner_root * s, inner_root * c, outer_root * sine, outer_root * cosine
    )


@leaf
def matrix_of_quaternion(w, x, y, z):
    """The rotation of a unit quaternion, row by row."""
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@leaf
def _placed(anchors, draw, r):
    """A pose with the object's origin uniform in the box: t = -R p."""
    low, high = anchors.lower, anchors.upper
    x = low[0] + draw[1] * (high[0] - low[0])
    y = low[1] + draw[2] * (high[1] - low[1])
    z = low[2] + draw[3] * (high[2] - low[2])
    u, v, w = _rotated(r, x, y, z)
    return _joined(r, -u, -v, -w)


@leaf
def _on_contact(anchors, draw, r):
    """A pose that puts a surface point, or one as far from it as is known, onto a contact."""
    single = int(draw[1] * len(anchors.singles))
    contact = anchors.singles[single, 0]
    first, last = anchors.singles[single, 1], anchors.singles[single, 2]
    q = anchors.allowed[first + int(draw[2] * (last - first))]
    away = anchors.values[contact]
    x, y, z = (
        anchors.contacts[0, contact],
        anchors.contacts[1, contact],
        anchors.contacts[2, contact],
    )
    u, v, w = _rotated(r, x, y, z)
    u = anchors.surface[0, q] + away * anchors.normals[0, q] - u
    v = anchors.surface[1, q] + away * anchors.normals[1, q] - v
    w = anchors.surface[2, q] + away * anchors.normals[2, q] - w
    return _joined(r, u, v, w)


@leaf
def _on_plane(space, pose):
    """The pose moved along the plane's axis onto the plane: a . t = o."""
    a, b, c = space.axis
    off = space.offset - (a * pose[9] + b * pose[10] + c * pose[11])
    return _joined(pose[:9], pose[9] + off * a, pose[10] + off * b, pose[11] + off * c)


@leaf
def _on_pair(anchors, draw):
    """A pose that puts two surface points onto the line of two contacts, turned about it."""
    pair = int(draw[1] * len(anchors.pairs))
    i, j = anchors.pairs[pair, 0], anchors.pairs[pair, 1]
    first, last = anchors.pairs[pair, 2], anchors.pairs[pair, 3]
    at = first + int(draw[2] * (last - first))
    swap = draw[3] < 0.5
    k, m = anchors.by_distance[at, 0], anchors.by_distance[at, 1]
    if swap:
        k, m = m, k
    contacts, surface = anchors.contacts, anchors.surface
    f = _frame(
        contacts[0, j] - contacts[0, i],
        contacts[1, j] - contacts[1, i],
        contacts[2, j] - contacts[2, i],
        1.0,
        0.0,
    )
    sine, cosine = sine_cosine(_TURN * draw[4])
    g = _frame(
        surface[0, m] - surface[0, k],
        surface[1, m] - surface[1, k],
        surface[2, m] - surface[2, k],
        cosine,
        sine,
    )
    r = (  # the frames are columns of f and g: R = g f^T
        g[0] * f[0] + g[3] * f[3] + g[6] * f[6],
        g[0] * f[1] + g[3] * f[4] + g[6] * f[7],
        g[0] * f[2] + g[3] * f[5] + g[6] * f[8],
        g[1] * f[0] + g[4] * f[3] + g[7] * f[6],
        g[1] * f[1] + g[4] * f[4] + g[7] * f[7],
        g[1] * f[2] + g[4] * f[5] + g[7] * f[8],
        g[2] * f[0] + g[5] * f[3] + g[8] * f[6],
        g[2] * f[1] + g[5] * f[4] + g[8] * f[7],
        g[2] * f[2] + g[5] * f[5] + g[8] * f[8],
    )
    x = 0.5 * (contacts[0, i] + contacts[0, j])
    y = 0.5 * (contacts[1, i] + contacts[1, j])
    z = 0.5 * (contacts[2, i] + contacts[2, j])
    u, v, w = _rotated(r, x, y, z)
    u = 0.5 * (surface[0, k] + surface[0, m]) - u
    v = 0.5 * (surface[1, k] + surface[1, m]) - v
    w = 0.5 * (surface[2, k] + surface[2, m]) - w
    return _joined(r, u, v, w)


@leaf
def _frame(x, y, z, cosine, sine):
    """Three orthonormal vectors, one after the other: along x, y, z, the others turned about it."""
    length = np.sqrt(max(x * x + y * y + z * z, _ALIKE))
    x, y, z = x / length, y / length, z / length
    if abs(x) < 0.6:  # with the axis that it is far from
        a, b, c = 0.0, -z, y
    else:
        a, b, c = z, 0.0, -x
    length = np.sqrt(max(a * a + b * b + c * c, _ALIKE))
    a, b, c = a / length, b / length, c / length
    d, e, f = y * c - z * b, z * a - x * c, x * b - y * a
    return (
        x,
        y,
        z,
        cosine * a + sine * d,
        cosine * b + sine * e,
        cosine * c + sine * f,
        cosine * d - sine * a,
        cosine * e - sine * b,
        cosine * f - sine * c,
    )


@leaf
def _rotated(r, x, y, z):
    return (
        r[0] * x + r[1] * y + r[2] * z,
        r[3] * x + r[4] * y + r[5] * z,
        r[6] * x + r[7] * y + r[8] * z,
    )


@leaf
def _joined(r, u, v, w):
    return r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8], u, v, w
