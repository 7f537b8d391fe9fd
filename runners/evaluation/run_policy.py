"""A policy on the session of a trial: what it probes, recorded, and a row about each probe."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from chsel.next_probe.decision_problem import Belief, Decision
from chsel.next_probe.forecast import belief_after, belief_before
from chsel.numerics.arrays import FloatArray
from chsel.plausible.symmetry import object_symmetry
from chsel.policies.policy import PolicySettings, StopSettings
from chsel.problem.online_registration import OnlineRegistration, OnlineStep
from chsel.problem.outline import (
    in_order,
    outline_distances,
    outline_distances_to,
    surface_spread,
)
from chsel.problem.poses import Poses, inverse
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from chsel.rehearsal import warm_up, warm_up_policy
from replay.events import Logged, SessionEnded
from runners.evaluation.contenders import Contender, PolicyContender
from runners.evaluation.plan import Plan, Trial
from runners.evaluation.table import PROBES, Row, write_part
from runners.evaluation.trial_session import StepRecorder, recording_in
from runners.objects.scans import AssetsConfig
from runners.run.recording import RecordingConfig
from runners.run.scene import PresetName, ProbeConfig, Scene, open_scene, session_started
from runners.run.session_run import SessionRun

_NO_ARCHIVES = "http://localhost"  # scans were fetched before


def run_policy(plan: Plan, trial: Trial, contender: PolicyContender) -> None:
    """Write POLICY.mcap, if recordings are wanted, and then the policy's part of the table.

    The session is that of `runners.probe`.
    """
    folder = trial.folder(plan)
    (registering,) = plan.contenders.values()
    warm_up(registering.method())  # so that no time holds the loading of compiled kernels
    warm_up_policy(contender.policy())
    config = _config(plan, trial, registering, contender)
    scene = open_scene(config)
    file = folder / f"{contender.label}.mcap" if plan.recordings else None
    try:
        with recording_in(file) as recorder:
            started = session_started(config, _values(config), registering.name, scene)
            recorder.record(replace(started, runner="evaluate"))
            rows = _rows(plan, trial, contender, scene, recorder)
    finally:
        scene.session.close()
    write_part(folder / f"{contender.label}.parquet", rows, PROBES)


def _rows(
    plan: Plan, trial: Trial, contender: PolicyContender, scene: Scene, recorder: StepRecorder
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
    about = plan.about(trial, contender.label)
    rows: list[Row] = []
    for step, numbers in run.steps(catch=Exception):
        rows.append(about | _row(scene, settings, trial.seed, step, numbers, run, online))
        if len(rows) >= settings.probes:  # of a session that no policy ends
            break
    recorder.record(Logged(run.step, "info", "session finished"))
    recorder.record(SessionEnded(run.step, "finished"))
    return rows


def _row(
    scene: Scene,
    settings: PolicySettings,
    seed: int,
    step: OnlineStep,
    numbers: Row,
    run: SessionRun,
    online: OnlineRegistration,
) -> dict[str, Any]:
    """What is known after a step. numbers: the run's own row. online: the loop that it walks."""
    assert scene.session.world_from_object is not None
    truth = Poses.of(inverse(scene.session.world_from_object[None]))

    def errors(poses: FloatArray) -> FloatArray:
        """How far the surface in poses (B, 4, 4), object_from_world, is from the true one (B,)."""
        return outline_distances_to(scene.sdf, Poses.of(poses), truth)

    after = None if run.steering is None else run.steering.last
    if after is None:
        belief = _belief(scene, settings, StreamKey(seed, step.step + 1), online)
    else:
        belief = after.problem.belief
    error = in_order(belief.weights * errors(belief.object_from_world))
    row: dict[str, Any] = {
        "step": step.step,
        "probes": step.step + 1,
        "status": f"failed: {run.failure}" if run.failure else "ok",
        "contacts": numbers["contacts"],
        "free_points": numbers["free_points"],
        "hit": numbers["outcome"] == "contact",
        "poses": len(belief),
        "belief_error": float(error),
        "error": float(error),
        "spread": spread_of(scene.sdf, belief),
        "action": numbers.get("action"),
        "hit_forecast": numbers.get("hit_chance"),
        "forecast_spread": numbers.get("expected_spread"),
    }
    found = online.previous
    if found is not None and len(found.cost) > 0:
        row["error"] = float(errors(found.object_from_world).mean())
    if run.registered is not None and step.problem is not None:
        hypotheses = run.registered.hypotheses
        row |= {
            "hypotheses": len(hypotheses.cost),
            "digest": hypotheses.digest,
            "problem_digest": step.problem.digest,
            "seconds": run.registered.total_seconds,
        }
    if after is None:
        return row | {"stop": usual_stop(row["spread"], None)}
    spread, promised = after.decision.spread, promised_gain(after.decision)
    return row | {
        "spread": spread,
        "promised": promised,
        "surprise": numbers["surprise"],
        "decision_seconds": numbers["seconds_by_stage"].get("decision"),
        "decision_digest": after.decision.digest,
        "stop": usual_stop(spread, promised) or after.decision.stop,
    }


def _belief(
    scene: Scene, settings: PolicySettings, key: StreamKey, online: OnlineRegistration
) -> Belief:
    """What a policy would weigh up in a session that makes no decisions."""
    found = online.previous
    if found is not None and len(found.cost) > 0:
        return belief_after(found, settings.belief)
    points, workspace = online.points, scene.session.workspace
    return belief_before(scene.sdf, points, workspace, key, settings.belief)


def spread_of(sdf: SdfGrid, belief: Belief) -> float:
    """Spread of a belief, metres, as decisions have it."""
    poses = Poses.of(belief.object_from_world)
    return surface_spread(outline_distances(sdf, poses), belief.weights)


def promised_gain(decision: Decision) -> float | None:
    """By how much the best action that can be taken would narrow the belief, metres.

    None if there is none.
    """
    feasible = np.isfinite(decision.score)
    if not feasible.any():
        return None
    return decision.spread - float(decision.expected_spread[feasible].min())


def usual_stop(spread: float, promised: float | None) -> str:
    """Why a session would end by the rules that policies have by default; "" if it goes on."""
    rules = StopSettings()
    if spread <= rules.spread:
        return "spread"
    return "gain" if promised is not None and promised < rules.gain else ""


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
