"""How kernels are compiled."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numba
from numba.core import event
from numba.extending import overload

from chsel.numerics.kernel_cache import KernelCache, cache_directory, is_cacheable

Function = TypeVar("Function", bound=Callable[..., Any])

_config: Any = numba.core.config
_njit: Any = numba.njit  # its types leave out some options
_log = logging.getLogger(__name__)


def compiled(function: Function) -> Function:
    """`function` as machine code: compiled on the first call, kept on disk, run without the GIL.

    That of other packages is not kept: it is compiled in each process.
    Without fast-math and contraction, so that a * b + c is rounded twice on every CPU.
    """
    kernel: Any = _njit(nogil=True, error_model="numpy", no_cfunc_wrapper=True)(function)
    if is_cacheable(function):
        kernel._cache = KernelCache(function)
    return kernel


def inner(function: Function) -> Function:
    """`function` for other kernels to call, not for Python, kept as a part of these.

    It cannot make arrays, so that no references are counted when arrays are passed.
    """
    kernel: Function = _njit(**_INNER)(function)
    return kernel


def leaf(function: Function) -> Function:
    """Like `inner`, and always inlined into its caller."""
    kernel: Function = _njit(**_INNER, forceinline=True)(function)
    return kernel


def spliced(function: Function) -> Function:
    """Like `leaf`, but inlined before types are inferred.

    For a few lines around a large function, which the compiler then goes over only once.
    """
    kernel: Function = _njit(**_INNER, inline="always")(function)
    return kernel


def implements(name: Callable[..., Any], model: type) -> Callable[[Function], Function]:
    """Decorator of what kernels that call `name` run if its first argument is of type `model`.

    model: a class of NamedTuples. So one kernel, compiled for each, serves several models. Raises
    TypeError if the function is not in this package, as its changes would not be noticed.
    """

    def register(function: Function) -> Function:
        if not is_cacheable(function):
            name_of = f"{function.__module__}.{function.__name__}"
            raise TypeError(f"{name_of} is not in chsel; accepted: functions of this package")

        def chosen(first: Any, *others: Any) -> Function | None:
            return function if getattr(first, "instance_class", None) is model else None

        options: Any = {**_INNER, "forceinline": True}
        overload(name, jit_options=options, strict=False)(chosen)
        return function

    return register


_INNER = {
    "nogil": True,
    "error_model": "numpy",
    "_nrt": False,
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}


@contextmanager
def watched(show: Callable[[int], None]) -> Iterator[None]:
    """Within this context, call `show` with the number of kernels compiled, instead of the notice.

    It is called before each compilation, and after it.
    """
    _watch.count, _watch.show = 0, show
    try:
        yield
    finally:
        _watch.show = None


class _CompilerWatch(event.Listener):
    """Reports that kernels are being compiled, and vectorises their straight-line code.

    Numba has the latter as a switch of the process, which is off otherwise. It makes interpolation
    of the SDF twice as fast and changes no bit, as it reorders nothing.
    """

    def __init__(self) -> None:
        self.count = 0
        self.show: Callable[[int], None] | None = None
        self._noticed = False
        self._depth = 0
        self._usual = _config.SLP_VECTORIZE

    def on_start(self, event: Any) -> None:
        """The compilation of a function, or of one that it calls, begins."""
        if not _is_kernel(event):
            return
        if self._depth == 0:
            self._usual, _config.SLP_VECTORIZE = _config.SLP_VECTORIZE, 1
            self._report()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """The compilation of a function has ended."""
        if not _is_kernel(event):
            return
        self._depth -= 1
        if self._depth == 0:
            _config.SLP_VECTORIZE = self._usual
            self.count += 1
            if self.show is not None:
                self.show(self.count)

    def _report(self) -> None:
        """Tell who watches; without a watcher, log a single line per process."""
        if self.show is not None:
            self.show(self.count)
        elif not self._noticed:
            text = "compiling the kernels of this version, once: up to a minute (kept in %s)"
            _log.warning(text, cache_directory().parent)
        self._noticed = True


def _is_kernel(event: Any) -> bool:
    module: str = event.data["dispatcher"].py_func.__module__
    return module.startswith("chsel.")


_watch = _CompilerWatch()
event.register("numba:compile", _watch)
