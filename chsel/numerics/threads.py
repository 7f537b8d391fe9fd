"""Work shared out to threads that round as IEEE 754 specifies; no result depends on how many."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

from chsel.errors import EngineError, SettingError

MOST_THREADS = 256  # of a process, or processes of a command; a larger number is a mistake
_SMALLEST = 5e-324
_SMALL = 2.3e-308
_ONE = 1.0
_TINY = 2.0**-55
_PIECES_PER_THREAD = 4  # so that no thread waits long for another
_setting = SimpleNamespace(count=None)


def require_ieee_arithmetic() -> None:
    """Raise EngineError if this thread flushes subnormals to zero, or does not round to nearest."""
    # Rounding up would raise the sum; rounding down or towards zero, lower the difference.
    if not _ONE + _TINY == _ONE == _ONE - _TINY:
        raise EngineError(
            "this thread does not round to the nearest number, so results would differ from those "
            "of other machines; accepted: the usual rounding mode, fesetround(FE_TONEAREST)"
        )
    if not (_SMALLEST > 0.0 and _SMALL * 0.25 > 0.0):
        raise EngineError(
            "this thread flushes subnormal numbers to zero, so results would differ from those of "
            "other machines; accepted: IEEE arithmetic (torch.set_flush_denormal(False), and no "
            "library built with -ffast-math)"
        )


def parallel_for(
    run: Callable[[int, int, Any], None],
    count: int,
    *,
    scratch: Callable[[], Any],
    least: int = 1,
    multiple: int = 1,
) -> None:
    """Call run(first, last, scratch) on pieces of range(count), on `thread_count()` threads.

    scratch: makes the scratch of one thread. The pieces must not depend on each other. least: the
    smallest number that is worth another thread, or a piece. multiple: of which the size of pieces
    is one.
    """
    workers = min(thread_count(), count // least)
    if workers <= 1:
        if count:
            run(0, count, scratch())
        return
    size = max(least, -(-count // (workers * _PIECES_PER_THREAD)))
    size = -(-size // multiple) * multiple
    pieces = iter(range(0, count, size))

    def work() -> None:
        require_ieee_arithmetic()
        mine = scratch()
        for first in pieces:
            run(first, min(first + size, count), mine)

    with ThreadPoolExecutor(workers - 1) as pool:
        others = [pool.submit(work) for _ in range(workers - 1)]
        work()
        for other in others:
            other.result()


def require_threads(name: str, count: object) -> None:
    """Raise SettingError unless `count` is a sensible number of threads or processes."""
    if type(count) is not int or not 1 <= count <= MOST_THREADS:
        raise SettingError(f"{name} is {count!r}; accepted: an integer from 1 to {MOST_THREADS}")


def thread_count() -> int:
    """Return the number of threads of kernels: set here, else as torch has it if imported.

    Else OMP_NUM_THREADS, or one for each core that this process may use.
    """
    if _setting.count is not None:
        return int(_setting.count)
    torch: Any = sys.modules.get("torch")  # importing it takes seconds
    if hasattr(torch, "get_num_threads"):
        return int(torch.get_num_threads())
    named = os.environ.get("OMP_NUM_THREADS", "").split(",")[0].strip()
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    return min(int(named) if named.isdecimal() and int(named) > 0 else cores, MOST_THREADS)


def set_threads(count: int) -> None:
    """Use `count` threads in the kernels from now on.

    Raises SettingError unless it is an integer from 1 to MOST_THREADS.
    """
    require_threads("threads", count)
    _setting.count = count


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Use `count` threads within this context. See set_threads."""
    before = _setting.count
    set_threads(count)
    try:
        yield
    finally:
        _setting.count = before
