"""How kernels are compiled."""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import numba
from numba.core import event, types
from numba.extending import overload

from chsel.numerics.code_to_link import CompilerToLink
from chsel.numerics.kernel_cache import KernelCache, cache_directory, has_kernels
from chsel.numerics.kernel_sources import loaded

Function = TypeVar("Function", bound=Callable[..., Any])

_config: Any = numba.core.config
_njit: Any = numba.njit  # its types leave out some options
_log = logging.getLogger(__name__)


def compiled(function: Function) -> Function:
    """`function` as machine code: compiled on the first call, kept on disk, run without the GIL.

    Without fast-math and contraction, so that a * b + c is rounded twice on every CPU.
    """
    kernel: Any = _njit(nogil=True, error_model="numpy", no_cfunc_wrapper=True)(function)
    kernel._cache = KernelCache(function)
    return kernel


def inner(function: Function) -> Function:
    """`function` for other kernels to call, not for Python, and machine code only as part of these.

    It cannot make arrays, so that no references are counted when arrays are passed.
    """
    loaded(function)
    kernel: Function = _njit(**_INNER, pipeline_class=CompilerToLink)(function)
    return kernel


def kept(function: Function) -> Function:
    """Like `inner`, and its code is kept on disk: it is compiled once for all that call it.

    For functions that take seconds to compile.
    """
    kernel: Any = _njit(**_INNER)(function)
    kernel._cache = KernelCache(function)
    template = kernel.get_call_template  # for numbers that are written in the call, too

    def call_template(arguments: Any, named: Any) -> Any:
        return template(tuple(map(types.unliteral, arguments)), named)

    kernel.get_call_template = call_template
    return cast("Function", kernel)


def leaf(function: Function) -> Function:
    """Like `inner`, and always inlined into its caller."""
    loaded(function)
    kernel: Function = _njit(**_INNER, forceinline=True, pipeline_class=CompilerToLink)(function)
    return kernel


def spliced(function: Function) -> Function:
    """Like `leaf`, but inlined before types are inferred.

    For a few lines around a large function, which the compiler then goes over only once.
    """
    loaded(function)
    kernel: Function = _njit(**_INNER, inline="always")(function)
    return kernel


def implements(name: Callable[..., Any], model: type) -> Callable[[Function], Function]:
    """Decorator of what kernels that call `name` run if its first argument is of type `model`.

    model: a class of NamedTuples. So one kernel, compiled for each, serves several models. Raises
    TypeError if the function is neither in the file of `name` nor in that of the model, as kept
    code is looked up by these files.
    """

    def register(function: Function) -> Function:
        loaded(function)
        if function.__module__ not in (name.__module__, model.__module__):
            homes = f"{name.__module__} and {model.__module__}"
            raise TypeError(f"{function.__name__} is in {function.__module__}; accepted: {homes}")

        def chosen(first: Any, *others: Any) -> Function | None:
            return function if getattr(first, "instance_class", None) is model else None

        options: Any = {**_INNER, "forceinline": True, "pipeline_class": CompilerToLink}
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
    of the SDF twice as fast and changes no bit, as it reorders nothing. Garbage is collected after
    a kernel rather than all the time within it.
    """

    def __init__(self) -> None:
        self.count = 0
        self.show: Callable[[int], None] | None = None
        self._noticed = False
        self._depth = 0
        self._usual = _config.SLP_VECTORIZE
        self._collects = True

    def on_start(self, event: Any) -> None:
        """The compilation of a function, or of one that it calls, begins."""
        if not _is_kernel(event):
            return
        if self._depth == 0:
            self._usual, _config.SLP_VECTORIZE = _config.SLP_VECTORIZE, 1
            self._collects = gc.isenabled()
            gc.disable()
            self._report()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """The compilation of a function has ended."""
        kernel = event.data["dispatcher"]
        has_failed = tuple(event.data["args"]) not in kernel.overloads
        if has_failed and isinstance(kernel._cache, KernelCache):
            kernel._cache.release()
        if not _is_kernel(event):
            return
        self._depth -= 1
        if self._depth == 0:
            _config.SLP_VECTORIZE = self._usual
            if self._collects:
                gc.enable()
            self.count += 1
            if self.show is not None:
                self.show(self.count)

    def _report(self) -> None:
        """Tell who watches; without a watcher, log a single line per process."""
        if self.show is not None:
            self.show(self.count)
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
    return module.startswith("chsel.")


_watch = _CompilerWatch()
event.register("numba:compile", _watch)
