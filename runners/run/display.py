"""What a run says on the terminal."""

from __future__ import annotations

import math
import shlex
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rich.filesize import decimal
from rich.progress import BarColumn, TimeElapsedColumn
from rich.table import Table

from chsel.errors import InputWarning
from chsel.numerics.compiler import watched
from chsel.policies.steering import Steering
from chsel.problem.poses import quaternions
from chsel.problem.registration_problem import Trust
from replay.console import Console, Progress, TextColumn, plain_table
from runners.run.session_run import FROM_SESSION, StepWarning
from runners.sensors.session_report import Counts, Report

MEANINGS = {
    "determined": "one pose explains the points",
    "several modes": "several poses explain the points; probe where they differ",
    "wide": "many poses explain the points; probe further sides",
    "nothing fits": "no pose explains the points; see the warning",
}
STOPPED = {
    "spread": "the plausible poses are as close together as policy.stop.spread asks for",
    "gain": "no probe promises to bring them closer by policy.stop.gain",
    "actions": "no probe is left that can be made",
    "budget": "policy.probes allows no more",
}
_LEFT_OUT = {
    "no pose": "lost",
    "bad": "unusable",
    "outline": "outline",
    "small": "small",
    "far": "far",
    "spikes": "spikes",
    "out of reach": "outside",
    "points": "contacts",
    "new voxels": "free",
}
"""Columns of the table of sensors that are counts, by their fields of `Counts`."""


def counting_bar(console: Console) -> Progress:
    """A bar for a terminal that shows how much is done, and is gone as soon as it is."""
    return Progress(
        TextColumn("  {task.description}"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total}"),
        TimeElapsedColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )


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


class Bar:
    """What is being done, and how much of it is done."""

    def __init__(self, console: Console) -> None:
        self._progress = counting_bar(console)
        self._task: Any = None

    def show(self, stage: str, done: int, total: int) -> None:
        """A stage stands at `done` of `total`."""
        if self._task is None:
            self._progress.start()
            self._task = self._progress.add_task(stage, completed=done, total=total)
        self._progress.update(self._task, description=stage, completed=done, total=total)

    def clear(self) -> None:
        """Give the line back."""
        if self._task is not None:
            self._progress.remove_task(self._task)
            self._task = None
        self._progress.stop()


@contextmanager
def reading_bar() -> Iterator[Bar]:
    """A bar of its own, as long as a session is opened."""
    bar = Bar(Console())
    try:
        yield bar
    finally:
        bar.clear()


class Display:
    """One line a probe, a bar within a registration, a table at the end."""

    def __init__(self, title: str) -> None:
        self._console = Console()
        self._warned = {FROM_SESSION}  # codes; what the session itself remarks is in its report
        self._bar = Bar(self._console)
        self._console.print(title, style="bold")

    def probes(self, count: int) -> None:
        """How many there will be; their numbers are the steps of the recording."""
        numbers = f"probes 0 to {count - 1}" if count > 1 else "probe 0"
        self._console.print(f"{numbers}, numbered as the steps of the recording")

    def stopped(self, steering: Steering) -> None:
        """Why a steered session has ended, if it has by its policy."""
        if steering.last is not None and steering.last.decision.stop:
            problem, decision = steering.last
            self._console.print(
                f"stopped after {problem.key.step} probes: {STOPPED[decision.stop]} (spread "
                f"{1000.0 * decision.spread:.1f} mm)"
            )

    def working(self, stage: str, iteration: int, total: int) -> None:
        """A stage of the registration, or of reading, stands at `iteration` of `total`."""
        self._bar.show(stage, iteration, total)

    def probe(self, row: Mapping[str, Any]) -> None:
        """A probe, and the registration after it if there was one, are done."""
        self._bar.clear()
        text = f"probe {row['step']:>3} {row['outcome']:<7} {row['contacts']:>3} contacts"
        text += f" {row['free_points']:>6} free"
        if "best_cost" in row:
            text += f"  cost {row['best_cost']:<8.3g}"
            text += "" if "spread" in row else f" {row['distinct']:>2} distinct"
        if "spread" in row:
            text += f" spread {1000.0 * row['spread']:3.0f} mm"
        self._console.print(f"{text} {row['seconds']:>5.2f} s")

    def warn(self, warnings: Iterable[InputWarning | StepWarning]) -> None:
        """Warnings that were not shown before, each kind once."""
        for warning in warnings:
            if warning.code not in self._warned:
                self._warned.add(warning.code)
                self.say(f"warning: {warning.text}")

    def say(self, text: str) -> None:
        """A line of its own."""
        self._console.print(text)

    def table(self, rows: list[dict[str, Any]]) -> None:
        """The registrations of the session, with errors to the true pose where it is known."""
        rows = [row for row in rows if "best_cost" in row]
        if not rows:
            self._console.print("no registration: too few contacts or probes for one")
            return
        truth = "best_position_error" in rows[-1]
        title = "registrations"
        if truth:
            title += (
                "; errors to the true pose modulo the object's symmetries, at its centre: "
                "best hypothesis, closest one by its surface"
            )
        errors = ["mm", "°", "mm", "°"] if truth else []
        table = plain_table(title, numbers=["probe", "contacts", "best cost", *errors, "time"])
        table.pad_edge = True  # only lines about a probe begin with "probe"
        table.add_column("verdict", no_wrap=True)
        for row in rows:
            cells = [str(row["step"]), str(row["contacts"]), f"{row['best_cost']:.4g}"]
            if truth:
                cells += [*_errors(row, "best"), *_errors(row, "closest")]
            milliseconds = f"{1000.0 * row['registration_seconds']:.0f} ms"
            table.add_row(*cells, milliseconds, row.get("verdict", ""))
        self._console.print(table)

    def sensed(self, report: Report) -> None:
        """What became of a robot's sensor data, probe by probe, and what was wrong with it."""
        if report.by_probe:
            self._console.print(_sensor_table(report))
        for level, text in report.lines:
            self.say(f"warning: {text}" if level == "warning" else text)

    def written(self, folder: Path, files: Mapping[str, int]) -> None:
        """What lies in the run's folder, and how to look at it; paths on lines of their own."""
        self._console.print(f"{folder}/", soft_wrap=True)
        for name, size in files.items():
            self._console.print(f"  {name:<15} {decimal(size):>9}")
        if "recording.rrd" in files:
            viewer = f"{_program('rerun')} --bind 127.0.0.1"
            path = shlex.quote(str(folder / "recording.rrd"))
            self._console.print("look at it:")
            self._console.print(f"{viewer} {path}", soft_wrap=True)

    def pose(self, rows: list[dict[str, Any]], folder: Path) -> None:
        """The best pose of the last registration that found one, and how to write all of them."""
        row = next((row for row in reversed(rows) if "world_from_object" in row), None)
        if row is None:
            return
        recording = folder / "recording.mcap"
        if recording.is_file():
            python = _program(Path(sys.executable).name)
            export = f"export {shlex.quote(str(recording))} --what hypotheses --format npz"
            self._console.print("all hypotheses as arrays:")
            self._console.print(f"{python} -m replay {export}", soft_wrap=True)
        pose = np.array(row["world_from_object"])
        position = " ".join(f"{number:.1f}" for number in 1000.0 * pose[:3, 3])
        quaternion = " ".join(f"{number:.4f}" for number in quaternions(pose[None, :3, :3])[0])
        where = "world_from_object (one per mode: summary.json)"
        self._console.print(f"best pose after probe {row['step']}, {where}:")
        self._console.print(f"  position {position} mm")
        self._console.print(f"  quaternion {quaternion} (x y z w)")

    def verdict(self, trust: Trust | None) -> None:
        """How far to trust the last result, if there is one."""
        if trust is not None:
            self._console.print(f"{trust}: {MEANINGS[trust.verdict]}")

    def close(self) -> None:
        """Give the terminal back."""
        self._bar.clear()


def _program(name: str) -> str:
    """How to start a program of this environment from here."""
    beside = Path(sys.executable).with_name(name)
    if shutil.which(name) == str(beside) or not beside.is_file():
        return name
    return str(beside.relative_to(Path.cwd()) if beside.is_relative_to(Path.cwd()) else beside)


def _sensor_table(report: Report) -> Table:
    """Counts by probe and sensor, of those that have images, and the totals."""
    rows: list[tuple[str, str, Counts]] = []
    total = {"all": report.total()} if len(report.by_probe) > 1 else {}
    for step, by_sensor in [*report.by_probe.items(), *total.items()]:
        used = [(sensor, counts) for sensor, counts in by_sensor.items() if counts.images]
        rows += [("" if k else str(step), *entry) for k, entry in enumerate(used)]
    columns = {
        "used": [f"{counts.used}/{counts.images}" for _, _, counts in rows],
        "invalid": [_share(counts.invalid, counts.pixels) for _, _, counts in rows],
        "edge": [_share(counts.edges, counts.pixels) for _, _, counts in rows],
    }
    for name, field in _LEFT_OUT.items():
        columns[name] = [str(getattr(counts, field) or "") for _, _, counts in rows]
    columns = {name: cells for name, cells in columns.items() if any(cells)}
    title = "sensors; left out: invalid, edge in % of pixels, others in pixels or points"
    table = plain_table(title, texts=["probe", "sensor"], numbers=list(columns))
    table.pad_edge = True
    for index, (step, sensor, _) in enumerate(rows):
        table.add_row(step, sensor, *(cells[index] for cells in columns.values()))
    return table


def _share(count: int, of: int) -> str:
    return f"{100.0 * count / of:.1f}" if of else ""


def _errors(row: Mapping[str, Any], which: str) -> tuple[str, str]:
    """Position error in millimetres, rotation error in degrees."""
    millimetres = 1000.0 * row[f"{which}_position_error"]
    return f"{millimetres:.1f}", f"{math.degrees(row[f'{which}_rotation_error']):.1f}"
