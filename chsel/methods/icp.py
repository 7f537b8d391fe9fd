"""ICP of contacts and points of the object's surface (Besl and McKay, 1992), a weak baseline."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, ClassVar, NamedTuple

import numpy as np

from chsel.methods.method import ConfiguredMethod
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.eigen import decompose
from chsel.numerics.pose_tuples import finite, moved, pose_at, turned
from chsel.numerics.threads import parallel_for
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import Hypotheses, Observer, RegistrationProblem
from chsel.problem.settings import CheckedSettings, Presets, at_most, not_negative, one_of, positive
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.surface import surface_points
from chsel.qd.selection import ranked

MOST_ITERATIONS = 1_000_000
MOST_POINTS = 1_000_000
_BLOCK = 10  # iterations between two traces
_NO_GAP = 1e-9  # eigenvalues this much apart, as a part of the largest, count as equal,
_NO_SPREAD = 1e-20  # and so do those this much apart, m^2: points that differ by rounding alone


@dataclass(frozen=True)
class IcpSettings(CheckedSettings):
    """Settings of ICP."""

    surface_points: Annotated[int, positive, at_most(MOST_POINTS)] = 2000  # Q, of the object
    # New points for every "registration", or the same for a session.
    redraw: Annotated[str, one_of("registration", "session")] = "session"
    iterations: Annotated[int, not_negative, at_most(MOST_ITERATIONS)] = 100  # at most
    # End when the rms distance of no start falls by more than this fraction; None: never early.
    stop_below: Annotated[float | None, not_negative, at_most(1.0)] = 1e-6
    # E_0 and E_l of the next problem.
    online: OnlineSettings = field(default_factory=OnlineSettings)

    presets: ClassVar[Presets] = {
        "paper": {"surface_points": 500, "redraw": "registration"},
        "reference": {"surface_points": 500},
    }


class Icp(ConfiguredMethod[IcpSettings]):
    """Registers the contacts by point-to-point ICP from every pose of E_0; E_l is not used.

    Free and occupied points, and those of a known distance that is not 0, are not used. Costs are
    rms distances in metres of the contacts to the surface points nearest to them: not to be
    compared with those of the relaxed cost. Without any contact E_0 is returned, at cost 0.
    """

    settings_class = IcpSettings

    def _hypotheses(self, problem: RegistrationProblem, observer: Observer) -> Hypotheses:
        contacts = problem.points.contacts
        poses = Poses.of(problem.initial_set)
        if len(contacts) == 0:
            return ranked(problem.initial_set, np.zeros(len(poses)))
        sets = contacts.T.copy(), self.surface(problem).T.copy()
        observer.trace("icp", 0, poses.vectors, _distances(sets, poses))
        poses = self._iterated(sets, poses, observer=observer)
        return ranked(poses.matrices, _distances(sets, poses))

    def surface(self, problem: RegistrationProblem) -> FloatArray:
        """Return points (Q, 3) of the object's surface that stand for it, in its frame, metres."""
        sdf = problem.sdf
        key = problem.key
        count = self.settings.surface_points
        if self.settings.redraw == "registration":
            return surface_points(sdf, count, stream=key.stream(Purpose.ICP_SURFACE))
        key = StreamKey(key.seed, 0)
        stream = key.stream(Purpose.ICP_SURFACE)
        return sdf.derived(("icp", count, key), lambda: surface_points(sdf, count, stream=stream))

    def _iterated(self, sets: _PointSets, poses: Poses, *, observer: Observer) -> Poses:
        """Return poses after as many iterations as the stop rule allows."""
        total = self.settings.iterations
        scratch = partial(_scratch, sets)
        errors = np.full(len(poses), np.inf)
        for first in range(0, total, _BLOCK):
            count = min(_BLOCK, total - first)
            history = np.empty((count, len(poses), 12))
            after = np.empty((count, len(poses)))
            run = partial(_iterate, sets, poses.numbers, history, after)
            parallel_for(run, len(poses), scratch=scratch)
            falling = np.ones(count, dtype=bool)  # whether any start's error falls enough
            if self.settings.stop_below is not None:
                before = np.concatenate([errors[None], after[:-1]])
                falling = (after < (1.0 - self.settings.stop_below) * before).any(axis=1)
            count = count if falling.all() else int(np.argmin(falling)) + 1
            poses = Poses(history[count - 1])
            errors = after[count - 1]
            observer.trace("icp", first + count, poses.vectors, errors.copy())
            observer.progress("icp", first + count, total)
            if not falling.all():
                break
        return poses


# Contacts (3, N), world, and points (3, Q) of the surface, object frame, that they are put onto.
_PointSets = tuple[FloatArray, FloatArray]


def _distances(sets: _PointSets, poses: Poses) -> FloatArray:
    """Return the rms distances (B,) of the contacts to their nearest surface points, metres."""
    out = np.empty(len(poses))
    run = partial(_fill_distances, sets, poses.numbers, out)
    parallel_for(run, len(poses), scratch=partial(_scratch, sets))
    return out


class _Scratch(NamedTuple):
    """Scratch of one thread."""

    points: FloatArray  # (3, N), the contacts in the object frame
    squares: FloatArray  # (N,), their squared distances to the nearest surface points
    nearest: IntArray  # (N,), which those are
    matched: FloatArray  # (3, N), and where
    form: FloatArray  # (4, 4), a quadratic form of quaternions
    work: FloatArray  # (4, 4)
    vectors: FloatArray  # (4, 4), its eigenvectors, in columns
    last_vectors: FloatArray  # (4, 4), the same of the form of the rotation so far
    values: FloatArray  # (4,), its eigenvalues
    last_values: FloatArray  # (4,)


def _scratch(sets: _PointSets) -> _Scratch:
    count = sets[0].shape[1]
    points, matched = np.empty((2, 3, count))
    nearest = np.empty(count, dtype=np.int64)
    return _Scratch(
        points, np.empty(count), nearest, matched, *np.empty((4, 4, 4)), *np.empty((2, 4))
    )


@compiled
def _iterate(sets, poses, history, errors, first, last, scratch):
    """Fill history (K, B, 12) with poses after each of K iterations, and errors (K, B), metres."""
    for n in range(first, last):
        pose = pose_at(poses, n)
        error, settled = np.inf, False
        for k in range(len(history)):
            if not settled:  # a pose that stays as it is will always do so
                before = pose
                _match(sets, pose, scratch)
                pose = _aligned(sets[0], pose, scratch)
                error = _rms(sets[0], pose, scratch.matched)
                settled = pose == before
            for i in range(12):
                history[k, n, i] = pose[i]
            errors[k, n] = error


@compiled
def _fill_distances(sets, poses, out, first, last, scratch):
    for n in range(first, last):
        pose = pose_at(poses, n)
        _match(sets, pose, scratch)
        out[n] = _rms(sets[0], pose, scratch.matched)


@inner
def _match(sets, pose, scratch):
    """Fill matched (3, N) with the surface point nearest to each contact, the first of equals."""
    contacts, surface = sets
    squares, nearest = scratch.squares, scratch.nearest
    xs, ys, zs = scratch.points[0], scratch.points[1], scratch.points[2]
    for n in range(len(squares)):
        xs[n], ys[n], zs[n] = moved(pose, contacts[0, n], contacts[1, n], contacts[2, n])
        squares[n], nearest[n] = np.inf, 0
    for q in range(surface.shape[1]):
        x, y, z = surface[0, q], surface[1, q], surface[2, q]
        for n in range(len(squares)):  # can be vectorised
            dx, dy, dz = xs[n] - x, ys[n] - y, zs[n] - z
            square = dx * dx + dy * dy + dz * dz
            nearer = square < squares[n]
            squares[n] = square if nearer else squares[n]
            nearest[n] = q if nearer else nearest[n]
    for n in range(len(squares)):
        for axis in range(3):
            scratch.matched[axis, n] = surface[axis, nearest[n]]


@inner
def _aligned(points, pose, scratch):
    """Return the pose that brings points (3, N) nearest to those matched (Horn, 1987, Sec. 4)."""
    matched = scratch.matched
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
    _fill_form((a, b, c, d, e, f, g, h, i), scratch.form)
    decompose(scratch.form, scratch.work, scratch.values, scratch.vectors)
    r = _rotation(_best_quaternion(pose, scratch))
    a, b, c = turned(r, x, y, z)
    return *r, u - a, v - b, w - c


@leaf
def _centre(points):
    """Return the mean of points (3, N)."""
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
def _best_quaternion(pose, scratch):
    """Return the eigenvector of the largest eigenvalue; of several, that nearest to `pose`."""
    values, vectors = scratch.values, scratch.vectors
    best = vectors[0, 3], vectors[1, 3], vectors[2, 3], vectors[3, 3]
    least = values[3] - max(_NO_GAP * values[3], _NO_SPREAD)
    if values[2] < least:
        return best
    r = pose  # brings the axes onto its columns, so sum x y^T is its transpose
    _fill_form((r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]), scratch.form)
    decompose(scratch.form, scratch.work, scratch.last_values, scratch.last_vectors)
    w = x = y = z = 0.0
    for k in range(4):
        if values[k] >= least:
            along = 0.0
            for j in range(4):
                along += vectors[j, k] * scratch.last_vectors[j, 3]
            w, x = w + along * vectors[0, k], x + along * vectors[1, k]
            y, z = y + along * vectors[2, k], z + along * vectors[3, k]
    size = np.sqrt(w * w + x * x + y * y + z * z)
    return best if size < 1e-6 else (w / size, x / size, y / size, z / size)


@leaf
def _rotation(quaternion):
    """Return the rotation of a unit quaternion w, x, y, z."""
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
    """Return sqrt(mean |R x + t - y|^2) over points x and matches y (3, N); infinite, never NaN."""
    total, count = 0.0, points.shape[1]
    for n in range(count):
        x, y, z = moved(pose, points[0, n], points[1, n], points[2, n])
        dx, dy, dz = matched[0, n] - x, matched[1, n] - y, matched[2, n] - z
        total += dx * dx + dy * dy + dz * dz
    return np.sqrt(total / count) if total < np.inf else np.inf
