"""The line that counts the kernels compiled before the first probe."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.progress import TimeElapsedColumn

from chsel.numerics.compiler import watched
from replay.console import Console, Progress, TextColumn


@contextmanager
def compiling_line() -> Iterator[None]:
    """Within this context, kernels that are compiled are counted on a line that stays.

    Where all are on disk, there is none.
    """
    counted = TextColumn("compiling kernels, once: {task.completed} compiled,")
    progress = Progress(counted, TimeElapsedColumn(), console=Console())

    def show(count: int) -> None:
        if not progress.tasks:
            progress.add_task("", total=None)
            progress.start()
        progress.update(progress.task_ids[0], completed=count)

    with watched(show):
        try:
            yield
        finally:
            if progress.tasks:
                progress.stop_task(progress.task_ids[0])
                progress.stop()
