"""`python -m runners.plausible FILE`: plausible sets, and how recorded hypotheses measure up."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig
from rich.box import SIMPLE_HEAD
from rich.table import Table

from chsel.errors import EvaluationError, SettingError
from chsel.numerics.arrays import FloatArray
from chsel.numerics.threads import require_threads, threads
from chsel.plausible.plausible_set import (
    PlausibleSet,
    load_plausible,
    plausible_set,
    save_plausible,
)
from chsel.plausible.plausible_settings import PlausibleSettings
from chsel.plausible.pose_scan import find_true_pose
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.settings import build_settings
from chsel.problem.streams import StreamKey
from replay.arguments import chosen_steps
from replay.console import Console, Progress
from runners.command.program import command, plain
from runners.evaluation.definition import definition_label, definition_settings
from runners.evaluation.metrics import HypothesisMetrics, MetricsConfig
from runners.objects.scans import AssetsConfig
from runners.sensors.pose_file import beside, read_pose
from runners.sessions.problem_source import Source, open_source

Row = dict[str, Any]


@dataclass(frozen=True)
class PlausibleConfig:
    """conf/plausible.yaml, which has all defaults, checked.

    object, session, definition: checked where they are used.
    """

    object: Any
    session: Any
    definition: Any
    metrics: MetricsConfig
    assets: AssetsConfig
    file: str | None
    steps: str | None
    guess: tuple[tuple[float, ...], ...] | None
    out: str | None
    seed: int
    threads: int

    def __post_init__(self) -> None:
        if not self.file:
            raise SettingError("file is missing; pass a recording.mcap or a file of known points")
        StreamKey(self.seed, 0)
        require_threads("threads", self.threads)


@command("plausible")
def main(config: DictConfig) -> None:
    """Make, or find, the set of every step, and print what they hold."""
    values = plain(config)
    if values["steps"] is not None:
        values["steps"] = str(values["steps"])
    checked = build_settings(PlausibleConfig, values, "plausible")
    path = Path(checked.file or "").expanduser()
    source = open_source(path, checked.object, checked.session, checked.assets.folder, checked.seed)
    steps = chosen_steps(checked.steps, source.steps)
    settings = _settings(checked.definition, source)
    folder = Path(checked.out).expanduser() if checked.out else path.parent / "plausible"
    console = Console()
    with threads(checked.threads):
        truth = _truth(checked, source, settings, console)
        rows, failures = _rows(checked, source, steps, settings, truth, folder)
    console.print(_title(checked, source, settings, truth), style="bold")
    if rows:
        console.print(_table(rows))
    for failure in failures:
        console.print(failure, soft_wrap=True)
    console.print(f"written: {len(rows)} sets, in")
    console.print(str(folder), soft_wrap=True)
    if failures:
        sys.exit(1)


def _settings(definition: Any, source: Source) -> PlausibleSettings:
    if definition.get("epsilon") is None and source.epsilon is None:
        raise SettingError(
            "definition.epsilon is missing, as the recording names none of its object; "
            "accepted: metres above 0, such as 0.001"
        )
    return definition_settings(definition, source.epsilon)


def _truth(
    config: PlausibleConfig, source: Source, settings: PlausibleSettings, console: Console
) -> FloatArray:
    """The true pose that the file gives; else the one near a guess, or that of a pose file."""
    if source.world_from_object is not None:
        if config.guess is not None:
            raise SettingError("guess is for files without a true pose; this one has it")
        return source.world_from_object
    if config.guess is None:
        return _aligned(Path(config.file or "").expanduser(), console)
    problem = source.problems.problem(source.steps[-1])
    found = find_true_pose(problem, np.array(config.guess))
    console.print(
        f"true pose found near the guess, which costs {found.guess_cost:.4g}: it costs "
        f"{found.cost:.4g}",
        soft_wrap=True,
    )
    console.print(str(found.world_from_object.tolist()), soft_wrap=True)
    return found.world_from_object


def _aligned(path: Path, console: Console) -> FloatArray:
    """The pose in the file beside, which runners.align writes."""
    there = beside(path)
    if not there.exists():
        raise SettingError(
            f"{path} has no true pose, and there is no {there.name} beside it; accepted: a pose "
            f"that `python -m runners.align {path} position=[x,y,z] rotation=[roll,pitch,yaw]` "
            "finds, guess=[[...],[...],[...],[0,0,0,1]] near it, or a file with world_from_object"
        )
    console.print(f"true pose: that of {there}", soft_wrap=True)
    return read_pose(there)


def _rows(
    config: PlausibleConfig,
    source: Source,
    steps: tuple[int, ...],
    settings: PlausibleSettings,
    truth: FloatArray,
    folder: Path,
) -> tuple[list[Row], list[str]]:
    """A row of numbers for every step with a set; what went wrong at the others."""
    rows: list[Row] = []
    failures: list[str] = []
    before: PlausibleSet | None = None
    metrics = HypothesisMetrics(config.metrics, source.mesh, truth)
    waiting = Console(stderr=True)
    with Progress(console=waiting, transient=True, disable=not waiting.is_terminal) as progress:
        for step in progress.track(steps, description="plausible sets"):
            problem = source.problems.problem(step)
            begun = time.perf_counter()
            found = load_plausible(folder, problem, settings, world_from_object=truth)
            again = found is None
            if found is None:
                try:
                    found = plausible_set(problem, truth, settings, survivors=before)
                except EvaluationError as error:
                    failures.append(f"step {step}: {error}")
                    continue
                save_plausible(folder, found)
            before = found
            row = _row(problem, found, time.perf_counter() - begun if again else None)
            rows.append(row | metrics.compute(problem, found, source.problems.found(step)))
    return rows, failures


def _row(problem: RegistrationProblem, found: PlausibleSet, seconds: float | None) -> Row:
    return {
        "step": problem.key.step,
        "contacts": len(problem.points.contacts),
        "free_points": len(problem.points.free),
        "members": len(found.index),
        "kept": len(found.cost),
        "local": int(found.local.sum()),
        "true_cost": found.true_cost,
        "seconds": seconds,
    }


def _title(
    config: PlausibleConfig, source: Source, settings: PlausibleSettings, truth: FloatArray
) -> str:
    position = ", ".join(f"{value:.3f}" for value in truth[:3, 3])
    return (
        f"{source.object}, plausible sets by definition {definition_label(config.definition)}, "
        f"epsilon {1000.0 * settings.epsilon:g} mm, around ({position}) m"
    )


_COLUMNS = {
    "step": ("step", "d"),
    "contacts": ("con-\ntacts", "d"),
    "free_points": ("free", "d"),
    "true_cost": ("C(X*)", ".2g"),
    "members": ("mem-\nbers", "d"),
    "local": ("off\ngrid", "d"),
    "distinct": ("dis-\ntinct", "d"),
    "coverage": ("cover-\nage", ".1f"),
    "plausibility": ("plausi-\nbility", ".1f"),
    "diversity": ("PD\nmm²", ".1f"),
    "root": ("√PD\nmm", ".1f"),
    "rank": ("rank", ".2f"),
    "seconds": ("time\ns", ".2f"),
}


def _table(rows: list[Row]) -> Table:
    table = Table(box=SIMPLE_HEAD, show_edge=False, padding=(0, 0, 0, 0))
    shown = [key for key in _COLUMNS if any(key in row for row in rows)]
    for key in shown:
        table.add_column(_COLUMNS[key][0], justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*(_cell(row, key) for key in shown))
    return table


def _cell(row: Row, key: str) -> str:
    if key == "seconds" and row[key] is None:
        return "found"
    return format(row[key], _COLUMNS[key][1]) if row.get(key) is not None else ""


if __name__ == "__main__":
    main()
