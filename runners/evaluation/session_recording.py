"""The recording of a trial's session, which all methods register."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import Any

from chsel.numerics.arrays import FloatArray
from replay.environment import environment
from replay.events import Event, Logged, Probe, Recorder, SessionEnded, SessionStarted
from runners.evaluation.configurations import SENSORS
from runners.evaluation.plan import Plan, Trial
from runners.evaluation.sensor_logs import ensure_log
from runners.evaluation.trial_truth import find_truth, known_at_the_end
from runners.objects.loader import load_object
from runners.objects.size_check import check_size
from runners.sessions import open_session

METHOD = "none"
"""The method that the recording of a session alone names."""
TRUTH = "truth"
"""Key of the configuration under which stands how a true pose was found."""


def record_session(plan: Plan, trial: Trial, recorder: Recorder) -> None:
    """Probe, or read the trial's raw log, and write it all down; of a log with its true pose."""
    log = ensure_log(plan, trial) if plan.kind == SENSORS else None
    object_config = plan.object_config(trial.configuration)
    model = load_object(object_config, plan.assets)
    settings = plan.session_settings(trial)
    config: dict[str, Any] = {
        "object": vars(object_config),
        "session": plan.session_config(trial),
        "preset": {"name": plan.preset},
        "seed": trial.seed,
        "configuration": trial.configuration,
    }
    session = open_session(plan.kind, settings, model, trial.seed)
    if plan.kind == SENSORS:
        for warning in check_size(model, session.workspace):
            warnings.warn(warning, stacklevel=2)
    try:
        sdf = model.grid(settings)
        truth: FloatArray | None = session.world_from_object
        events: Iterable[Event] = session.probes()
        if log is not None:
            # The true pose stands at the beginning, and is found with what is known at the end.
            events = list(events)
            problem = known_at_the_end(trial, session, sdf, events)
            truth, config[TRUTH] = find_truth(plan, problem, model.mesh, log)
            config["session"]["path"] = f"{trial.configuration}/{log.name}"
        recorder.record(
            SessionStarted(
                runner="evaluate",
                object=model.name,
                session=plan.kind,
                method=METHOD,
                seed=trial.seed,
                config=config,
                mesh=model.mesh,
                sdf=sdf,
                workspace=session.workspace,
                free_resolution=session.free_resolution,
                initial_points=session.initial_points,
                world_from_object=truth,
                environment=environment(),
            )
        )
        step = 0
        for event in events:
            recorder.record(event)
            if isinstance(event, Probe):
                step = event.step
                recorder.flush()
        recorder.record(Logged(step, "info", "session finished"))
        recorder.record(SessionEnded(step, "finished"))
    finally:
        session.close()
        recorder.close()
