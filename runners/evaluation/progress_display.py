"""What an evaluation shows on the terminal."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rich.box import SIMPLE_HEAD
from rich.progress import BarColumn
from rich.table import Table

from replay import console
from runners.evaluation.plan import Task
from runners.evaluation.true_poses import FoundPose

_SPARSE = 60.0  # s between lines where there is no terminal
_MOST_SHOWN = 3  # tasks at work, failures


@dataclass
class Progress:
    """How far an evaluation is."""

    total: int  # tasks
    finished: int = 0  # before it began
    done: int = 0  # since then
    running: list[Task] = field(default_factory=list)
    failed: dict[Task, str] = field(default_factory=dict)  # reasons
    seconds_left: float | None = None
    waits_for_workers: bool = False


class ProgressDisplay:
    """A bar with what is at work, or a line a minute where there is no terminal; then a table."""

    def __init__(self) -> None:
        self._console = console.Console()
        terminal = self._console.is_terminal
        self._bar = console.Progress(
            console.TextColumn("{task.completed}/{task.total} tasks"),
            BarColumn(bar_width=20),
            console.TextColumn("{task.description}"),
            console=self._console,
            transient=True,
            disable=not terminal,
        )
        self._task: Any = None
        self._said = time.monotonic()

    def say(self, text: str) -> None:
        """A line of its own."""
        self._console.print(text, soft_wrap=True)

    def progress(self, state: Progress) -> None:
        """Show how far it is."""
        finished = state.finished + state.done + len(state.failed)
        if self._task is None:
            self._bar.start()
            self._task = self._bar.add_task("", total=state.total)
        self._bar.update(self._task, description=_doing(state), completed=finished)
        if not self._console.is_terminal and time.monotonic() - self._said >= _SPARSE:
            self._said = time.monotonic()
            self.say(f"{finished}/{state.total} tasks  {_doing(state)}")

    def close(self) -> None:
        """Give the terminal back."""
        self._bar.stop()

    def failures(self, state: Progress) -> None:
        """Which tasks failed, and why."""
        shown = list(state.failed.items())[: 4 * _MOST_SHOWN]
        for task, reason in shown:
            self.say(f"failed: {task}: {reason}")
        if len(shown) < len(state.failed):
            self.say(f"and {len(state.failed) - len(shown)} more, see the table")

    def summary(self, results: pa.Table, methods: Sequence[str], definition: str) -> None:
        """Median PD by object and method, and milliseconds a registration.

        definition: of the plausible sets, as text.
        """
        names = np.array(results["object"].to_pylist(), dtype=object)
        labels = np.array(results["method"].to_pylist(), dtype=object)
        there = [label for label in methods if (labels == label).any()]
        if not there:
            return
        diversity, seconds = (
            np.array(results[name].to_pylist(), dtype=float) for name in ("diversity", "seconds")
        )
        objects = list(dict.fromkeys(names))
        table = Table(box=SIMPLE_HEAD, show_edge=False, padding=0)
        table.add_column("method", no_wrap=True)
        for heading in [*(name.replace("_", "\n") for name in objects), "ms"]:
            table.add_column(heading, justify="right", no_wrap=True, vertical="bottom")
        for label in there:
            own = labels == label
            cells = [_median(diversity[own & (names == name)]) for name in objects]
            table.add_row(label, *cells, _median(1000.0 * seconds[own]))
        self.say("medians over all steps of all trials: PD in mm² by object, ms a registration")
        self._console.print(table)
        self._console.print(f"plausible sets: {definition}", markup=False)

    def true_poses(self, found: Sequence[FoundPose]) -> None:
        """How far the true poses that were sought are from guesses, and from a simulated truth."""
        if not found:
            return
        self.say(
            f"true poses were sought in {len(found)} trials: mean |SDF| of contacts "
            f"{1000.0 * float(np.mean([one.mean_distance for one in found])):.2f} mm, "
            f"{sum(one.violations for one in found)} free points inside of objects"
        )
        simulated = [one for one in found if one.position_error is not None]
        if simulated:
            positions = [1000.0 * (one.position_error or 0.0) for one in simulated]
            rotations = [degrees(one.rotation_error or 0.0) for one in simulated]
            self.say(
                f"from the simulated truth of {len(simulated)}, modulo symmetries: "
                f"{np.mean(positions):.1f} mm in the mean, {max(positions):.1f} mm at worst; "
                f"{np.mean(rotations):.1f} and {max(rotations):.1f} degrees"
            )

    def written(self, folder: Path, results: pa.Table, name: str = "results") -> None:
        """Where the tables are."""
        failed = sum(text.startswith("failed") for text in results["status"].to_pylist())
        without = sum(text.startswith("no plaus") for text in results["status"].to_pylist())
        text = f"{folder / name}.parquet, {name}.csv: {results.num_rows} rows"
        text += f", {failed} failed" if failed else ""
        self.say(text + (f", {without} without a plausible set" if without else ""))


def _median(values: np.ndarray) -> str:
    values = values[~np.isnan(values)]
    if len(values) == 0:
        return ""
    median = float(np.median(values))
    return f"{median:.0f}" if median >= 100.0 else f"{median:.3g}"


def _doing(state: Progress) -> str:
    if state.waits_for_workers:
        return "waiting for workers"
    text = ", ".join(str(task) for task in state.running[:_MOST_SHOWN])
    more = len(state.running) - _MOST_SHOWN
    text += f" and {more} more" if more > 0 else ""
    if state.failed:
        text += f"; {len(state.failed)} failed"
    if state.seconds_left is not None:
        text += f"; about {_duration(state.seconds_left)} left"
    return text


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60.0)
    if minutes < 1:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 90 else f"{seconds / 3600.0:.1f} h"
