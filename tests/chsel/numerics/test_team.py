"""Rounds of pieces, shared out among threads some of which may never come back."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import numba
import numpy as np
import pytest
import torch

from chsel.errors import EngineError
from chsel.numerics import threads as numerics_threads
from chsel.numerics.arrays import IntArray
from chsel.numerics.team import (
    MOST_PIECES,
    NONE,
    awaited,
    claimed,
    close,
    done,
    is_first,
    new_team,
    piece_size,
    publish,
)
from chsel.numerics.threads import helped

PIECES, ROUNDS = 5, 400


@numba.njit(nogil=True)
def compute(team: Any, number: int, pieces: int, leads: bool, out: Any, written: Any) -> None:
    piece = claimed(team, number, pieces, leads)
    while piece != NONE:
        value = 0
        for n in range(100 * (piece + 1)):
            value = (value * 31 + number * 7 + n) % 1_000_003
        if is_first(team, number, piece, leads):
            out[number, piece] = value
            written[number, piece] += 1
            done(team, number, piece)
        piece = claimed(team, number, pieces, leads)


@numba.njit(nogil=True)
def lead(team: Any, rounds: int, out: Any, written: Any, complete: Any) -> None:
    for _ in range(rounds):
        number = publish(team, out.shape[1])
        compute(team, number, out.shape[1], True, out, written)
        complete[number] = np.min(written[number])


@numba.njit(nogil=True)
def assist(team: Any, out: Any, written: Any) -> None:
    number, pieces = awaited(team, 0)
    while number > 0:
        compute(team, number, pieces, False, out, written)
        number, pieces = awaited(team, number)


@numba.njit
def begin(team: Any) -> int:
    return publish(team, PIECES)


@numba.njit
def claim(team: Any, number: int) -> int:
    return claimed(team, number, PIECES, False)


@numba.njit
def may_write(team: Any, number: int, piece: int) -> bool:
    return is_first(team, number, piece, False)


def expected(numbers: IntArray) -> IntArray:
    found = np.zeros((len(numbers), PIECES), dtype=np.int64)
    for n, number in enumerate(numbers):
        for piece in range(PIECES):
            value = 0
            for i in range(100 * (piece + 1)):
                value = (value * 31 + int(number) * 7 + i) % 1_000_003
            found[n, piece] = value
    return found


def arrays(rounds: int) -> tuple[IntArray, IntArray, IntArray]:
    shape = rounds + 1, PIECES
    return np.zeros(shape, np.int64), np.zeros(shape, np.int64), np.zeros(rounds + 1, np.int64)


def test_each_piece_of_each_round_is_written_once_before_the_next(
    threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numerics_threads, "_processors", lambda: 3)
    team, (out, written, complete) = new_team(), arrays(ROUNDS)
    lead(new_team(), 1, *arrays(1))  # compiled
    help_on = lambda _: assist(team, out, written)  # noqa: E731
    with helped(help_on, lambda: None, PIECES - 1, partial(close, team)):
        lead(team, ROUNDS, out, written, complete)
    assert (written[1:] == 1).all()
    assert (complete[1:] == 1).all()
    some = np.arange(1, ROUNDS + 1, 57)
    np.testing.assert_array_equal(out[some], expected(some))


def test_nobody_waits_for_a_helper_that_has_lost_its_processor() -> None:
    team, (out, written, complete) = new_team(), arrays(4)
    number = begin(team)
    piece = claim(team, number)
    compute(team, number, PIECES, True, out, written)  # the leader, all of it
    assert (written[number] == 1).all()
    lead(team, 2, out, written, complete)
    assert not may_write(team, number, piece)
    np.testing.assert_array_equal(out[1:4], expected(np.arange(1, 4)))


def test_a_helper_returns_when_the_team_is_closed() -> None:
    team, (out, written, _) = new_team(), arrays(1)
    close(team)
    assist(team, out, written)
    assert not written.any()


@pytest.mark.parametrize("count", [1, 8, 9, 512, 513, 100_000])
def test_pieces_are_of_whole_vectors_and_not_too_many(count: int) -> None:
    size = piece_size(count, 8)
    assert size % 8 == 0
    assert -(-count // size) <= MOST_PIECES
    assert size == 8 or -(-count // (size - 8)) > MOST_PIECES


def test_an_error_of_a_helper_is_raised_in_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numerics_threads, "_processors", lambda: 2)

    def fail(_: Any) -> None:
        raise ValueError("helper")

    called: list[int] = []
    with (
        numerics_threads.threads(2),
        pytest.raises(ValueError, match="helper"),
        helped(fail, lambda: None, 1, lambda: called.append(1)),
    ):
        time.sleep(0.2)
    assert called == [1]


def test_a_helper_that_flushes_subnormals_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numerics_threads, "_processors", lambda: 8)
    helps: list[int] = []
    if not torch.set_flush_denormal(True):
        pytest.skip("this processor cannot flush subnormal numbers")
    try:
        with (
            numerics_threads.threads(7),  # a pool that no other test uses
            pytest.raises(EngineError, match="flushes subnormal numbers to zero"),
            helped(helps.append, lambda: 1, 6, lambda: None),
        ):
            time.sleep(0.2)
    finally:
        torch.set_flush_denormal(False)
    assert helps == []
