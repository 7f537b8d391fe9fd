"""Descents by Adam, block by block, of several threads on several groups of poses.

A group is of up to LANES poses, which descend together. A thread takes whichever group has the
fewest blocks behind it, so that none waits for another until the end.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.cost.cost_kernels import evaluate, forget, gradient_of, put_pose
from chsel.cost.free_kernels import MOST_SLACK
from chsel.cost.pose_lanes import LANES, SUMS
from chsel.numerics.arrays import FloatArray, IntArray, scratch
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.pose_tuples import decode, pull_back
from chsel.numerics.team import (
    APART,
    CLAIMED,
    IDLE,
    NONE,
    OPEN,
    STATES,
    WRITTEN,
    load,
    pause,
    replace,
    store,
)

BETA1, BETA2 = 0.9, 0.999
EPSILON = 1e-8
_LIMIT = 0  # word: blocks that may begin
_GROUPS = APART  # of the first group: STATES times the blocks that it has behind it, and its state
_FEWEST = 3  # poses that are worth a group, on average
_PATIENCE = 2_000  # polls for a claimed group before the leader computes its block, too


class Course(NamedTuple):
    """Descents of S search vectors by K blocks of iterations, and how far they are."""

    vectors: FloatArray  # (K + 1, S, d), at the start and after each block
    costs: FloatArray  # (K + 1, S), of these
    iterations: int  # of a block; Adam starts anew in each
    rate: float
    divisor: float  # of gradients
    # A block: costs are known, and unless it is of no iterations, rotations are orthonormal again.
    ends_on_poses: bool
    stop_below: float  # mean relative gain of a block below which none of the next begins
    firsts: IntArray  # (G + 1,), the first vector of each group, then S
    words: IntArray  # what threads agree by


def course_from(
    vectors: FloatArray,
    costs: FloatArray,
    blocks: int,
    *,
    threads: int = 1,
    iterations: int = 0,
    rate: float = 0.0,
    divisor: float = 1.0,
    ends_on_poses: bool = False,
    stop_below: float | None = None,
) -> Course:
    """The course before its first block, from vectors (S, d) with costs (S,).

    threads: that share it.
    """
    count, dimension = vectors.shape
    firsts = groups_for(count, threads)
    course = Course(
        np.empty((blocks + 1, count, dimension)),
        np.empty((blocks + 1, count)),
        iterations,
        float(rate),
        float(divisor),
        ends_on_poses,
        -np.inf if stop_below is None else float(stop_below),
        firsts,
        scratch(_GROUPS + (len(firsts) - 1) * APART, dtype=np.int64),
    )
    course.vectors[0], course.costs[0], course.words[_LIMIT] = vectors, costs, blocks
    return course


def groups_for(count: int, threads: int) -> IntArray:
    """The first of so many poses in each group, then their number.

    As many whole groups for each thread as there can be; the rest in one for each, unless too few.
    """
    rest = count % (LANES * threads)
    last = threads if _FEWEST * threads <= rest else -(-rest // LANES)
    whole = np.arange(0, count - rest, LANES)
    return np.concatenate([whole, count - rest + rest * np.arange(last + 1) // max(last, 1)])


def blocks_done(course: Course) -> int:
    """How many blocks all groups have behind them."""
    blocks = len(course.vectors) - 1
    return int(course.words[_GROUPS::APART].min(initial=blocks * STATES)) // STATES


def abandon(course: Course) -> None:
    """Let all threads leave it."""
    course.words[_LIMIT] = 0


@leaf
def adam_step(slope, moments, j, powers, rate, epsilon):
    """The step down a slope along coordinate j (Kingma and Ba, 2015); updates moments (2, d).

    powers: beta_1 and beta_2 to the power of the number of steps, this one included.
    """
    moments[0, j] = BETA1 * moments[0, j] + (1.0 - BETA1) * slope
    moments[1, j] = BETA2 * moments[1, j] + (1.0 - BETA2) * slope * slope
    step = rate * (moments[0, j] / (1.0 - powers[0]))
    return step / (np.sqrt(moments[1, j] / (1.0 - powers[1])) + epsilon)


@compiled
def descend(model, space, course, work, leads):
    """Take part in a course: the leader until all blocks are done, others while there is work."""
    words, dimension = course.words, course.vectors.shape[2]
    moved, moments = np.empty((LANES, dimension)), np.empty((LANES, 2, dimension))
    gradient, polls = np.empty(dimension), 0
    while True:
        group, is_open = _least_advanced(course, True), True
        if group == NONE:
            group, is_open = _least_advanced(course, False), False
            if group == NONE:
                return
            polls += 1
            if polls < (_PATIENCE if leads else IDLE):
                pause()
                continue
            if not leads:
                return
        at = _GROUPS + group * APART
        state = load(words, at) // STATES * STATES
        if state // STATES >= load(words, _LIMIT):  # another thread was faster
            continue
        if is_open and not replace(words, at, state + OPEN, state + CLAIMED):
            continue
        polls = 0
        block, (first, last) = state // STATES, _members(course, group)
        if not _descend_block(model, space, course, group, block, work, moved, moments, gradient):
            continue
        if replace(words, at, state + CLAIMED, state + WRITTEN):
            for lane in range(last - first):
                course.costs[block + 1, first + lane] = work.lanes[SUMS + lane]
                for j in range(dimension):
                    course.vectors[block + 1, first + lane, j] = moved[lane, j]
            store(words, at, state + STATES + OPEN)
            _stop_if_converged(course, block)


@leaf
def _members(course, group):
    """The first pose of a group, and that after its last."""
    return course.firsts[group], course.firsts[group + 1]


@inner
def _least_advanced(course, is_open):
    """The group with the fewest blocks behind it, of those that are open or not; NONE if none is.

    A group that no block may begin of counts as neither.
    """
    words, found = course.words, NONE
    least = load(words, _LIMIT)
    for group in range(len(words) // APART - 1):
        word = load(words, _GROUPS + group * APART)
        if word // STATES < least and (word % STATES == OPEN) == is_open:
            found, least = group, word // STATES
    return found


@inner
def _descend_block(model, space, course, group, block, work, moved, moments, gradient):
    """Move a group by a block, from where it was; False if another thread has done so, or ends it.

    Fills the vectors moved (LANES, d), and the costs in `work` if the block ends on poses.
    """
    words, at, claimed = course.words, _GROUPS + group * APART, block * STATES + CLAIMED
    first, last = _members(course, group)
    count, dimension = last - first, course.vectors.shape[2]
    for lane in range(count):
        for j in range(dimension):
            moved[lane, j] = course.vectors[block, first + lane, j]
            moments[lane, 0, j] = moments[lane, 1, j] = 0.0
    power1 = power2 = 1.0
    forget(work)
    for _ in range(course.iterations):
        if load(words, at) != claimed or load(words, _LIMIT) <= block:
            return False
        for lane in range(count):
            put_pose(work.lanes, lane, decode(space, moved[lane]))
        evaluate(model, work, 0, count, MOST_SLACK)
        power1 *= BETA1
        power2 *= BETA2
        for lane in range(count):
            pull_back(space, moved[lane], gradient_of(work.lanes, lane), gradient)
            for j in range(dimension):
                slope = gradient[j] / course.divisor
                powers = power1, power2
                step = adam_step(slope, moments[lane], j, powers, course.rate, EPSILON)
                moved[lane, j] -= step
    if course.ends_on_poses:
        for lane in range(count):
            if course.iterations > 0:
                pose = decode(space, moved[lane])
                for j in range(6):
                    moved[lane, j] = pose[j]
            put_pose(work.lanes, lane, decode(space, moved[lane]))
        evaluate(model, work, 0, count, 0.0)
    return True


@inner
def _stop_if_converged(course, block):
    """Let no further block begin if this one has ended, and gains too little.

    Whether it does is for the caller to say, to the last bit.
    """
    words, costs, total = course.words, course.costs, 0.0
    count = costs.shape[1]
    for group in range(len(words) // APART - 1):
        if load(words, _GROUPS + group * APART) // STATES <= block:
            return
    for n in range(count):
        before = costs[block, n]
        if before > 0.0:
            total += (before - costs[block + 1, n]) / before
    bound = course.stop_below
    if total / count <= bound + 1e-9 * abs(bound) + 1e-15:
        store(words, _LIMIT, min(load(words, _LIMIT), block + 1))
