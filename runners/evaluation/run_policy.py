"""A policy on the session of a trial: what it probes, recorded, and a row about each probe."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from chsel.plausible.symmetry import object_symmetry
from chsel.rehearsal import warm_up, warm_up_policy
from replay.events import Logged, Recorder, SessionEnded
from replay.mcap.writer import McapRecorder
from runners.evaluation.contenders import Contender
from runners.evaluation.plan import Plan, Trial
from runners.evaluation.policy_contenders import PolicyContender
from runners.evaluation.probe_rows import ProbeRows, row_about
from runners.evaluation.table import PROBES, Row, write_part
from runners.objects.scans import AssetsConfig
from runners.run.recording import RecordingConfig
from runners.run.scene import PresetName, ProbeConfig, Scene, open_scene, session_started
from runners.run.session_run import SessionRun

_NO_ARCHIVES = "http://localhost"  # scans were fetched before


def run_policy(plan: Plan, trial: Trial, contender: PolicyContender, warm: set[str]) -> None:
    """Write POLICY.mcap, if recordings are wanted, and then the policy's part of the table.

    The session is that of `runners.probe`. warm: labels that have been at work in this process
    before; of others all kernels are loaded first, so that no time holds that.
    """
    folder = trial.folder(plan)
    (registering,) = plan.contenders.values()
    if contender.label not in warm:
        warm.add(contender.label)
        warm_up(registering.method())
        warm_up_policy(contender.policy())
    recorder: Recorder = Recorder()
    if plan.recordings:
        recorder = McapRecorder(folder / f"{contender.label}.mcap")
    config = _config(plan, trial, registering, contender)
    scene = open_scene(config)
    try:
        started = session_started(config, _values(config), registering.name, scene)
        recorder.record(replace(started, runner="evaluate"))
        rows = _rows(plan, trial, contender, scene, recorder)
    finally:
        scene.session.close()
        recorder.close()
    write_part(folder / f"{contender.label}.parquet", rows, PROBES)


def _rows(
    plan: Plan, trial: Trial, contender: PolicyContender, scene: Scene, recorder: Recorder
) -> list[Row]:
    """A row for every probe until the budget is spent, or nothing is left to probe."""
    (registering,) = plan.contenders.values()
    method, settings = registering.method(), contender.policy().settings
    online = scene.online(method.online, trial.seed)
    run = SessionRun(
        scene.session,
        online,
        method,
        recorder,
        symmetry=object_symmetry(scene.mesh),
        recording=RecordingConfig(),
        show=lambda *_: None,
        steering=scene.steering,
    )
    probe_rows = ProbeRows(row_about(plan, trial, contender.label), scene, settings)
    rows: list[Row] = []
    for step, numbers in run.steps(catch=Exception):
        rows.append(probe_rows.row(step, numbers, run, online))
        if len(rows) >= settings.probes:  # of a session that no policy ends
            break
    recorder.record(Logged(run.step, "info", "session finished"))
    recorder.record(SessionEnded(run.step, "finished"))
    return rows


def _config(
    plan: Plan, trial: Trial, registering: Contender, contender: PolicyContender
) -> ProbeConfig:
    """What `runners.probe` would be asked for."""
    return ProbeConfig(
        object=plan.object_config(trial.configuration),
        session=plan.session_config(trial),
        method={"name": registering.name, **registering.settings},
        policy={"name": contender.name, **contender.settings},
        preset=PresetName(registering.preset),
        recording=RecordingConfig(),
        assets=AssetsConfig(str(plan.assets), _NO_ARCHIVES),
        logs="",
        seed=trial.seed,
        threads=1,
        configuration=trial.configuration,
    )


def _values(config: ProbeConfig) -> dict[str, Any]:
    """The same as a recording has it."""
    return {
        "object": vars(config.object),
        "session": config.session,
        "method": config.method,
        "policy": config.policy,
        "preset": vars(config.preset),
        "seed": config.seed,
        "configuration": config.configuration,
    }
