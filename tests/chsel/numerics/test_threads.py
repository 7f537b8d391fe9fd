from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
import warnings
from typing import Any

import numpy as np
import pytest
import torch

from chsel import KnownPoints, SdfGrid
from chsel.cost.compiled_cost import CompiledCost
from chsel.errors import EngineError, SettingError
from chsel.numerics import threads as numerics_threads
from chsel.numerics.threads import require_threads, spread
from chsel.numerics.threads import threads as use_threads

PATIENCE = 20.0  # seconds until what should have ended long ago counts as stuck


@pytest.fixture(autouse=True)
def no_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    """No number of threads is set, as a command that ran in this process may have done."""
    monkeypatch.setattr(numerics_threads._setting, "count", None)


def no_scratch() -> None:
    return None


@pytest.mark.parametrize("count", [0, 1, 2, 3, 7, 8, 9, 100, 1001])
def test_pieces_cover_the_range_once(threads: int, count: int) -> None:
    done: list[int] = []
    spread(lambda first, last, _: done.extend(range(first, last)), count, no_scratch)
    assert sorted(done) == list(range(count))


@pytest.mark.parametrize("count", [0, -1, 257, 10_000, 1.0, True])
def test_a_number_of_threads_that_cannot_be_meant_is_refused(count: Any) -> None:
    before = torch.get_num_threads()
    with (
        pytest.raises(SettingError, match=rf"threads is {count}; accepted: .* from 1 to 256"),
        use_threads(count),
    ):
        pass
    assert torch.get_num_threads() == before
    require_threads("threads", 256)


SETTINGS = """
import sys
from chsel.numerics.threads import set_threads, thread_count, threads
seen = [thread_count()]
with threads(2):
    seen.append(thread_count())
seen.append(thread_count())
assert "torch" not in sys.modules
import torch
torch.set_num_threads(4)
seen.append(thread_count())
with threads(2):
    seen += [thread_count(), torch.get_num_threads()]
seen.append(torch.get_num_threads())
set_threads(6)
print(*seen, thread_count(), torch.get_num_threads())
"""


def test_the_number_of_threads_is_what_was_set_or_that_of_torch_or_openmp() -> None:
    command = [sys.executable, "-c", SETTINGS]
    environment = {**os.environ, "OMP_NUM_THREADS": "3,1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert (done.stdout, done.stderr) == ("3 2 3 4 2 2 4 6 6\n", "")


def test_every_thread_works_in_scratch_of_its_own(threads: int) -> None:
    made: list[set[int]] = []
    used: set[int] = set()

    def scratch() -> set[int]:
        made.append(set())
        return made[-1]

    def run(first: int, last: int, own: set[int]) -> None:
        own.add(threading.get_ident())
        used.add(id(own))
        time.sleep(0.002)  # so that all threads get some work

    spread(run, 200, scratch)
    assert len(made) <= threads
    assert all(len(own) <= 1 for own in made)
    assert len(used) == threads


def test_a_thread_that_is_too_late_for_any_piece_is_not_awaited() -> None:
    done: list[int] = []
    leave = threading.Event()
    busy = numerics_threads._pool(1).submit(leave.wait, PATIENCE)
    try:
        with use_threads(2):
            spread(lambda first, last, _: done.extend(range(first, last)), 100, no_scratch)
        assert not busy.done()
    finally:
        leave.set()
    assert done == list(range(100))


def test_an_error_in_a_piece_reaches_the_caller_and_the_next_call_works(threads: int) -> None:
    def run(first: int, last: int, _: Any) -> None:
        if first <= 57 < last:
            raise ValueError("piece with 57")

    with pytest.raises(ValueError, match="piece with 57"):
        spread(run, 100, no_scratch)
    test_pieces_cover_the_range_once(threads, 100)


def test_work_may_spread_work(threads: int) -> None:
    sums = np.zeros(12)

    def outer(first: int, last: int, _: Any) -> None:
        for n in range(first, last):

            def inner(start: int, stop: int, _: Any, n: int = n) -> None:
                for i in range(start, stop):
                    parts[n, i] = n + i

            spread(inner, 20, no_scratch)
            sums[n] = parts[n].sum()

    parts = np.zeros((12, 20))
    caller = threading.Thread(target=lambda: spread(outer, 12, no_scratch), daemon=True)
    in_caller = torch.get_num_threads()
    caller.start()
    caller.join(PATIENCE)
    assert not caller.is_alive(), f"stuck with {in_caller} threads"
    np.testing.assert_array_equal(sums, [20 * n + 190 for n in range(12)])


@pytest.mark.skipif(sys.platform != "linux", reason="threads inherit their rounding on Linux")
def test_a_worker_that_flushes_subnormals_is_refused() -> None:
    """A thread starts with the rounding of the thread that starts it."""
    before = torch.get_num_threads()
    torch.set_num_threads(5)  # a pool that no other test uses, before or after
    if not torch.set_flush_denormal(True):
        pytest.skip("this processor cannot flush subnormal numbers")
    try:
        with pytest.raises(EngineError, match="flushes subnormal numbers to zero"):
            spread(lambda first, last, _: None, 100, no_scratch)
    finally:
        torch.set_flush_denormal(False)
        torch.set_num_threads(before)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_forked_child_computes_what_its_parent_does() -> None:
    values = np.ones((4, 4, 4))
    values[1:3, 1:3, 1:3] = -0.1
    sdf = SdfGrid(np.zeros(3), 0.1, values, np.tile([1.0, 0.0, 0.0], (4, 4, 4, 1)))
    cost = CompiledCost(sdf, KnownPoints(np.random.default_rng(0).uniform(0.0, 0.3, (50, 3))))
    transforms = np.tile(np.eye(4), (20, 1, 1))
    transforms[:, 0, 3] = np.linspace(-0.1, 0.1, 20)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        expected = cost.evaluate(transforms)  # the pool's threads live now, and not in the child
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of forking with threads
            child = os.fork()
        if child == 0:
            same = False
            try:
                same = bool((cost.evaluate(transforms) == expected).all())
            finally:
                os._exit(0 if same else 1)
        until = time.monotonic() + PATIENCE
        ended, status = os.waitpid(child, os.WNOHANG)
        while ended == 0 and time.monotonic() < until:
            time.sleep(0.01)
            ended, status = os.waitpid(child, os.WNOHANG)
        if ended == 0:
            os.kill(child, 9)
            os.waitpid(child, 0)
        assert ended == child, "the child is stuck"
        assert os.waitstatus_to_exitcode(status) == 0
    finally:
        torch.set_num_threads(before)
    assert (expected > 0.0).any()
