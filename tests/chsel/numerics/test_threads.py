"""Work shared out to threads: each piece once, errors reach the caller, IEEE arithmetic."""

import ctypes
import os
import platform
import subprocess
import sys
import threading

import numpy as np
import pytest
import torch

import chsel
from chsel.errors import EngineError, SettingError
from chsel.numerics import threads as numerics_threads
from chsel.numerics.threads import parallel_for, require_ieee_arithmetic
from chsel.numerics.threads import threads as use_threads
from tests.chsel.samples import ball_grid

# fesetround's argument, from the C library's <fenv.h>
MODES = {
    "x86_64": {"down": 0x400, "up": 0x800, "towards zero": 0xC00},
    "aarch64": {"down": 0x800000, "up": 0x400000, "towards zero": 0xC00000},
}.get(platform.machine(), {})
NEAREST = 0


@pytest.fixture(autouse=True)
def no_setting(monkeypatch):
    """No number of threads is set, as a command that ran in this process may have done."""
    monkeypatch.setattr(numerics_threads._setting, "count", None)


def no_scratch():
    return None


@pytest.mark.parametrize(("multiple", "least"), [(1, 1), (8, 1), (1, 3)])
@pytest.mark.parametrize("count", [0, 1, 3, 8, 9, 1001])
def test_pieces_cover_the_range_once(threads, count, multiple, least):
    done, starts = [], []

    def run(first, last, _):
        starts.append(first)
        done.extend(range(first, last))

    parallel_for(run, count, scratch=no_scratch, least=least, multiple=multiple)
    assert sorted(done) == list(range(count))
    assert all(first % multiple == 0 for first in starts)


@pytest.mark.parametrize("count", [0, 257, 1.0, True])
def test_a_number_of_threads_that_cannot_be_meant_is_refused(count):
    message = rf"threads is {count}; accepted: .* from 1 to 256"
    with pytest.raises(SettingError, match=message), use_threads(count):
        pass


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
set_threads(6)
print(*seen, thread_count())
"""


def test_the_number_of_threads_is_what_was_set_or_that_of_torch_or_openmp():
    command = [sys.executable, "-c", SETTINGS]
    environment = {**os.environ, "OMP_NUM_THREADS": "3,1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert (done.stdout, done.stderr) == ("3 2 3 4 6\n", "")


def test_every_thread_works_in_scratch_of_its_own(threads):
    """No thread goes on before all have begun."""
    begun = threading.Barrier(threads)
    used = {}
    kept = []

    def run(first, last, own):
        if threading.get_ident() not in used:
            used[threading.get_ident()] = set()
            begun.wait()
        used[threading.get_ident()].add(id(own))

    parallel_for(run, 200, scratch=lambda: kept.append(object()) or kept[-1])
    assert [len(own) for own in used.values()] == [1] * threads
    assert len(set.union(*used.values())) == threads


def test_an_error_in_a_piece_reaches_the_caller(threads):
    def run(first, last, _):
        if first <= 57 < last:
            raise ValueError("piece with 57")

    with pytest.raises(ValueError, match="piece with 57"):
        parallel_for(run, 100, scratch=no_scratch)


@pytest.mark.skipif(sys.platform != "linux", reason="threads inherit their rounding on Linux")
def test_arithmetic_that_flushes_subnormals_is_refused():
    """A thread starts with the rounding of the thread that starts it."""
    if not torch.set_flush_denormal(True):
        pytest.skip("this processor cannot flush subnormal numbers")
    try:
        with pytest.raises(EngineError, match="flushes subnormal numbers to zero"):
            require_ieee_arithmetic()
        with pytest.raises(EngineError, match="flushes subnormal"), use_threads(2):
            parallel_for(lambda first, last, _: None, 100, scratch=no_scratch)
    finally:
        torch.set_flush_denormal(False)


def register():
    points = {"contacts": np.array([[0.025, 0.0, 0.0]]), "free": np.array([[0.1, 0.0, 0.0]])}
    settings = {"descent": {"restarts": 1, "iterations": 1}, "emitter": {"iterations": 1}}
    chsel.register(ball_grid(0.025, 0.01, half=4), **points, method="chsel", settings=settings)


@pytest.mark.skipif(not MODES or platform.system() != "Linux", reason="fesetround's values differ")
@pytest.mark.parametrize("mode", MODES)
def test_nothing_runs_with_another_rounding(mode):
    library = ctypes.CDLL(None)
    for act in (require_ieee_arithmetic, register):
        act()
        assert library.fesetround(MODES[mode]) == 0
        try:
            with pytest.raises(EngineError, match="does not round to the nearest number"):
                act()
        finally:
            library.fesetround(NEAREST)
