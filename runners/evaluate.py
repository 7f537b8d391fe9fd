"""`python -m runners.evaluate`: sessions, all methods on each, one table of how they measure up."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from chsel.errors import SettingError, require_positive
from chsel.methods import METHODS
from chsel.numerics.threads import require_threads
from chsel.plausible.pose_scan import TruePoseSettings
from chsel.problem.settings import CheckedSettings, build_settings, one_of
from replay.console import Console, Progress
from runners.command.program import command, plain, require_used
from runners.evaluation.contenders import chosen_contenders, chosen_policies, require_label
from runners.evaluation.experiment import collect, join_experiment, writing_alone
from runners.evaluation.metrics import MetricsConfig
from runners.evaluation.plan import OBJECTS, OWN, Plan, Trial
from runners.evaluation.run_method import external_folders, read_external
from runners.evaluation.tasks import connected, do_tasks, is_finished, tasks_of
from runners.evaluation.trial_configurations import (
    SENSORS,
    chosen_names,
    chosen_seeds,
    faulty_name,
)
from runners.evaluation.true_poses import check_log, is_missing
from runners.objects.scans import AssetsConfig, scan_file
from runners.reporting.evaluation_folder import open_evaluation
from runners.reporting.sections import short_tables
from runners.reporting.tables import print_table
from runners.run.setup import PresetName
from runners.sessions.faults import CLEAN, LEVELS, LEVELS_OF_POINTS
from runners.sessions.physics_engine import default_engine, require_engine, with_engine
from runners.sessions.probing_settings import without_defaults


@dataclass(frozen=True)
class EvaluateConfig(CheckedSettings):
    """conf/evaluate.yaml, which has all defaults, checked; Any by whoever it concerns."""

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
    iterations: Any  # every: how many, between measures of a search; None: none
    assets: AssetsConfig
    truth: TruePoseSettings
    objects: Annotated[str, one_of(*OBJECTS)]
    steps: Any
    starts: Annotated[str, one_of(OWN, *METHODS)]
    draws: int
    faults: Any
    plausible: bool
    recordings: bool
    policies: Any
    policy: Any
    workers: Annotated[int | None, require_threads]
    scheduler: str | None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.workers is not None and self.scheduler not in (None, "slurm"):
            raise SettingError("workers are of this machine; accepted with a scheduler: null")


@command("evaluate")
def main(config: DictConfig) -> None:
    """Do what is not done yet, and collect all that is there."""
    checked = build_settings(EvaluateConfig, plain(config), where="evaluate")
    if checked.policies is None:
        accepted = "policies=all, or a list of policies, with it"
        require_used("policy", reason="policies is null", accepted=accepted)
    plan = _plan(checked)
    console = Console(soft_wrap=True)
    if plan.kind != SENSORS:
        reason = f"true poses are sought in logs, and the session is {plan.kind}"
        require_used("truth", reason=reason, accepted=f"session={SENSORS} with it")
    levels = chosen_names(
        "faults",
        checked.faults,
        existing=[CLEAN] if plan.kind == SENSORS else LEVELS,
        every=[CLEAN] if plan.kind == SENSORS else LEVELS_OF_POINTS,
    )
    clean = {name: one.object for name, one in plan.configurations.items() if one.faults == CLEAN}
    chosen = chosen_names("configurations", checked.configurations, existing=clean, objects=clean)
    configurations = [faulty_name(name, level) for name in chosen for level in levels]
    seeds = chosen_seeds(checked.seeds)
    trials = [Trial(seed, name) for seed in seeds for name in configurations]
    _check(plan, trials, levels=levels)
    with writing_alone(plan.folder, console.print):
        join_experiment(plan, checked.name, configurations=configurations, seeds=seeds)
        for unfinished in plan.folder.glob("trials/*/*/.*"):  # of a run that was killed
            unfinished.unlink()
        failed = evaluate(plan, trials, config=checked, console=console)
    if failed and HydraConfig.get().mode is not RunMode.MULTIRUN:  # the other jobs must go on
        sys.exit(1)


def evaluate(plan: Plan, trials: list[Trial], *, config: EvaluateConfig, console: Console) -> bool:
    """Do all tasks that are not finished, and write the tables; whether anything failed."""
    tasks = tasks_of(plan, trials)
    missing = [task for task in tasks if not is_finished(plan, task)]
    what = f"{len(plan.policies)} policies" if plan.policies else f"{len(plan.contenders)} methods"
    console.print(
        f"evaluation in {plan.folder}: {len(trials)} trials, {what}, {len(tasks)} tasks, of which "
        f"{len(tasks) - len(missing)} are finished"
    )
    try:
        if missing:
            with (
                connected(config.scheduler, config.workers) as (client, size),
                Progress(console=console, transient=True, disable=not console.is_terminal) as bar,
            ):
                shown = bar.add_task("tasks", total=len(missing))
                for task, failure in do_tasks(plan, missing, client=client, workers=size):
                    bar.update(shown, advance=1, description=str(task))
                    if failure:
                        console.print(f"failed: {task}: {failure}")
    finally:
        results = collect(plan.folder).to_pandas()
        if sys.exc_info()[0] is KeyboardInterrupt:
            console.print("interrupted: what is finished stays, and the same command goes on")
    for table in short_tables(open_evaluation(plan.folder)):
        if table.rows:
            print_table(Console(), table)
    failed = int(results["status"].str.startswith("failed").sum())
    name = "probes" if plan.policies else "results"
    console.print(
        f"{plan.folder / name}.parquet, {name}.csv: {len(results)} rows, {failed} of them failed"
    )
    return failed > 0


def _plan(config: EvaluateConfig) -> Plan:
    def path(folder: object) -> Path:
        """Return the path of a folder as workers on other machines find it."""
        return Path(str(folder)).expanduser().absolute()

    policies = chosen_policies(config.policies, config.policy)
    preset = config.preset.name
    logs = config.session.get("logs")
    session = without_defaults(config.session)
    return Plan(
        folder=path(config.out),
        preset=preset,
        session=with_engine(
            {key: v for key, v in session.items() if key not in ("configuration", "logs")}
        ),
        objects=config.objects,
        definition=config.definition,
        metrics=config.metrics,
        steps=None if config.steps is None else str(config.steps),
        starts=config.starts,
        every=config.iterations["every"],
        recordings=config.recordings,
        assets=path(config.assets.folder),
        contenders=chosen_contenders(
            config.methods, config.settings, preset=preset, draws=config.draws
        ),
        outside=external_folders({str(name): path(f) for name, f in config.outside.items()}),
        logs=None if logs is None else path(logs),
        truth=config.truth,
        plausible=config.plausible and not policies,
        policies=policies,
    )


def _check(plan: Plan, trials: list[Trial], *, levels: tuple[str, ...]) -> None:
    """Raise the errors that all trials would have, before any work."""
    of_policies = (len(plan.contenders), plan.kind == SENSORS, plan.starts, plan.steps, plan.every)
    if plan.policies and (of_policies != (1, False, OWN, None, None) or plan.outside):
        raise SettingError(
            f"policies have {len(plan.contenders)} methods, session={plan.kind}, starts="
            f"{plan.starts}, steps={plan.steps}, iterations.every={plan.every}, {len(plan.outside)}"
            " sets from outside; accepted: 1, kinematic or simulated, own, null, null, 0"
        )
    if plan.every is not None:
        require_positive("iterations.every", plan.every)
    if "faults" in plan.session and (plan.plausible or levels != (CLEAN,)):
        raise SettingError(
            "session.faults is changed; accepted here: faults=LEVEL, or plausible=false with "
            f"faults={CLEAN}"
        )
    to_simulate = plan.kind == "simulated"
    if plan.kind == SENSORS:
        for trial in trials:
            check_log(plan, trial)
        to_simulate = any(is_missing(plan, trial) for trial in trials)
    elif plan.logs is not None:
        raise SettingError(f"session.logs is for session=sensors; this one is {plan.kind}")
    if to_simulate:
        require_engine(plan.session.get("engine") or default_engine())
    if not any(plan.steps_of(trial.configuration) for trial in trials):
        raise SettingError(f"steps is {plan.steps}; accepted: steps that a configuration has")
    for trial in trials:
        plan.session_settings(trial)
        model = plan.object_config(trial.configuration)
        plan.plausible_settings(model.epsilon)
        if model.scan is not None:
            scan_file(plan.assets, model.scan)
    for label, folder in plan.outside.items():
        require_label(label)
        if label in plan.contenders:
            raise SettingError(f"outside has {label}, as methods has; accepted: another name")
        if not folder.is_dir():
            raise SettingError(f"outside.{label} is {folder}; accepted: a folder")
        for trial in trials:
            read_external(plan, trial, label=label)


if __name__ == "__main__":
    main()
