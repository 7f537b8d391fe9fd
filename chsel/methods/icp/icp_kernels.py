"""Iterative closest point (Besl and McKay, 1992) for many starts, each on its own."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.eigen import decompose
from chsel.numerics.pose_tuples import finite, pose_at

_NO_GAP = 1e-9  # eigenvalues this much apart, as a part of the largest, count as equal,
_NO_SPREAD = 1e-20  # and so do those this much apart, m^2: points that differ by rounding alone


class Matches(NamedTuple):
    """Scratch of one thread: what points are matched with, and what their alignment is found in.

    places (3, N): the points in the object frame. nearest (N,): the model point nearest to each,
    at a squared distance of least (N,), and matched (3, N): where that is. form (4, 4): of
    quaternions; values (4,), vectors (4, 4): its eigenvalues and eigenvectors; turned, turns: those
    of the form of the rotation so far.
    """

    places: FloatArray
    least: FloatArray
    nearest: IntArray
    matched: FloatArray
    form: FloatArray
    work: FloatArray
    values: FloatArray
    vectors: FloatArray
    turned: FloatArray
    turns: FloatArray


def matches_for(count: int) -> Matches:
    """Scratch for so many points."""
    return Matches(
        places=np.empty((3, count)),
        least=np.empty(count),
        nearest=np.empty(count, dtype=np.int64),
        matched=np.empty((3, count)),
        form=np.empty((4, 4)),
        work=np.empty((4, 4)),
        values=np.empty(4),
        vectors=np.empty((4, 4)),
        turned=np.empty(4),
        turns=np.empty((4, 4)),
    )


@compiled
def iterate(points, model, poses, history, errors, first, last, matches):
    """Run ICP from poses (B, 12), those from `first` to before `last`, for K iterations.

    points (3, N): of the world. model (3, Q): of the object. Fills history (K, B, 12), the pose
    after each iteration, and errors (K, B): the rms distance of its points to those matched with
    them, infinite once a sum is not finite; the pose stays then.
    """
    count = len(history)
    for n in range(first, last):
        pose = pose_at(poses, n)
        error, settled = np.inf, False
        for k in range(count):
            if not settled:  # a pose that stays as it is will always do so
                before = pose
                _match(points, model, pose, matches)
                pose = _aligned(points, pose, matches)
                error = _rms(points, pose, matches.matched)
                settled = pose == before
            for i in range(12):
                history[k, n, i] = pose[i]
            errors[k, n] = error


@compiled
def rms_distances(points, model, poses, out, first, last, matches):
    """Fill out (B,) with the rms distance of points (3, N) to their nearest of the model (3, Q)."""
    for n in range(first, last):
        pose = pose_at(poses, n)
        _match(points, model, pose, matches)
        out[n] = _rms(points, pose, matches.matched)


@inner
def _match(points, model, pose, matches):
    """Fill matched (3, N) with the model point nearest to each point, the first of equals.

    All points ask the same model point at a time, which can be vectorised.
    """
    places, least, nearest = matches.places, matches.least, matches.nearest
    xs, ys, zs = places[0], places[1], places[2]
    for n in range(len(least)):
        xs[n], ys[n], zs[n] = _moved(pose, points[0, n], points[1, n], points[2, n])
        least[n], nearest[n] = np.inf, 0
    for q in range(model.shape[1]):
        x, y, z = model[0, q], model[1, q], model[2, q]
        for n in range(len(least)):
            dx, dy, dz = xs[n] - x, ys[n] - y, zs[n] - z
            distance = dx * dx + dy * dy + dz * dz
            nearer = distance < least[n]
            least[n] = distance if nearer else least[n]
            nearest[n] = q if nearer else nearest[n]
    for n in range(len(least)):
        for axis in range(3):
            matches.matched[axis, n] = model[axis, nearest[n]]


@inner
def _aligned(points, pose, matches):
    """The pose that brings points (3, N) nearest to those matched (Horn, 1987, Sec. 4).

    Its rotation is the unit quaternion of largest q^T M q. Where that leaves some freedom, as with
    one point or with points in a line, it is the one nearest to the rotation of `pose`.
    """
    matched = matches.matched
    x, y, z = _centre(points)
    u, v, w = _centre(matched)
    a = b = c = d = e = f = g = h = i = 0.0
    for n in range(points.shape[1]):
        dx, dy, dz = points[0, n] - x, points[1, n] - y, points[2, n] - z
        du, dv, dw = matched[0, n] - u, matched[1, n] - v, matched[2, n] - w
        a, b, c = a + dx * du, b + dx * dv, c + dx * dw
        d, e, f = d + dy * du, e + dy * dv, f + dy * dw
        g, h, i = g + dz * du, h + dz * dv, i + dz * dw
    if not finite((a, b, c, d, e, f, g, h, i, x, y, z)):
        return pose
    _fill_form((a, b, c, d, e, f, g, h, i), matches.form)
    decompose(matches.form, matches.work, matches.values, matches.vectors)
    quaternion = _best_quaternion(pose, matches)
    r = _rotation(quaternion)
    return (
        *r,
        u - (r[0] * x + r[1] * y + r[2] * z),
        v - (r[3] * x + r[4] * y + r[5] * z),
        w - (r[6] * x + r[7] * y + r[8] * z),
    )


@leaf
def _centre(points):
    """The mean of points (3, N)."""
    x = y = z = 0.0
    count = points.shape[1]
    for n in range(count):
        x, y, z = x + points[0, n], y + points[1, n], z + points[2, n]
    return x / count, y / count, z / count


@inner
def _fill_form(s, form):
    """Fill M (4, 4) from s = sum x y^T: q^T M q = sum y . R(q) x, of quaternions w, x, y, z."""
    form[0, 0] = s[0] + s[4] + s[8]
    form[1, 1] = s[0] - s[4] - s[8]
    form[2, 2] = s[4] - s[0] - s[8]
    form[3, 3] = s[8] - s[0] - s[4]
    form[0, 1] = form[1, 0] = s[5] - s[7]
    form[0, 2] = form[2, 0] = s[6] - s[2]
    form[0, 3] = form[3, 0] = s[1] - s[3]
    form[1, 2] = form[2, 1] = s[1] + s[3]
    form[1, 3] = form[3, 1] = s[2] + s[6]
    form[2, 3] = form[3, 2] = s[5] + s[7]


@inner
def _best_quaternion(pose, matches):
    """The eigenvector of the largest eigenvalue; of several, the unit vector nearest to `pose`."""
    values, vectors = matches.values, matches.vectors
    best = vectors[0, 3], vectors[1, 3], vectors[2, 3], vectors[3, 3]
    least = values[3] - max(_NO_GAP * values[3], _NO_SPREAD)
    if values[2] < least:
        return best
    r = pose  # brings the axes onto its columns, so sum x y^T is its transpose
    _fill_form((r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]), matches.form)
    decompose(matches.form, matches.work, matches.turned, matches.turns)
    w = x = y = z = 0.0
    for k in range(4):
        if values[k] >= least:
            along = 0.0
            for j in range(4):
                along += vectors[j, k] * matches.turns[j, 3]
            w, x = w + along * vectors[0, k], x + along * vectors[1, k]
            y, z = y + along * vectors[2, k], z + along * vectors[3, k]
    size = np.sqrt(w * w + x * x + y * y + z * z)
    if size < 1e-6:
        return best
    return w / size, x / size, y / size, z / size


@leaf
def _rotation(quaternion):
    """The rotation of a unit quaternion w, x, y, z."""
    w, x, y, z = quaternion
    return (
        w * w + x * x - y * y - z * z,
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        w * w - x * x + y * y - z * z,
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        w * w - x * x - y * y + z * z,
    )


@inner
def _rms(points, pose, matched):
    """sqrt(mean |R x + t - y|^2) over points x (3, N) and those matched, y; infinite, never nan."""
    total, count = 0.0, points.shape[1]
    for n in range(count):
        x, y, z = _moved(pose, points[0, n], points[1, n], points[2, n])
        dx, dy, dz = matched[0, n] - x, matched[1, n] - y, matched[2, n] - z
        total += dx * dx + dy * dy + dz * dz
    return np.sqrt(total / count) if total < np.inf else np.inf


@leaf
def _moved(pose, x, y, z):
    return (
        pose[0] * x + pose[1] * y + pose[2] * z + pose[9],
        pose[3] * x + pose[4] * y + pose[5] * z + pose[10],
        pose[6] * x + pose[7] * y + pose[8] * z + pose[11],
    )
