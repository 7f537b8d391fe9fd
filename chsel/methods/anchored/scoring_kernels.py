"""The coarse score of poses, of a block in lanes of vector instructions or of one of them alone."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.methods.anchored.placing_kernels import FURTHER, HALF, LANES, ONE, PLACED, SHIFT, ZERO
from chsel.numerics.compiler import inner

UNIT = 2.0**-14  # metres: what scores and the signed distances of a table count in
_PART = 32  # points inside that a pose is scored by at a time
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


@inner
def add_contact(coarse, n, best, count):
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
def turn_back(box, lanes, count):
    """Fill rows from PLACED on with the maps from the object to voxels: R^T, then -R^T t."""
    inverse = box.inverse
    fx, fy, fz = box.first[0] * inverse, box.first[1] * inverse, box.first[2] * inverse
    for i in range(count):
        p, q, o = lanes[SHIFT + i], lanes[SHIFT + LANES + i], lanes[SHIFT + 2 * LANES + i]
        a, b, c = lanes[i] * inverse, lanes[3 * LANES + i] * inverse, lanes[6 * LANES + i] * inverse
        lanes[PLACED + i], lanes[PLACED + LANES + i], lanes[PLACED + 2 * LANES + i] = a, b, c
        lanes[PLACED + 9 * LANES + i] = -(a * p + b * q + c * o) - fx
        a, b = lanes[LANES + i] * inverse, lanes[4 * LANES + i] * inverse
        c = lanes[7 * LANES + i] * inverse
        lanes[PLACED + 3 * LANES + i], lanes[PLACED + 4 * LANES + i] = a, b
        lanes[PLACED + 5 * LANES + i] = c
        lanes[PLACED + 10 * LANES + i] = -(a * p + b * q + c * o) - fy
        a, b = lanes[2 * LANES + i] * inverse, lanes[5 * LANES + i] * inverse
        c = lanes[8 * LANES + i] * inverse
        lanes[PLACED + 6 * LANES + i], lanes[PLACED + 7 * LANES + i] = a, b
        lanes[PLACED + 8 * LANES + i] = c
        lanes[PLACED + 11 * LANES + i] = -(a * p + b * q + c * o) - fz


@inner
def add_inside(coarse, n, best, count):
    """Add what a point inside costs to the scores of a block, where they are not too high yet."""
    lanes, cells, found, scores = best.lanes, best.cells, best.found, best.scores
    x, y, z = coarse.inside[0, n], coarse.inside[1, n], coarse.inside[2, n]
    box, weight = coarse.voxels, coarse.weights[n]
    mx, my, mz = box.most
    for i in range(count):
        a, b = lanes[PLACED + i], lanes[PLACED + LANES + i]
        u = a * x + b * y + lanes[PLACED + 2 * LANES + i] * z
        a, b = lanes[PLACED + 3 * LANES + i], lanes[PLACED + 4 * LANES + i]
        v = a * x + b * y + lanes[PLACED + 5 * LANES + i] * z
        a, b = lanes[PLACED + 6 * LANES + i], lanes[PLACED + 7 * LANES + i]
        w = a * x + b * y + lanes[PLACED + 8 * LANES + i] * z
        u = min(max(u + lanes[PLACED + 9 * LANES + i], ZERO), mx) + HALF
        v = min(max(v + lanes[PLACED + 10 * LANES + i], ZERO), my) + HALF
        w = min(max(w + lanes[PLACED + 11 * LANES + i], ZERO), mz) + HALF
        at = np.int32(u) * box.across + np.int32(v) * box.along
        cells[i] = np.int32(at + np.int32(w))
    for i in range(count):
        found[i] = coarse.flags[cells[i]]
    for i in range(count):
        cost = np.int32(found[i] * weight)
        scores[i] += cost if scores[i] < np.int32(HIGHEST) else np.int32(0)


@inner
def score_below(coarse, i, done, before, total, limit, best):
    """The score of the i-th pose, or a part of it above the limit.

    From that by contacts before `done`, and by points inside before `before`.
    """
    lanes, cells = best.lanes, best.cells
    count = coarse.contacts.shape[1]
    r = lanes[i], lanes[LANES + i], lanes[2 * LANES + i]
    s = lanes[3 * LANES + i], lanes[4 * LANES + i], lanes[5 * LANES + i]
    t = lanes[6 * LANES + i], lanes[7 * LANES + i], lanes[8 * LANES + i]
    p, q, o = lanes[SHIFT + i], lanes[SHIFT + LANES + i], lanes[SHIFT + 2 * LANES + i]
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
    size = points.shape[1]
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
