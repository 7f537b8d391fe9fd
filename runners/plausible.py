"""`python -m runners.plausible FILE`: plausible sets, and how recorded hypotheses measure up."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from typing import Any

from omegaconf import DictConfig

from chsel.errors import EvaluationError, SettingError
from chsel.numerics.threads import threads
from chsel.problem.settings import build_settings
from replay.arguments import chosen_steps
from replay.console import Console, Progress
from runners.command.program import command, plain
from runners.evaluation.metrics import (
    HypothesisMetrics,
    MetricsConfig,
    definition_label,
    definition_settings,
)
from runners.evaluation.trial_session import made_set
from runners.evaluation.true_poses import SourceConfig, pose_beside
from runners.reporting.tables import print_table, table_of

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


@dataclass(frozen=True)
class PlausibleConfig(SourceConfig):
    """conf/plausible.yaml, which has all defaults, checked; Any is checked where it is used."""

    definition: Any
    metrics: MetricsConfig
    steps: Any


@command("plausible")
def main(config: DictConfig) -> None:
    """Make, or find, the set of every step, and print what they hold."""
    checked = build_settings(PlausibleConfig, plain(config), where="plausible")
    source = checked.open()
    console = Console()
    steps = chosen_steps(None if checked.steps is None else str(checked.steps), source.steps)
    folder = checked.folder(checked.path.parent / "plausible")
    if checked.definition.get("epsilon") is None and source.epsilon is None:
        raise SettingError(
            "definition.epsilon is missing, as the recording names none of its object; "
            "accepted: metres above 0, such as 0.001"
        )
    settings = definition_settings(checked.definition, source.epsilon)
    truth = source.world_from_object
    truth = pose_beside(checked.path) if truth is None else truth
    metrics = HypothesisMetrics(checked.metrics, source.mesh, world_from_object=truth)
    rows: list[dict[str, Any]] = []
    failures: list[str] = []
    waiting = Console(stderr=True)
    with (
        threads(checked.threads),
        Progress(console=waiting, transient=True, disable=not waiting.is_terminal) as progress,
    ):
        for step in progress.track(steps, description="plausible sets"):
            problem = source.problems.problem(step)
            begun = time.perf_counter()
            try:
                found, was_there = made_set(folder, problem, truth=truth, settings=settings)
            except EvaluationError as error:
                failures.append(f"step {step}: {error}")
                continue
            rows.append(
                {
                    "step": step,
                    "contacts": len(problem.points.contacts),
                    "free_points": len(problem.points.free),
                    "members": len(found.index),
                    "local": int(found.local.sum()),
                    "true_cost": found.true_cost,
                    "seconds": "found" if was_there else time.perf_counter() - begun,
                    **metrics.compute(problem, found, found=source.problems.hypotheses(step)),
                }
            )
    shown = [key for key in _COLUMNS if any(key in row for row in rows)]
    lines = [{_COLUMNS[key]: row.get(key, "") for key in shown} for row in rows]
    position = ", ".join(f"{value:.3f}" for value in truth[:3, 3])
    title = (
        f"{source.object}, plausible sets by definition {definition_label(checked.definition)}, "
        f"epsilon {1000.0 * settings.epsilon:g} mm, around ({position}) m"
    )
    print_table(console, table_of(title, lines, labels=0))
    for line in (*failures, f"written: {len(rows)} sets, in {folder}"):
        console.print(line, soft_wrap=True)
    if failures:
        sys.exit(1)


if __name__ == "__main__":
    main()
