"""Compiling what a session needs while it makes its first probes, under a line that counts."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Self

from rich.progress import TimeElapsedColumn

from chsel.background_rehearsal import rehearse_beside
from chsel.methods.method import Method
from chsel.numerics.compiler import watched
from chsel.numerics.kernel_cache import has_kernels, kept_count
from chsel.policies.policy import Policy
from chsel.rehearsal import warm_up, warm_up_policy, warm_up_sensing
from replay.console import Console, LiveTextColumn, Progress, TextColumn


class Compiling:
    """Within this context, kernels that are waited for are counted on a line that stays.

    If all kernels are kept from before, there is none.
    """

    def __init__(self) -> None:
        which = "further kernels for this CPU" if has_kernels() else "kernels for this CPU, once"
        self._text = f"compiling {which}"
        before = kept_count()
        self._count = LiveTextColumn(lambda: f"{kept_count() - before} compiled,")
        self._progress: Progress | None = None
        self._method: Method | None = None
        self._processes: list[subprocess.Popen[bytes]] = []
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._stack.enter_context(watched(self._show))
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def begin(self, method: Method) -> None:
        """Compile what registrations by `method` need, on other cores from now on.

        At once where no kernel was compiled yet; else as soon as one proves to be missing.
        """
        self._method = method
        if not has_kernels():
            self._begin()

    def rehearse(self, *methods: Method) -> None:
        """Wait for all that registrations by these methods need, and compile what nobody does."""
        with self._line():
            if any(process.poll() is None for process in self._processes):
                self._show(0)
            for method in methods:
                warm_up(method)

    def rehearse_probing(self, policy: Policy | None, *, sensing: bool) -> None:
        """Compile what a policy needs, and with `sensing` what turns images to points."""
        with self._line():
            if policy is not None:
                warm_up_policy(policy)
            if sensing:
                warm_up_sensing()

    @contextmanager
    def _line(self) -> Iterator[None]:
        """Within this context, the line appears as soon as a kernel is waited for."""
        columns = TextColumn("{task.description}:"), self._count, TimeElapsedColumn()
        progress = self._progress = Progress(*columns, console=Console())
        try:
            yield
        finally:
            self._progress = None
            if progress.tasks:
                progress.stop_task(progress.task_ids[0])
                progress.stop()

    def _show(self, _: int) -> None:
        """A kernel is missing, or was compiled by this process."""
        self._begin()
        if self._progress is not None and not self._progress.tasks:
            self._progress.add_task(self._text, total=None)
            self._progress.start()

    def _begin(self) -> None:
        if self._method is not None:
            self._processes, self._method = rehearse_beside(self._method), None
