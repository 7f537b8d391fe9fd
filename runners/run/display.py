"""Terminal output of a run."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rich.filesize import decimal
from rich.progress import TimeElapsedColumn

from chsel.errors import InputWarning
from chsel.events import Decided
from chsel.numerics.compiler import watched
from chsel.problem.poses import quaternions
from chsel.problem.registration_problem import VERDICTS, Trust
from chsel.session.run import FROM_SESSION, Run, StepWarning
from replay.console import Console, Progress, TextColumn, plain_table
from runners.sensors.session_report import Report

MEANINGS = {
    "determined": "one pose explains the points",
    "several modes": "several poses explain the points; probe where they differ",
    "wide": "many poses explain the points; probe further sides",
    "nothing fits": "no pose explains the points; see the warning",
}
STOPPED = {
    "spread": "the pose is determined, as closely as policy.stop.spread asks for",
    "gain": "no probe promises to bring the poses closer by policy.stop.gain",
    "actions": "no probe is left that can be made",
    "budget": "policy.probes allows no more",
}
_JUDGED = {"set_spread": 1000.0, "centre_within": 1000.0, "turn_within": math.degrees(1.0)}
"""Columns of the table of registrations, in units of the table."""
_COUNTS = {
    "images": "images",
    "used": "used",
    "no pose": "lost",
    "bad": "unusable",
    "pixels": "pixels",
    "invalid": "invalid",
    "edge": "edges",
    "outline": "outline",
    "small": "small",
    "far": "far",
    "spikes": "spikes",
    "out of reach": "outside",
    "points": "contacts",
    "new voxels": "free",
}
"""Columns of the table of sensors, by their fields of `Counts`."""


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


class Display:
    """One line a probe, a table at the end."""

    def __init__(self, title: str) -> None:
        self._console = Console()
        self._warned = {FROM_SESSION}  # codes; what the session itself remarks is in its report
        self._console.print(title, style="bold")

    def probes(self, count: int) -> None:
        """Say how many there will be; their numbers are the steps of the recording."""
        numbers = f"probes 0 to {count - 1}" if count > 1 else "probe 0"
        self.say(f"{numbers}, numbered as the steps of the recording")

    def stopped(self, decided: Decided) -> None:
        """Say why the policy has ended the session, if it has."""
        stop = decided.decision.stop
        if not stop:
            return
        problem = decided.problem
        text = f"stopped after {problem.key.step} probes: {STOPPED[stop]}"
        if problem.verdict not in ("", VERDICTS[0]):
            text += f"; the pose is not determined ({problem.verdict})"
        self.say(text)

    def grasped(self, run: Run) -> None:
        """Say that touching has ended as a grasp works, and where it is."""
        chance = f"{100.0 * run.grasp_chance:.0f} %"
        self.say(f"stopped: a grasp works with a chance of {chance} (summary.json has its pose)")

    def probe(self, row: Mapping[str, Any]) -> None:
        """Print a line about a probe, and the registration after it if there was one."""
        text = f"probe {row['step']:>3} {row['outcome']:<7} {row['contacts']:>3} contacts"
        text += f" {row['free_points']:>6} free"
        if "set_spread" in row:
            text += f" spread {1000.0 * row['set_spread']:5.1f} mm {row['verdict']:<13}"
        self.say(f"{text} {row['seconds']:>5.2f} s")

    def warn(self, warnings: Iterable[InputWarning | StepWarning]) -> None:
        """Warnings that were not shown before, each kind once."""
        for warning in warnings:
            if warning.code not in self._warned:
                self._warned.add(warning.code)
                self.say(f"warning: {warning.text}")

    def say(self, text: str) -> None:
        """Print a line."""
        self._console.print(text)

    def table(self, rows: list[dict[str, Any]]) -> None:
        """Print the registrations, with errors to the true pose where it is known."""
        rows = [row for row in rows if "best_cost" in row]
        if not rows:
            self.say("no registration: too few contacts or probes for one")
            return
        truth = "best_position_error" in rows[-1]
        title = "registrations"
        if truth:
            title += (
                "; errors to the true pose modulo the object's symmetries, at its centre: "
                "best hypothesis, closest one by its surface"
            )
        errors = ["mm", "°", "mm", "°"] if truth else []
        numbers = ["probe", "contacts", "spread", "within mm", "°", *errors, "time"]
        table = plain_table(title, numbers=numbers)
        table.pad_edge = True  # only lines about a probe begin with "probe"
        table.add_column("verdict", no_wrap=True)
        for row in rows:
            cells = [str(row["step"]), str(row["contacts"])]
            for name, scale in _JUDGED.items():
                cells.append(f"{scale * row[name]:.1f}" if name in row else "")
            for which in ("best", "closest") if truth else ():
                cells.append(f"{1000.0 * row[f'{which}_position_error']:.1f}")
                cells.append(f"{math.degrees(row[f'{which}_rotation_error']):.1f}")
            milliseconds = f"{1000.0 * row['registration_seconds']:.0f} ms"
            table.add_row(*cells, milliseconds, row.get("verdict", ""))
        self._console.print(table)

    def sensed(self, report: Report) -> None:
        """Print how much of a robot's sensor data was used, and what was wrong with it."""
        total = {name: vars(counts) for name, counts in report.total().items() if counts.images}
        columns = {
            title: field
            for title, field in _COUNTS.items()
            if any(counts[field] for counts in total.values())
        }
        if total:
            title = "sensors, over all probes; left out: pixels or points"
            table = plain_table(title, texts=["sensor"], numbers=list(columns))
            for name, counts in total.items():
                table.add_row(name, *(str(counts[field] or "") for field in columns.values()))
            self._console.print(table)
        for level, text in report.lines:
            self.say(f"warning: {text}" if level == "warning" else text)

    def written(self, folder: Path) -> None:
        """Print the files of the run's folder, and how to look at them."""
        self._console.print(f"{folder}/", soft_wrap=True)
        for file in sorted(folder.iterdir()):
            self.say(f"  {file.name:<15} {decimal(file.stat().st_size):>9}")
            if file.suffix == ".rrd":
                viewer = shlex.join([str(Path(sys.executable).with_name("rerun")), str(file)])
                self._console.print(f"    {viewer} --bind 127.0.0.1", soft_wrap=True)

    def pose(self, rows: list[dict[str, Any]]) -> None:
        """Print the best pose of the last registration that found one."""
        row = next((row for row in reversed(rows) if "world_from_object" in row), None)
        if row is None:
            return
        pose = np.array(row["world_from_object"])
        position = " ".join(f"{number:.1f}" for number in 1000.0 * pose[:3, 3])
        quaternion = " ".join(f"{number:.4f}" for number in quaternions(pose[None, :3, :3])[0])
        where = "world_from_object (one per mode: summary.json)"
        self.say(f"best pose after probe {row['step']}, {where}:")
        self.say(f"  position {position} mm")
        self.say(f"  quaternion {quaternion} (x y z w)")
        modes = row.get("belief", ())
        if len(modes) > 1:
            shares = ", ".join(f"{100.0 * mode['weight']:.0f} %" for mode in modes)
            self.say(f"  modes have {shares} of the poses")

    def verdict(self, trust: Trust | None) -> None:
        """Print how far to trust the last result, if there is one."""
        if trust is not None:
            self.say(f"{MEANINGS[trust.verdict]}: {trust}")
