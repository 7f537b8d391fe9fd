"""`python -m runners.plausible FILE`: plausible sets, and how recorded hypotheses measure up."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

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
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.settings import build_settings
from chsel.problem.streams import StreamKey
from replay.arguments import chosen_steps
from replay.console import Console, Progress
from runners.command.program import command, plain
from runners.evaluation.metrics import (
    HypothesisMetrics,
    MetricsConfig,
    definition_label,
    definition_settings,
)
from runners.objects.scans import AssetsConfig
from runners.reporting.tables import Table, print_table, table_of
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
    truth = _truth(path, source, console)
    with threads(checked.threads):
        rows, failures = _rows(checked, source, steps, settings, truth, folder)
    print_table(console, _table(_title(checked, source, settings, truth), rows))
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


def _truth(path: Path, source: Source, console: Console) -> FloatArray:
    """The true pose that the file gives, or the one beside it, which runners.align writes."""
    if source.world_from_object is not None:
        return source.world_from_object
    there = beside(path)
    if not there.exists():
        raise SettingError(
            f"{path} has no true pose, and there is no {there.name} beside it; accepted: a pose "
            f"that `python -m runners.align {path} position=[x,y,z] rotation=[roll,pitch,yaw]` "
            "finds, or a file with world_from_object"
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
                    found = plausible_set(problem, truth, settings)
                except EvaluationError as error:
                    failures.append(f"step {step}: {error}")
                    continue
                save_plausible(folder, found)
            row = _row(problem, found, time.perf_counter() - begun if again else "found")
            rows.append(row | metrics.compute(problem, found, source.problems.found(step)))
    return rows, failures


def _row(problem: RegistrationProblem, found: PlausibleSet, seconds: float | str) -> Row:
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
    "step": "step",
    "contacts": "con-\ntacts",
    "free_points": "free",
    "true_cost": "C(X*)",
    "members": "mem-\nbers",
    "local": "off\ngrid",
    "distinct": "dis-\ntinct",
    "coverage": "cover-\nage",
    "plausibility": "plausi-\nbility",
    "diversity": "PD\nmm²",
    "root": "√PD\nmm",
    "rank": "rank",
    "seconds": "time\ns",
}


def _table(title: str, rows: list[Row]) -> Table:
    shown = [key for key in _COLUMNS if any(key in row for row in rows)]
    lines = [{_COLUMNS[key]: row.get(key, "") for key in shown} for row in rows]
    return table_of(title, lines, labels=0)


if __name__ == "__main__":
    main()
