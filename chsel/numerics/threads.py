"""Work spread over threads that all round as IEEE 754 specifies; no result depends on how many."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np

from chsel.errors import EngineError, SettingError
from chsel.numerics.compiler import compiled

_VALUES = np.array([5e-324, 2.3e-308, 1.0, 2.0**-55])  # an array, so that nothing is folded


def require_ieee_arithmetic() -> None:
    """Raise EngineError if this thread flushes subnormals to zero, or does not round to nearest."""
    if not _rounds_to_nearest(_VALUES):
        raise EngineError(
            "this thread does not round to the nearest number, so results would differ from those "
            "of other machines; accepted: the usual rounding mode, fesetround(FE_TONEAREST)"
        )
    if not _keeps_subnormals(_VALUES):
        raise EngineError(
            "this thread flushes subnormal numbers to zero, so results would differ from those of "
            "other machines; accepted: IEEE arithmetic (torch.set_flush_denormal(False), and no "
            "library built with -ffast-math)"
        )


@compiled
def _keeps_subnormals(values: Any) -> Any:
    """Whether subnormal operands, and subnormal results, differ from zero."""
    return values[0] > 0.0 and values[1] * 0.25 > 0.0


@compiled
def _rounds_to_nearest(values: Any) -> Any:
    """Rounding up would raise the sum; rounding down or towards zero, lower the difference."""
    return values[2] + values[3] == values[2] and values[2] - values[3] == values[2]


MOST_THREADS = 256  # of a process, or processes of a command; a larger number is a mistake
_PIECES_PER_THREAD = 4  # so that no thread waits long for another
_thread = threading.local()


def spread(
    run: Callable[[int, int, Any], None],
    count: int,
    scratch: Callable[[], Any],
    *,
    least: int = 1,
) -> None:
    """Call run(first, last, scratch) on pieces of range(count), on as many threads as torch uses.

    scratch: makes the scratch of one thread. The pieces must not depend on each other. least: the
    smallest number that is worth another thread.
    """
    import torch

    most = min(torch.get_num_threads(), count // least)
    if most <= 1 or hasattr(_thread, "is_worker"):  # it must not wait for workers
        if count:
            run(0, count, scratch())
        return
    size = -(-count // (most * _PIECES_PER_THREAD))
    pieces = iter(range(0, count, size))

    def work() -> None:
        require_ieee_arithmetic()
        mine = scratch()
        for first in pieces:
            run(first, min(first + size, count), mine)

    others = [_pool(most - 1).submit(work) for _ in range(most - 1)]
    try:
        work()
    finally:
        wait(others)
    for other in others:
        other.result()


def require_threads(name: str, count: object) -> None:
    """Raise SettingError unless `count` is a sensible number of threads or processes."""
    if type(count) is not int or not 1 <= count <= MOST_THREADS:
        raise SettingError(f"{name} is {count!r}; accepted: an integer from 1 to {MOST_THREADS}")


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Use `count` threads within this context, in torch and in the kernels.

    Raises SettingError unless it is an integer from 1 to MOST_THREADS.
    """
    require_threads("threads", count)
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@cache
def _pool(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="chsel", initializer=_become_worker)


def _become_worker() -> None:
    _thread.is_worker = True


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork
