"""The best of many poses by a coarse score.

Blocks of poses are scored together, one in each lane of vector instructions, by contacts, then by
points inside of the object; once few may be among the best, these go on alone, points in lanes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.methods.anchored.placing_kernels import LANES, ROWS, SHIFT, ZERO, place
from chsel.methods.anchored.scoring_kernels import (
    HIGHEST,
    add_contact,
    add_inside,
    score_below,
    turn_back,
)
from chsel.numerics.arrays import IntArray
from chsel.numerics.compiler import compiled, inner, leaf

_CHUNK = 4  # contacts that a block is scored by at a time
_INSIDE_CHUNK = 8  # points inside
_FEW = 8  # poses go on alone when at most the eighth part of a block is left


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
    done, inside, left = 0, 0, count
    while done < coarse.contacts.shape[1] and left * _FEW > count:
        until = min(done + _CHUNK, coarse.contacts.shape[1])
        for n in range(done, until):
            add_contact(coarse, n, best, count)
        done, left = until, _left(scores, limit, count)
    if left * _FEW > count:
        turn_back(coarse.voxels, lanes, count)
    while inside < coarse.inside.shape[1] and left * _FEW > count:
        until = min(inside + _INSIDE_CHUNK, coarse.inside.shape[1])
        for n in range(inside, until):
            add_inside(coarse, n, best, count)
        inside, left = until, _left(scores, limit, count)
    for i in range(count):
        if scores[i] <= limit:
            total = score_below(coarse, i, done, inside, np.int64(scores[i]), limit, best)
            key = (total << 32) + (number + i)
            if total <= limit and (best.size[0] < most or key < best.keys[0]):
                _put(best, key, i)
                limit = _limit(best)


@leaf
def _left(scores, limit, count):
    """How many poses may still be among the best."""
    left = 0
    for i in range(count):
        left += 1 if scores[i] <= limit else 0
    return left


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
