"""Work spread over threads that all round as IEEE 754 specifies; no result depends on how many."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from typing import Any

from chsel.errors import EngineError, SettingError

_SMALLEST, _SMALL, _ONE, _TINY = 5e-324, 2.3e-308, 1.0, 2.0**-55


def require_ieee_arithmetic() -> None:
    """Raise EngineError if this thread flushes subnormals to zero, or does not round to nearest."""
    if not _rounds_to_nearest(_ONE, _TINY):
        raise EngineError(
            "this thread does not round to the nearest number, so results would differ from those "
            "of other machines; accepted: the usual rounding mode, fesetround(FE_TONEAREST)"
        )
    if not _keeps_subnormals(_SMALLEST, _SMALL):
        raise EngineError(
            "this thread flushes subnormal numbers to zero, so results would differ from those of "
            "other machines; accepted: IEEE arithmetic (torch.set_flush_denormal(False), and no "
            "library built with -ffast-math)"
        )


def _keeps_subnormals(smallest: float, small: float) -> bool:
    """Whether subnormal operands, and subnormal results, differ from zero."""
    return smallest > 0.0 and small * 0.25 > 0.0


def _rounds_to_nearest(one: float, tiny: float) -> bool:
    """Rounding up would raise the sum; rounding down or towards zero, lower the difference."""
    return one + tiny == one and one - tiny == one


MOST_THREADS = 256  # of a process, or processes of a command; a larger number is a mistake
_PIECES_PER_THREAD = 4  # so that no thread waits long for another
_thread = threading.local()


def spread(
    run: Callable[[int, int, Any], None],
    count: int,
    scratch: Callable[[], Any],
    *,
    least: int = 1,
    multiple: int = 1,
) -> None:
    """Call run(first, last, scratch) on pieces of range(count), on `thread_count()` threads.

    scratch: makes the scratch of one thread. The pieces must not depend on each other. least: the
    smallest number that is worth another thread, or a piece. multiple: of which the size of pieces
    is one.
    """
    most = min(thread_count(), count // least)
    if most <= 1 or hasattr(_thread, "is_worker"):  # it must not wait for workers
        if count:
            run(0, count, scratch())
        return
    size = max(least, -(-count // (most * _PIECES_PER_THREAD)))
    size = -(-size // multiple) * multiple
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
        others = [other for other in others if not other.cancel()]  # one that is late is not needed
        wait(others)
    for other in others:
        other.result()


def require_threads(name: str, count: object) -> None:
    """Raise SettingError unless `count` is a sensible number of threads or processes."""
    if type(count) is not int or not 1 <= count <= MOST_THREADS:
        raise SettingError(f"{name} is {count!r}; accepted: an integer from 1 to {MOST_THREADS}")


def thread_count() -> int:
    """How many threads kernels use: what was set here, else what torch uses where it is imported.

    Else what torch would use: OMP_NUM_THREADS, or one for each core that this process may use.
    """
    if _setting.count is not None:
        return _setting.count
    torch = _imported_torch()
    return core_count() if torch is None else int(torch.get_num_threads())


def core_count() -> int:
    """OMP_NUM_THREADS, or how many cores this process may use."""
    named = os.environ.get("OMP_NUM_THREADS", "").split(",")[0].strip()
    if named.isdecimal() and int(named) >= 1:
        return min(int(named), MOST_THREADS)
    return min(_processors(), MOST_THREADS)


def _processors() -> int:
    """How many of them this process may use."""
    count = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count()
    return count or 1


def set_threads(count: int) -> None:
    """Use `count` threads from now on, in the kernels and, where it is imported, in torch.

    Raises SettingError unless it is an integer from 1 to MOST_THREADS.
    """
    require_threads("threads", count)
    _setting.count = count
    torch = _imported_torch()
    if torch is not None:
        torch.set_num_threads(count)


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Use `count` threads within this context. See set_threads."""
    before, torch = _setting.count, _imported_torch()
    in_torch = torch.get_num_threads() if torch is not None else None
    set_threads(count)
    try:
        yield
    finally:
        _setting.count = before
        if torch is not None:
            torch.set_num_threads(in_torch)


class _Setting:
    """The number of threads of this process, if one was set."""

    count: int | None = None


_setting = _Setting()


def _imported_torch() -> Any:
    """The module torch if it is imported, and to the end: importing it takes seconds."""
    torch = sys.modules.get("torch")
    return torch if hasattr(torch, "set_num_threads") else None


@cache
def _pool(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="chsel", initializer=_become_worker)


def _become_worker() -> None:
    _thread.is_worker = True


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork
