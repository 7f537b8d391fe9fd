"""How the inner loops are compiled."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numba
from filelock import FileLock
from numba.core import event

from chsel.kernels.cache_directory import cache_directory, has_kernels

Function = TypeVar("Function", bound=Callable[..., Any])

config: Any = numba.core.config
_njit: Any = numba.njit  # its types leave out some options
_log = logging.getLogger(__name__)


def compiled(function: Function) -> Function:
    """`function` as machine code: made on the first call, kept on disk, free of the GIL.

    No fast-math and no contraction, so that a * b + c is rounded twice on every CPU.
    """
    previous = config.CACHE_DIR
    config.CACHE_DIR = str(cache_directory())
    try:
        made: Any = _njit(cache=True, nogil=True, error_model="numpy")(function)
        made._cache.save_overload = _one_at_a_time(made._cache.save_overload)
        return made
    finally:
        config.CACHE_DIR = previous


def _one_at_a_time(save: Callable[..., None]) -> Callable[..., None]:
    """Saving that waits for other processes.

    Numba reads the index of a kernel, names a file of machine code and writes both. Two processes
    at once, with different types of arguments, would give their code the same name.
    """

    def locked(*arguments: Any) -> None:
        with FileLock(cache_directory() / "saving.lock"):
            save(*arguments)

    return locked


def inner(function: Function) -> Function:
    """`function` for other kernels to call, not for Python.

    It cannot make arrays, so that nothing is counted when arrays change hands.
    """
    made: Function = _njit(**_INNER)(function)
    return made


def leaf(function: Function) -> Function:
    """Like `inner`, and always made part of its caller."""
    made: Function = _njit(**_INNER, forceinline=True)(function)
    return made


def spliced(function: Function) -> Function:
    """Like `leaf`, for a few lines around a large function: put into its caller before it is typed.

    It is no function of its own to the compiler, which saves it going over the large one again.
    """
    made: Function = _njit(**_INNER, inline="always")(function)
    return made


_INNER = {
    "nogil": True,
    "error_model": "numpy",
    "_nrt": False,
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}


@contextmanager
def watched(show: Callable[[int], None]) -> Iterator[None]:
    """Call `show` with the number of kernels compiled meanwhile, in place of the notice.

    It is called when the compilation of the first begins, with 0, and after each.
    """
    _watch.count, _watch.show = 0, show
    try:
        yield
    finally:
        _watch.show = None


class _CompilerWatch(event.Listener):
    """Reports that kernels are being compiled, and has short vectors made of straight code.

    Numba leaves the latter out unless it is switched on for the whole process; it makes the
    interpolation of the SDF twice as fast, and changes no bit, as it reorders nothing.
    """

    def __init__(self) -> None:
        self.count = 0
        self.show: Callable[[int], None] | None = None
        self._noticed = False
        self._depth = 0
        self._usual = config.SLP_VECTORIZE

    def on_start(self, event: Any) -> None:
        """The compilation of a function, or of one that it calls, begins."""
        if not _is_kernel(event):
            return
        if self._depth == 0:
            self._usual, config.SLP_VECTORIZE = config.SLP_VECTORIZE, 1
            self._report()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """The compilation of a function has ended."""
        if not _is_kernel(event):
            return
        self._depth -= 1
        if self._depth == 0:
            config.SLP_VECTORIZE = self._usual
            self.count += 1
            if self.show is not None:
                self.show(self.count)

    def _report(self) -> None:
        """To whoever watches; else in a single line for the whole process."""
        if self.show is not None:
            if self.count == 0:
                self.show(0)
        elif not self._noticed:
            place = cache_directory().parent
            if has_kernels():
                _log.warning("compiling the kernels that are still missing (kept in %s)", place)
            else:
                text = "compiling the kernels for this CPU, once: up to a minute (kept in %s)"
                _log.warning(text, place)
        self._noticed = True


def _is_kernel(event: Any) -> bool:
    module: str = event.data["dispatcher"].py_func.__module__
    return module.startswith("chsel.kernels.")


_watch = _CompilerWatch()
event.register("numba:compile", _watch)
