"""`python -m runners.evaluate`: sessions, all methods on each, one table of how they measure up."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from chsel.errors import SettingError
from chsel.methods import METHODS
from chsel.numerics.threads import require_threads
from chsel.plausible.pose_scan import TruePoseSettings
from chsel.problem.settings import CheckedSettings, build_settings, one_of, positive
from replay.console import Console, Progress
from runners.command.program import command, plain
from runners.evaluation.cluster import ClusterConfig, cluster_config, connected
from runners.evaluation.contenders import chosen_contenders, chosen_policies, drawn, require_label
from runners.evaluation.experiment import (
    add_environments,
    collect,
    join_experiment,
    writing_alone,
)
from runners.evaluation.external_results import external_folders, read_external
from runners.evaluation.metrics import MetricsConfig, definition_text
from runners.evaluation.plan import OBJECTS, OWN, Plan, Trial
from runners.evaluation.tasks import do_tasks, is_finished, tasks_of
from runners.evaluation.trial_configurations import (
    SENSORS,
    chosen_configurations,
    chosen_names,
    chosen_seeds,
    faulty_name,
)
from runners.evaluation.true_poses import check_log, is_missing
from runners.objects.scans import AssetsConfig, scan_file
from runners.reporting.evaluation_folder import open_evaluation
from runners.reporting.figures import method_styles, policy_styles
from runners.reporting.method_sections import tables_by_faults, true_pose_table
from runners.reporting.policy_sections import error_table, needed_table
from runners.reporting.statistics import steered_sessions
from runners.reporting.tables import Table, number, print_table, table_of
from runners.run.scene import PresetName
from runners.sessions.faults import CLEAN, LEVELS
from runners.sessions.probing_settings import without_defaults

_MOST_FAILURES = 12  # that are printed
_OF_TRIAL = ("configuration", "logs")


@dataclass(frozen=True)
class IterationsConfig(CheckedSettings):
    """What is measured of searches."""

    every: Annotated[int | None, positive]  # iterations between measures; None: none


@dataclass(frozen=True)
class EvaluateConfig(CheckedSettings):
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
    objects: Annotated[str, one_of(*OBJECTS)]
    steps: str | None
    starts: Annotated[str, one_of(OWN, *METHODS)]
    draws: int
    faults: Any
    plausible: bool
    recordings: bool
    policies: Any
    policy: Any
    workers: Annotated[int | None, require_threads]
    cluster: Any

    def __post_init__(self) -> None:
        super().__post_init__()
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
    console = Console(soft_wrap=True)
    with writing_alone(plan.folder, console.print):
        join_experiment(plan, checked.name, configurations, seeds)
        for unfinished in plan.folder.glob("trials/*/*/.*"):  # of a run that was killed
            unfinished.unlink()
        failed = evaluate(plan, trials, cluster, checked.workers, console)
    if failed and HydraConfig.get().mode is not RunMode.MULTIRUN:  # the other jobs must go on
        sys.exit(1)


def evaluate(
    plan: Plan,
    trials: Sequence[Trial],
    cluster: ClusterConfig,
    workers: int | None,
    console: Console,
) -> bool:
    """Do all tasks that are not finished, and write the tables; whether anything failed."""
    tasks = tasks_of(plan, trials)
    missing = [task for task in tasks if not is_finished(plan, task)]
    what = f"{len(plan.policies)} policies" if plan.policies else f"{len(plan.contenders)} methods"
    console.print(
        f"evaluation in {plan.folder}: {len(trials)} trials, {what}, {len(tasks)} tasks, of which "
        f"{len(tasks) - len(missing)} are finished"
    )
    failures: list[str] = []
    environments = []
    try:
        if missing:
            with (
                connected(cluster, workers, console.print) as (client, size),
                Progress(console=console, transient=True, disable=not console.is_terminal) as bar,
            ):
                shown = bar.add_task("tasks", total=len(missing))
                for ended in do_tasks(plan, missing, client, size):
                    bar.update(shown, advance=1, description=str(ended.task))
                    if ended.failure:
                        failures.append(f"failed: {ended.task}: {ended.failure}")
                    else:
                        environments.append(ended.environment)
    finally:
        for line in failures[:_MOST_FAILURES]:
            console.print(line)
        if len(failures) > _MOST_FAILURES:
            console.print(f"and {len(failures) - _MOST_FAILURES} more, see the table")
        add_environments(plan.folder, environments)
        results = collect(plan.folder).to_pandas()
        if sys.exc_info()[0] is KeyboardInterrupt:
            console.print("interrupted: what is finished stays, and the same command goes on")
    for table in _tables(plan, results):
        print_table(Console(), table)
    failed = int(results["status"].str.startswith("failed").sum())
    name = "probes" if plan.policies else "results"
    console.print(
        f"{plan.folder / name}.parquet, {name}.csv: {len(results)} rows, {failed} of them failed"
    )
    return failed > 0


def _tables(plan: Plan, results: pd.DataFrame) -> list[Table]:
    """What is shown of the results."""
    evaluation = open_evaluation(plan.folder)
    if not plan.policies:
        faults = tables_by_faults(evaluation.rows, method_styles(evaluation.methods))
        tables = [median_table(results, definition_text(plan.definition)), *faults]
        return [*tables, *filter(lambda table: table.rows, [true_pose_table(evaluation)])]
    sessions = steered_sessions(evaluation)
    styles = policy_styles(sessions.policies)
    return [error_table(sessions, styles), needed_table(sessions, styles)] * bool(sessions.count)


def median_table(results: pd.DataFrame, definition: str) -> Table:
    """Median PD by object and method, and milliseconds a registration.

    definition: of the plausible sets, as text.
    """
    medians = results.pivot_table("diversity", "method", "object", "median", dropna=False)
    lines = [
        {"method": label, **medians.loc[label].map(number), "ms": number(1000.0 * seconds)}
        for label, seconds in results.groupby("method")["seconds"].median().items()
    ]
    title = "medians over all steps of all trials: PD in mm² by object, ms a registration"
    return table_of(title, lines, note=f"plausible sets: {definition}")


def _plan(config: EvaluateConfig) -> Plan:
    def path(folder: object) -> Path:
        """As workers elsewhere find it."""
        return Path(str(folder)).expanduser().absolute()

    given = {str(name): path(folder) for name, folder in config.outside.items()}
    chosen = chosen_contenders(config.methods, config.settings, config.preset.name)
    chosen = drawn(chosen, config.draws)
    policies = chosen_policies(config.policies, config.policy)
    logs = config.session.get("logs")
    session = without_defaults(config.session)
    return Plan(
        folder=path(config.out),
        preset=config.preset.name,
        session={key: value for key, value in session.items() if key not in _OF_TRIAL},
        objects=config.objects,
        definition=config.definition,
        metrics=config.metrics,
        steps=config.steps,
        starts=config.starts,
        every=config.iterations.every,
        recordings=config.recordings,
        assets=path(config.assets.folder),
        contenders={contender.label: contender for contender in chosen},
        outside=external_folders(given),
        logs=None if logs is None else path(logs),
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


if __name__ == "__main__":
    main()
