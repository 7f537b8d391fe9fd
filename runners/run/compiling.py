"""Compiling all that a session needs before its first probe, under a line that counts."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Self

from rich.progress import TaskID, TimeElapsedColumn

from chsel.background_rehearsal import rehearse_search_beside
from chsel.methods.method import Method
from chsel.numerics.compiler import watched
from chsel.numerics.kernel_cache import has_kernels
from chsel.policies.policy import Policy
from chsel.rehearsal import warm_up, warm_up_policy, warm_up_sensing
from replay.console import Console, Progress, TextColumn


class Compiling:
    """Within this context, kernels that are compiled are counted on a line that stays.

    The line appears with the rehearsal, as a bar of progress may be on the screen before it. If
    all kernels are kept from before, there is none.
    """

    def __init__(self) -> None:
        which = "further kernels for this CPU" if has_kernels() else "kernels for this CPU, once"
        self._text = f"compiling {which}"
        columns = TextColumn("{task.description}: {task.completed} compiled,"), TimeElapsedColumn()
        self._progress = Progress(*columns, console=Console())
        self._task: TaskID | None = None
        self._rehearsing = False
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._stack.enter_context(watched(self._show))
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()
        if self._task is not None:
            self._progress.stop_task(self._task)
            self._progress.start()
            self._progress.stop()

    def begin(self, method: Method) -> None:
        """Where nothing was compiled yet, compile the search on another core from now on."""
        if not has_kernels():
            rehearse_search_beside(method)

    def rehearse(self, method: Method, policy: Policy | None = None, *, sensing: bool) -> None:
        """Compile what `method` needs, and `policy`; with `sensing` what turns images to points."""
        self._rehearsing = True
        if self._task is not None:
            self._progress.start()
        warm_up(method)
        if policy is not None:
            warm_up_policy(policy)
        if sensing:
            warm_up_sensing()

    def _show(self, count: int) -> None:
        if self._task is None:
            self._task = self._progress.add_task(self._text, total=None)
        if self._rehearsing:
            self._progress.start()
        self._progress.update(self._task, completed=count)
