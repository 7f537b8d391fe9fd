"""The best of many poses by a coarse score.

Blocks of poses are scored together, one in each lane of vector instructions, by contacts, then by
points inside of the object; once few may be among the best, these go on alone, points in lanes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.methods.anchored.placing_kernels import (
    DRAWN,
    DRAWS,
    LANES,
    ROWS,
    SHIFT,
    ZERO,
    place,
)
from chsel.methods.anchored.scoring_kernels import (
    HIGHEST,
    add_contact,
    add_inside,
    score_below,
    turn_back,
)
from chsel.numerics.arrays import IntArray, scratch
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.philox import fill_uniforms
from chsel.numerics.team import increase, load

_DRAWN_AT_ONCE = 65_536  # poses for which a stream has all first numbers, then all second ones, ...
_CHUNK = 4  # contacts that a block is scored by at a time
_INSIDE_CHUNK = 8  # points inside
_GRADES = 432  # classes of scores, each up to 1/16 wider than the lowest of its scores
_FEW = 8  # poses go on alone when at most the eighth part of a block is left


class Best(NamedTuple):
    """The best poses so far, and scratch of one thread."""

    size: IntArray  # (1,), how many there are
    keys: IntArray  # (K,), a heap with the worst first: 2^32 x score + number among all drawn
    slots: IntArray  # (K,), where the pose of each is
    poses: Any  # (K, 12)
    grades: IntArray  # (_GRADES,), how many poses of each class all threads have kept
    draws: Any  # (DRAWS DRAWN,), random numbers of a block
    lanes: Any  # rows of a block, one after the other
    cells: Any  # (LANES,), indices in a table
    found: Any  # (LANES,), what was read there
    scores: Any  # (LANES,)


def grades() -> IntArray:
    """What threads that look for the best of the same poses share."""
    return scratch(_GRADES, dtype=np.int64)


def best_for(most: int, grades: IntArray) -> Best:
    """No poses yet, and room for `most`. grades: of all threads."""
    cells, found, scores = (scratch(LANES, dtype=np.int32) for _ in range(3))
    keys, slots = (scratch(most, dtype=np.int64) for _ in range(2))
    draws, lanes = (scratch(n, dtype=np.float32) for n in (DRAWS * DRAWN, ROWS * LANES))
    size, poses = scratch(1, dtype=np.int64), scratch(most, 12, dtype=np.float32)
    return Best(size, keys, slots, poses, grades, draws, lanes, cells, found, scores)


@compiled
def sample(coarse, anchors, stream, samples, first, last, best):
    """Keep the best of the poses from number `first` to before `last` of those that are drawn.

    Kept are those of the lowest scores, and of equal ones the first, so that the result does not
    depend on how all `samples` are split.
    """
    number = first
    while number < last:
        together = number // _DRAWN_AT_ONCE * _DRAWN_AT_ONCE
        size = min(_DRAWN_AT_ONCE, samples - together)
        count = min(min(last, together + size) - number, LANES)
        for until in anchors.kinds:
            if number < until:
                count = min(count, until - number)
        for row in range(DRAWS):
            at = DRAWS * together + row * size + number - together
            fill_uniforms(stream, at, best.draws, row * DRAWN, count)
        place(anchors, best.draws, count, number, best.lanes)
        _keep_best(coarse, anchors, number, count, best)
        number += count


@inner
def _keep_best(coarse, anchors, number, count, best):
    """Score a block of poses, and keep those that are among the best so far."""
    most, lanes, scores = len(best.keys), best.lanes, best.scores
    _check_origins(anchors, lanes, scores, count)
    limit = min(_limit(best), _common_limit(best))
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
                increase(best.grades, _grade(total))
                limit = min(limit, _limit(best))


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


@leaf
def _grade(score):
    """The class of a score."""
    halved = np.int64(0)
    while score >= 32:
        score >>= 1
        halved += 1
    return 16 * halved + score


@inner
def _common_limit(best):
    """A score that as many poses as are wanted do not exceed, of those of all threads."""
    count = np.int64(0)
    for grade in range(_GRADES):
        count += load(best.grades, grade)
        if count >= len(best.keys):
            halved = np.int64(max(grade // 16 - 1, 0))
            return ((grade - 16 * halved + 1) << halved) - 1
    return np.int64(HIGHEST - 1)


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
