"""The best of many poses by a coarse score.

Blocks of poses are scored by some contacts together, one in each lane of vector instructions; those
that may be among the best go on alone, with contacts and points of the object in lanes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.methods.anchored.placing_kernels import (
    FURTHER,
    HALF,
    LANES,
    ONE,
    ROWS,
    SHIFT,
    ZERO,
    place,
)
from chsel.numerics.arrays import IntArray
from chsel.numerics.compiler import compiled, inner, leaf

UNIT = 2.0**-14  # metres: what scores and the signed distances of a table count in
_CHUNK = 4  # contacts that a block is scored by at a time
_PART = 32  # points inside that a pose is scored by at a time
_FEW = 8  # poses go on alone when at most the eighth part of a block is left
HIGHEST = 2**30  # above all scores of poses that are within bounds


class Box32(NamedTuple):
    """The nodes of a grid, in steps: cells lie around nodes."""

    first: Any  # (3,), corner node, metres
    inverse: Any  # nodes per metre
    most: Any  # (3,), the greatest index per axis
    across: Any  # steps in a flat array to the next node on the first axis,
    along: Any  # and on the second


class Coarse(NamedTuple):
    """What poses are scored by: some known points, and points inside of the object."""

    box: Box32  # of the signed distance grid
    values: Any  # (nodes,) in UNITs, read at the nearest node
    contacts: Any  # (3, A), world
    known_sdf: Any  # (A,), in UNITs
    reach: Any  # UNITs beyond which a known point costs no more
    inside: Any  # (3, P), object frame
    weights: Any  # (P,), cost of each in free space, in UNITs of the sum over contacts
    voxels: Box32  # of the free space
    flags: Any  # (voxels,), 1 for free ones


class Best(NamedTuple):
    """The best poses so far, and scratch of one thread."""

    size: IntArray  # (1,), how many there are
    keys: IntArray  # (K,), a heap with the worst first: 2^32 x score + number among all drawn
    slots: IntArray  # (K,), where the pose of each is
    poses: Any  # (K, 12)
    lanes: Any  # rows of a block, one after the other
    cells: Any  # (LANES,), indices in a table
    found: Any  # (LANES,), what was read there
    scores: Any  # (LANES,)


def best_for(most: int) -> Best:
    """No poses yet, and room for `most`."""
    cells, found, scores = (np.zeros(LANES, dtype=np.int32) for _ in range(3))
    keys, slots = (np.zeros(most, dtype=np.int64) for _ in range(2))
    lanes, poses = np.zeros(ROWS * LANES, dtype=np.float32), np.empty((most, 12), np.float32)
    return Best(np.zeros(1, dtype=np.int64), keys, slots, poses, lanes, cells, found, scores)


@compiled
def sample(coarse, anchors, draws, before, first, last, best):
    """Keep the best of the poses that columns of draws (DRAWS, n) make, from `first` to `last`.

    before: how many poses were drawn before column 0. Kept are those of the lowest scores, and of
    equal ones the first, so that the result does not depend on how the columns are split.
    """
    start = first
    while start < last:
        number, count = before + start, min(last - start, LANES)
        for until in anchors.kinds:
            if number < until:
                count = min(count, until - number)
        place(anchors, draws, start, count, number, best.lanes)
        _keep_best(coarse, anchors, number, count, best)
        start += count


@inner
def _keep_best(coarse, anchors, number, count, best):
    """Score a block of poses, and keep those that are among the best so far."""
    most, lanes, scores = len(best.keys), best.lanes, best.scores
    _check_origins(anchors, lanes, scores, count)
    limit = _limit(best)
    done, left = 0, count
    while done < coarse.contacts.shape[1] and left * _FEW > count:
        until = min(done + _CHUNK, coarse.contacts.shape[1])
        for n in range(done, until):
            _add_contact(coarse, n, best, count)
        left = 0
        for i in range(count):
            left += 1 if scores[i] <= limit else 0
        done = until
    for i in range(count):
        if scores[i] <= limit:
            total = _score_below(coarse, i, done, np.int64(scores[i]), limit, best)
            key = (total << 32) + (number + i)
            if total <= limit and (best.size[0] < most or key < best.keys[0]):
                _put(best, key, i)
                limit = _limit(best)


@leaf
def _limit(best):
    """The score that a pose must not exceed to be among the best."""
    return best.keys[0] >> 32 if best.size[0] == len(best.keys) else np.int64(HIGHEST - 1)


@inner
def _check_origins(anchors, lanes, scores, count):
    """Scores of 0, and too high ones where the object's origin, -R^T t, is out of its bounds."""
    a, b, c = anchors.lower
    d, e, f = anchors.upper
    for i in range(count):
        u, v, w = lanes[SHIFT + i], lanes[SHIFT + LANES + i], lanes[SHIFT + 2 * LANES + i]
        x = -(lanes[i] * u + lanes[3 * LANES + i] * v + lanes[6 * LANES + i] * w)
        y = -(lanes[LANES + i] * u + lanes[4 * LANES + i] * v + lanes[7 * LANES + i] * w)
        z = -(lanes[2 * LANES + i] * u + lanes[5 * LANES + i] * v + lanes[8 * LANES + i] * w)
        off = max(max(a - x, x - d), max(max(b - y, y - e), max(c - z, z - f)))
        scores[i] = np.int32(0) if off <= ZERO else np.int32(HIGHEST)


@inner
def _add_contact(coarse, n, best, count):
    """Add what a contact costs to the scores of a block."""
    lanes, cells, found, scores = best.lanes, best.cells, best.found, best.scores
    x, y, z = coarse.contacts[0, n], coarse.contacts[1, n], coarse.contacts[2, n]
    box, level, reach = coarse.box, coarse.known_sdf[n], coarse.reach
    fx, fy, fz = box.first
    inverse = box.inverse
    mx, my, mz = box.most
    step = ONE / inverse / np.float32(UNIT)
    for i in range(count):
        u = lanes[i] * x + lanes[LANES + i] * y + lanes[2 * LANES + i] * z + lanes[SHIFT + i]
        v = lanes[3 * LANES + i] * x + lanes[4 * LANES + i] * y + lanes[5 * LANES + i] * z
        w = lanes[6 * LANES + i] * x + lanes[7 * LANES + i] * y + lanes[8 * LANES + i] * z
        u = (u - fx) * inverse
        v = (v + lanes[SHIFT + LANES + i] - fy) * inverse
        w = (w + lanes[SHIFT + 2 * LANES + i] - fz) * inverse
        k, m, o = min(max(u, ZERO), mx), min(max(v, ZERO), my), min(max(w, ZERO), mz)
        lanes[FURTHER + i] = (abs(u - k) + abs(v - m) + abs(w - o)) * step - level
        at = np.int32(k + HALF) * box.across + np.int32(m + HALF) * box.along
        cells[i] = np.int32(at + np.int32(o + HALF))
    for i in range(count):
        found[i] = coarse.values[cells[i]]
    for i in range(count):
        off = min(abs(np.float32(found[i]) + lanes[FURTHER + i]), reach)
        scores[i] += np.int32(off)


@inner
def _score_below(coarse, i, done, total, limit, best):
    """The score of the i-th pose from that by contacts before `done`, or a part above the limit."""
    lanes, cells = best.lanes, best.cells
    r = lanes[i], lanes[LANES + i], lanes[2 * LANES + i]
    s = lanes[3 * LANES + i], lanes[4 * LANES + i], lanes[5 * LANES + i]
    t = lanes[6 * LANES + i], lanes[7 * LANES + i], lanes[8 * LANES + i]
    p, q, o = lanes[SHIFT + i], lanes[SHIFT + LANES + i], lanes[SHIFT + 2 * LANES + i]
    count = coarse.contacts.shape[1]
    if done < count:
        total += _contacts_cost(coarse, r, s, t, (p, q, o), done, best)
    points = coarse.inside
    box = coarse.voxels
    inverse = box.inverse
    a, b, c = r[0] * inverse, s[0] * inverse, t[0] * inverse  # R^T
    d, e, f = r[1] * inverse, s[1] * inverse, t[1] * inverse
    g, h, k = r[2] * inverse, s[2] * inverse, t[2] * inverse
    x = -(a * p + b * q + c * o) - box.first[0] * inverse
    y = -(d * p + e * q + f * o) - box.first[1] * inverse
    z = -(g * p + h * q + k * o) - box.first[2] * inverse
    mx, my, mz = box.most
    before, size = 0, points.shape[1]
    while before < size and total <= limit:
        part = min(_PART, size - before)
        for n in range(part):
            u = a * points[0, before + n] + b * points[1, before + n] + c * points[2, before + n]
            v = d * points[0, before + n] + e * points[1, before + n] + f * points[2, before + n]
            w = g * points[0, before + n] + h * points[1, before + n] + k * points[2, before + n]
            u = min(max(u + x, ZERO), mx) + HALF
            v = min(max(v + y, ZERO), my) + HALF
            w = min(max(w + z, ZERO), mz) + HALF
            at = np.int32(u) * box.across + np.int32(v) * box.along
            cells[n] = np.int32(at + np.int32(w))
        for n in range(part):
            total += coarse.flags[cells[n]] * coarse.weights[before + n]
        before += part
    return total


@inner
def _contacts_cost(coarse, r, s, t, shift, done, best):
    """What the contacts from `done` on cost a pose."""
    lanes, cells, contacts, box = best.lanes, best.cells, coarse.contacts, coarse.box
    inverse = box.inverse
    mx, my, mz = box.most
    step = ONE / inverse / np.float32(UNIT)
    x, y, z = shift[0] - box.first[0], shift[1] - box.first[1], shift[2] - box.first[2]
    count = contacts.shape[1] - done
    for n in range(count):
        p, q, o = contacts[0, done + n], contacts[1, done + n], contacts[2, done + n]
        u = (r[0] * p + r[1] * q + r[2] * o + x) * inverse
        v = (s[0] * p + s[1] * q + s[2] * o + y) * inverse
        w = (t[0] * p + t[1] * q + t[2] * o + z) * inverse
        k, m, j = min(max(u, ZERO), mx), min(max(v, ZERO), my), min(max(w, ZERO), mz)
        lanes[FURTHER + n] = (abs(u - k) + abs(v - m) + abs(w - j)) * step
        at = np.int32(k + HALF) * box.across + np.int32(m + HALF) * box.along
        cells[n] = np.int32(at + np.int32(j + HALF))
    total = np.int64(0)
    for n in range(count):
        off = np.float32(coarse.values[cells[n]]) + lanes[FURTHER + n] - coarse.known_sdf[done + n]
        total += np.int32(min(abs(off), coarse.reach))
    return total


@inner
def _put(best, key, i):
    """Add the pose in lane i, in place of the worst if there is no room."""
    keys, slots, most = best.keys, best.slots, len(best.keys)
    if best.size[0] == most:
        slot, at = slots[0], 0
        while True:  # down, past worse ones
            child = 2 * at + 1
            if child >= most:
                break
            if child + 1 < most and keys[child + 1] > keys[child]:
                child += 1
            if key >= keys[child]:
                break
            keys[at], slots[at] = keys[child], slots[child]
            at = child
    else:
        slot = at = best.size[0]
        best.size[0] += 1
        while at > 0:
            parent = (at - 1) // 2
            if keys[parent] >= key:
                break
            keys[at], slots[at] = keys[parent], slots[parent]
            at = parent
    keys[at], slots[at] = key, slot
    for j in range(12):
        best.poses[slot, j] = best.lanes[j * LANES + i]


@compiled
def bounds_of_points(points, lower, upper, bounds):
    """Fill bounds (2, 3) of those of points (N, 3) that are in a box; returns how many are."""
    count = 0
    bounds[0], bounds[1] = np.inf, -np.inf
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if _within((x, y, z), lower, upper):
            count += 1
            bounds[0, 0], bounds[1, 0] = min(bounds[0, 0], x), max(bounds[1, 0], x)
            bounds[0, 1], bounds[1, 1] = min(bounds[0, 1], y), max(bounds[1, 1], y)
            bounds[0, 2], bounds[1, 2] = min(bounds[0, 2], z), max(bounds[1, 2], z)
    return count


@compiled
def mark_voxels(points, lower, upper, first, side, flags):
    """Set the flags (nx, ny, nz) of the voxels that hold one of the points that are in a box."""
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if _within((x, y, z), lower, upper):
            i = int(np.rint((x - first[0]) / side))
            j = int(np.rint((y - first[1]) / side))
            flags[i, j, int(np.rint((z - first[2]) / side))] = 1


@leaf
def _within(point, lower, upper):
    x, y, z = point
    inside = lower[0] <= x <= upper[0] and lower[1] <= y <= upper[1]
    return inside and lower[2] <= z <= upper[2]
