"""Threads that share out pieces of work inside of kernels, within microseconds.

One of them leads: it publishes rounds of pieces, and goes on when all pieces of a round are done.
The others help where they can. Each computes a piece into scratch of its own, all to the same bits,
and the first that has done so writes the results. So the leader waits for nobody: where a helper
has lost its processor, the leader computes that piece, too.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import extending
from numba.core import types

from chsel.numerics.arrays import IntArray
from chsel.numerics.compiler import inner, leaf

MOST_PIECES = 64  # of a round
NONE = -1  # no piece is left
IDLE = 10_000  # polls, some 100 us, before a helper that has nothing to do returns to Python
OPEN, CLAIMED, WRITTEN, DONE = range(4)  # what becomes of a piece
STATES = 4
APART = 16  # numbers between two words, so that no cache line holds both
_intrinsic: Any = extending.intrinsic
_ROUND, _PIECES = 0, APART  # words: the round, and the state of the first piece
_PATIENCE = 2_000  # polls for a claimed piece before the leader computes it, too
_MOST_PATIENCE = 1_000_000


class Team(NamedTuple):
    """What the threads of a team agree by."""

    words: IntArray  # the round, then for each piece STATES times its round, and its state
    patience: IntArray  # (1,), of the leader, polls


def new_team() -> Team:
    """A team that has no work yet."""
    words = np.zeros(_PIECES + MOST_PIECES * APART, dtype=np.int64)
    return Team(words, np.array([_PATIENCE]))


def close(team: Team) -> None:
    """Let those who wait for a round return."""
    team.words[_ROUND] = -1


def piece_size(count: int, multiple: int) -> int:
    """Of how many of `count` items a piece should be, a multiple of a number."""
    return -(-count // (multiple * MOST_PIECES)) * multiple


@_intrinsic
def load(context: Any, words: Any, at: Any) -> Any:
    """words[at], as other threads have written it, with all that they have written before."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        place = _place(context, builder, signature.args[0], *values)
        return builder.load_atomic(place, "seq_cst", 8, typ=ir.IntType(64))

    return types.int64(words, types.int64), generate


@_intrinsic
def store(context: Any, words: Any, at: Any, value: Any) -> Any:
    """Set words[at] for other threads to read, after all that this one has written."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        place = _place(context, builder, signature.args[0], *values[:2])
        builder.store_atomic(values[2], place, "seq_cst", 8)
        return context.get_dummy_value()

    return types.void(words, types.int64, types.int64), generate


@_intrinsic
def replace(context: Any, words: Any, at: Any, old: Any, new: Any) -> Any:
    """Set words[at] if it has the old value; whether it had."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        place = _place(context, builder, signature.args[0], *values[:2])
        both = builder.cmpxchg(place, values[2], values[3], "seq_cst", "seq_cst")
        return builder.extract_value(both, 1)

    return types.boolean(words, types.int64, types.int64, types.int64), generate


@_intrinsic
def pause(context: Any) -> Any:
    """Take some 10 ns without work for the processor's units."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(), generate


def _place(context: Any, builder: Any, kind: Any, words: Any, at: Any) -> Any:
    return builder.gep(context.make_array(kind)(context, builder, words).data, [at])


@leaf
def _place_of(piece):
    return _PIECES + piece * APART


@inner
def publish(team, pieces):
    """Begin a round of so many pieces, for the leader; returns its number."""
    number = (load(team.words, _ROUND) >> 8) + 1
    for piece in range(pieces):
        store(team.words, _place_of(piece), number * STATES + OPEN)
    store(team.words, _ROUND, (number << 8) + pieces)
    return number


@inner
def claimed(team, number, pieces, leads):
    """A piece of a round to compute next, or NONE.

    The leader gets NONE when all are done, a helper when all are claimed. They begin at opposite
    ends.
    """
    state = number * STATES
    for n in range(pieces):
        piece = n if leads else pieces - 1 - n
        at = _place_of(piece)
        is_open = load(team.words, at) == state + OPEN
        if is_open and replace(team.words, at, state + OPEN, state + CLAIMED):
            return piece
    if leads:
        for piece in range(pieces):
            if not _is_awaited(team, number, piece):
                return piece
    return NONE


@inner
def _is_awaited(team, number, piece):
    """Wait until a piece is done; False if that takes too long."""
    words, at, state = team.words, _place_of(piece), number * STATES
    polls = 0
    while load(words, at) != state + DONE:
        polls += 1
        if polls > team.patience[0] and load(words, at) == state + CLAIMED:
            return False
        pause()
    return True


@inner
def is_first(team, number, piece, leads):
    """Whether this thread is to write the results of a piece; then call `done`.

    The leader is more patient after it has computed in vain.
    """
    state = number * STATES
    if replace(team.words, _place_of(piece), state + CLAIMED, state + WRITTEN):
        return True
    if leads:
        team.patience[0] = min(2 * team.patience[0], _MOST_PATIENCE)
    return False


@leaf
def done(team, number, piece):
    """The results of a piece are written."""
    store(team.words, _place_of(piece), number * STATES + DONE)


@inner
def awaited(team, number):
    """The round after that of a number, for a helper: its number and pieces; 0, 0 if none comes."""
    for _ in range(IDLE):
        word = load(team.words, _ROUND)
        if word >> 8 != number:
            return word >> 8, word & 255
        pause()
    return 0, 0
