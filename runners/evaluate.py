"""`python -m runners.evaluate`: sessions, all methods on each, one table of how they measure up."""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from chsel.errors import RecordingError, SettingError, require_choice, require_positive
from chsel.methods import METHODS
from chsel.numerics.threads import require_threads
from chsel.plausible.pose_scan import TruePoseSettings
from chsel.problem.settings import build_settings
from replay.console import Console
from runners.command.program import command, plain
from runners.evaluation.cluster import ClusterConfig, cluster_config, connected
from runners.evaluation.contenders import chosen_contenders, drawn, require_label
from runners.evaluation.definition import definition_text
from runners.evaluation.experiment import (
    add_environments,
    collect,
    join_experiment,
    read_experiment,
    writing_alone,
)
from runners.evaluation.external_results import external_folders, read_external
from runners.evaluation.metrics import MetricsConfig
from runners.evaluation.plan import OBJECTS, OWN, Plan, Trial
from runners.evaluation.policy_contenders import chosen_policies
from runners.evaluation.progress_display import Progress, ProgressDisplay
from runners.evaluation.scheduling import Scheduling
from runners.evaluation.selection import chosen_configurations, chosen_names, chosen_seeds
from runners.evaluation.sensor_logs import check_log, is_missing
from runners.evaluation.trial_configurations import SENSORS, faulty_name
from runners.evaluation.true_poses import true_poses
from runners.objects.scans import AssetsConfig, scan_file
from runners.run.scene import PresetName
from runners.sessions.faults import CLEAN, LEVELS
from runners.sessions.probing_settings import without_defaults

_COLLECT = 300.0  # s between tables of what is finished so far
_OF_TRIAL = ("configuration", "logs")


@dataclass(frozen=True)
class IterationsConfig:
    """every: iterations of the search between measures of it; None: none but of the result."""

    every: int | None

    def __post_init__(self) -> None:
        if self.every is not None:
            require_positive("every", self.every)


@dataclass(frozen=True)
class EvaluateConfig:
    """conf/evaluate.yaml, which has all defaults, checked.

    What is Any is checked by whoever it concerns.
    """

    name: str
    out: str
    configurations: Any
    seeds: Any
    methods: Any
    settings: Any
    outside: Any
    session: Any
    definition: Any
    preset: PresetName
    metrics: MetricsConfig
    iterations: IterationsConfig
    assets: AssetsConfig
    truth: TruePoseSettings
    objects: str
    steps: str | None
    starts: str
    draws: int
    faults: Any
    plausible: bool
    recordings: bool
    policies: Any
    policy: Any
    workers: int | None
    cluster: Any

    def __post_init__(self) -> None:
        if self.workers is not None:
            require_threads("workers", self.workers)
        require_choice("objects", self.objects, OBJECTS)
        require_choice("starts", self.starts, (OWN, *METHODS))
        if not self.name or not self.out:
            raise SettingError("name or out is empty; accepted: a name, a folder")


@command("evaluate")
def main(config: DictConfig) -> None:
    """Do what is not done yet, and collect all that is there."""
    values = plain(config)
    if values["steps"] is not None:
        values["steps"] = str(values["steps"])
    checked = build_settings(EvaluateConfig, values, "evaluate")
    plan, cluster = _plan(checked), cluster_config(checked.cluster, checked.workers)
    _check_policies(plan)
    levels = chosen_names("faults", checked.faults, LEVELS)
    clean = {name: one for name, one in plan.configurations.items() if one.faults == CLEAN}
    chosen = chosen_configurations(checked.configurations, clean)
    configurations = [faulty_name(name, level) for name in chosen for level in levels]
    seeds = chosen_seeds(checked.seeds)
    trials = [Trial(seed, name) for seed in seeds for name in configurations]
    _check_faults(plan, levels)
    _check(plan, trials)
    display = ProgressDisplay()
    with writing_alone(plan.folder, display.say):
        join_experiment(plan, checked.name, configurations, seeds)
        failed = evaluate(plan, trials, cluster, checked.workers, display)
    if failed and HydraConfig.get().mode is not RunMode.MULTIRUN:  # the other jobs must go on
        sys.exit(1)


def evaluate(
    plan: Plan,
    trials: list[Trial],
    cluster: ClusterConfig,
    workers: int | None,
    display: ProgressDisplay,
) -> bool:
    """Do all tasks that are not finished, and write the tables; whether anything failed."""
    collected = time.monotonic()

    def show(progress: Progress) -> None:
        nonlocal collected
        display.progress(progress)
        if time.monotonic() - collected > _COLLECT:
            collected = time.monotonic()
            with suppress(RecordingError):  # of a damaged part: it is an error at the end
                collect(plan.folder)

    scheduling = Scheduling(plan, trials, show)
    before = scheduling.progress
    contenders = f"{len(plan.contenders)} methods"
    if plan.policies:
        contenders = f"{len(plan.policies)} policies"
    display.say(
        f"evaluation in {plan.folder}: {len(trials)} trials, {contenders}, "
        f"{before.total} tasks, of which {before.finished} are finished"
    )
    try:
        if before.finished < before.total:
            with connected(cluster, workers, display.say) as connection:
                scheduling.run(connection)
    finally:
        display.close()
        display.failures(before)
        add_environments(plan.folder, scheduling.environments)
        results = collect(plan.folder)
        if sys.exc_info()[0] is KeyboardInterrupt:
            display.say("interrupted: what is finished stays, and the same command goes on")
    if plan.policies:
        _print_policies(plan.folder)
    else:
        display.summary(results, _labels(plan.folder), definition_text(plan.definition))
        _print_by_faults(plan.folder)
        display.true_poses(true_poses(plan.folder, read_experiment(plan.folder)))
    display.written(plan.folder, results, "probes" if plan.policies else "results")
    return any(text.startswith("failed") for text in results["status"].to_pylist())


def _print_by_faults(folder: Path) -> None:
    """By level of faults: whether sets hold the truth, and how far hypotheses are from it."""
    # Pandas and matplotlib take a second to import, which an evaluation starts without.
    from runners.reporting.evaluation_folder import open_evaluation
    from runners.reporting.figures import method_styles
    from runners.reporting.method_sections import tables_by_faults
    from runners.reporting.tables import print_table

    evaluation = open_evaluation(folder)
    for table in tables_by_faults(evaluation.rows, method_styles(evaluation.methods)):
        print_table(Console(), table)


def _print_policies(folder: Path) -> None:
    """How far each policy has come after how many probes."""
    from runners.reporting.evaluation_folder import open_evaluation
    from runners.reporting.figures import policy_styles
    from runners.reporting.policy_sections import error_table, needed_table
    from runners.reporting.steered_sessions import steered_sessions
    from runners.reporting.tables import print_table

    sessions = steered_sessions(open_evaluation(folder))
    if sessions.count:
        styles = policy_styles(sessions.policies)
        for table in (error_table(sessions, styles), needed_table(sessions, styles)):
            print_table(Console(), table)


def _plan(config: EvaluateConfig) -> Plan:
    given = {str(name): Path(folder).expanduser() for name, folder in config.outside.items()}
    chosen = chosen_contenders(config.methods, config.settings, config.preset.name)
    chosen = drawn(chosen, config.draws)
    policies = chosen_policies(config.policies, config.policy)
    logs = config.session.get("logs")
    session = without_defaults(config.session)
    return Plan(
        folder=Path(config.out).expanduser(),
        preset=config.preset.name,
        session={key: value for key, value in session.items() if key not in _OF_TRIAL},
        objects=config.objects,
        definition=config.definition,
        metrics=config.metrics,
        steps=config.steps,
        starts=config.starts,
        every=config.iterations.every,
        recordings=config.recordings,
        assets=config.assets.folder,
        contenders={contender.label: contender for contender in chosen},
        outside=external_folders(given),
        logs=Path(str(logs)).expanduser() if logs is not None else None,
        truth=config.truth,
        plausible=config.plausible and not policies,
        policies=policies,
    )


def _check_policies(plan: Plan) -> None:
    """Policies probe with one method, in sessions of their own."""
    if not plan.policies:
        return
    accepted = "accepted with policies"
    if len(plan.contenders) != 1:
        raise SettingError(f"methods has {len(plan.contenders)}; {accepted}: one, such as anchored")
    if plan.kind == SENSORS:
        raise SettingError(f"session is {SENSORS}; {accepted}: kinematic, simulated")
    for name, value, usual in (
        ("starts", plan.starts, OWN),
        ("steps", plan.steps, None),
        ("iterations.every", plan.every, None),
    ):
        if value != usual:
            raise SettingError(f"{name} is {value}; {accepted}: {usual or 'null'}")
    if plan.outside:
        raise SettingError(f"outside has {', '.join(plan.outside)}; {accepted}: none")


def _check_faults(plan: Plan, levels: Sequence[str]) -> None:
    """Levels are of simulated sessions; other faults have no session without them beside."""
    if plan.kind == SENSORS and levels != (CLEAN,):
        raise SettingError(
            f"faults is {', '.join(levels)}; accepted for session=sensors: {CLEAN}, others are of "
            "session=kinematic and session=simulated"
        )
    if "faults" in plan.session and (plan.plausible or levels != (CLEAN,)):
        raise SettingError(
            "session.faults is changed; accepted here: faults=LEVEL, or plausible=false with "
            f"faults={CLEAN}"
        )


def _check(plan: Plan, trials: list[Trial]) -> None:
    """What would fail everywhere fails here, before any work."""
    for trial in trials:
        plan.session_settings(trial)
        plan.plausible_settings(plan.object_config(trial.configuration).epsilon)
    for scan in {plan.object_config(trial.configuration).scan for trial in trials}:
        if scan is not None:
            scan_file(plan.assets, scan)
    if not any(plan.steps_of(trial.configuration) for trial in trials):
        raise SettingError(f"steps is {plan.steps}; accepted: steps that a configuration has")
    _check_sessions(plan, trials)
    for label, folder in plan.outside.items():
        require_label(label)
        if label in plan.contenders:
            raise SettingError(f"outside has {label}, as methods has; accepted: another name")
        if not folder.is_dir():
            raise SettingError(f"outside.{label} is {folder}; accepted: a folder")
        for trial in trials:
            read_external(plan, trial, label)


def _check_sessions(plan: Plan, trials: list[Trial]) -> None:
    """What sessions need that is not there: an engine, or raw logs and guesses of poses."""
    if plan.kind == SENSORS:
        for trial in trials:
            check_log(plan, trial)
        to_simulate = any(is_missing(plan, trial) for trial in trials)
    elif plan.logs is not None:
        raise SettingError(f"session.logs is for session=sensors; this one is {plan.kind}")
    else:
        to_simulate = plan.kind == "simulated"
    if to_simulate and importlib.util.find_spec("pybullet") is None:
        what = "a simulated log" if plan.kind == SENSORS else "session=simulated"
        raise SettingError(f"{what} needs PyBullet; accepted here: session=kinematic")


def _labels(folder: Path) -> list[str]:
    experiment = read_experiment(folder)
    return [*experiment["methods"], *experiment["outside"]]


if __name__ == "__main__":
    main()
