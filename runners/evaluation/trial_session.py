"""The session of a trial: probed once, recorded, with its plausible sets beside it."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any

from chsel.errors import EvaluationError
from chsel.events import Event, Logged, Probe, Recorder, SessionEnded, SnapshotTaken
from chsel.numerics.arrays import FloatArray
from chsel.plausible import plausible_set as sets
from chsel.plausible.plausible_set import PlausibleSet
from chsel.plausible.plausible_settings import PlausibleSettings
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.registration_problem import ArchiveSnapshot, RegistrationProblem
from replay.files import WritingError, whole_file
from replay.mcap.writer import McapRecorder
from runners.evaluation.contenders import Contender
from runners.evaluation.plan import Plan, Trial
from runners.evaluation.trial_configurations import SENSORS
from runners.evaluation.true_poses import ensure_log, guessed_pose, simulated_truth, sought_pose
from runners.objects.scans import AssetsConfig
from runners.run.recording import RecordingConfig
from runners.run.setup import (
    GRID,
    GraspConfig,
    PresetName,
    ProbeConfig,
    open_setup,
    session_started,
)
from runners.sessions.problem_file import ProbedProblems
from runners.sessions.recorded import RecordedSettings, RecordedSource

TRUTH = "truth"
"""Key of the configuration under which stands how a true pose was found."""
_NO_ARCHIVES = "http://localhost"  # scans were fetched before
_ONE = OnlineSettings(hypotheses=1)  # E_0 of one pose, which stands for any


class StepRecorder(Recorder):
    """A recorder that passes the events of a step on, if there is another, when the step ends."""

    def __init__(self, recorder: Recorder | None) -> None:
        self.step = 0  # of the last probe
        self.snapshots: list[ArchiveSnapshot] = []  # of the last step
        self._recorder = recorder
        self._waiting: list[Event] = []

    def record(self, event: Event) -> None:
        """Keep it until the step ends."""
        self._waiting.append(event)
        if isinstance(event, Probe):
            self.step = event.step

    def flush(self) -> None:
        """Record what was kept."""
        self.snapshots = [e.archive for e in self._waiting if isinstance(e, SnapshotTaken)]
        if self._recorder is not None:
            for event in self._waiting:
                self._recorder.record(event)
            self._recorder.flush()
        self._waiting.clear()


@contextmanager
def recording_in(path: Path | None) -> Iterator[StepRecorder]:
    """Open the recorder of a session, into a file that is whole at the end, or does not exist."""
    if path is None:
        yield StepRecorder(None)
        return
    with whole_file(path) as beside:
        file = McapRecorder(beside)
        try:
            recorder = StepRecorder(file)
            yield recorder
            recorder.record(Logged(recorder.step, "info", text="session finished"))
            recorder.record(SessionEnded(recorder.step, "finished"))
            recorder.flush()
        finally:
            file.close()


def probe_config(plan: Plan, trial: Trial, *, policy: Contender | None = None) -> ProbeConfig:
    """Return the configuration of `runners.probe` for the probes of a trial."""
    first = next(iter(plan.contenders.values()), None)
    return ProbeConfig(
        object=plan.object_config(trial.configuration),
        session=plan.session_config(trial),
        method={"name": first.name, **first.settings} if first else {},
        policy={"name": policy.name, **policy.settings} if policy else {"name": GRID},
        preset=PresetName(str(first.preset) if first and policy else plan.preset),
        grasp=GraspConfig(),
        recording=RecordingConfig(),
        assets=AssetsConfig(str(plan.assets), _NO_ARCHIVES),
        logs="",
        seed=trial.seed,
        threads=1,
        from_step=None,
        configuration=trial.configuration,
    )


def config_values(config: ProbeConfig) -> dict[str, Any]:
    """Return the configuration as `session_started` takes it."""
    return {name: vars(v) if is_dataclass(v) else v for name, v in vars(config).items()}


def record_session(plan: Plan, trial: Trial, *, recorder: Recorder) -> None:
    """Probe, or read the trial's raw log, and write it all down; of a log with its true pose."""
    log = ensure_log(plan, trial) if plan.kind == SENSORS else None
    config = probe_config(plan, trial)
    setup, values = open_setup(config), config_values(config)
    session = setup.source
    values["session"] = dict(values["session"])
    values.pop("method")
    try:
        for warning in setup.warnings:
            warnings.warn(warning, stacklevel=2)
        truth = session.world_from_object
        events = list(session.probes())
        if log is not None:  # found with what is known at the end
            found = ProbedProblems(events, session, sdf=setup.sdf, seed=trial.seed)
            at_end = found.problem(max(found.steps, default=0))
            guess, known = guessed_pose(log), simulated_truth(log)
            truth, values[TRUTH] = sought_pose(
                at_end, setup.mesh, guess=guess, settings=plan.truth, truth=known
            )
            values["session"] |= {"path": f"{trial.configuration}/{log.name}"}
        started = session_started(config, values, method_name="none", setup=setup)
        recorder.record(replace(started, runner="evaluate", world_from_object=truth, start=None))
        for event in events:
            recorder.record(event)
            if isinstance(event, Probe):
                recorder.flush()
    finally:
        session.close()


def make_session(plan: Plan, trial: Trial) -> None:
    """Probe, and make the plausible sets of all steps, unless these are of another session."""
    folder, clean = trial.folder(plan), trial.without_faults(plan)
    if not (folder / "session.mcap").exists():
        with recording_in(folder / "session.mcap") as recorder:
            record_session(plan, trial, recorder=recorder)
    session = open_recorded(plan, trial)
    settings = plausible_settings_of(plan, session)
    truth = session.world_from_object
    assert truth is not None
    steps, failures = [], {}
    for problem in problems(plan, trial, session=session):
        steps.append(problem.key.step)
        if clean == trial and plan.plausible:
            try:
                made_set(folder / "plausible", problem, truth=truth, settings=settings)
            except EvaluationError as error:
                failures[str(problem.key.step)] = " ".join(str(error).split())
    notes: dict[str, Any] = {"steps": steps, "no_plausible_set": failures}
    if TRUTH in session.recorded.config:
        notes[TRUTH] = session.recorded.config[TRUTH]
    with whole_file(folder / "session.json") as beside:
        beside.write_text(json.dumps(notes, indent=2) + "\n")


def read_told(folder: Path) -> dict[str, Any]:
    """Return what `make_session` wrote: steps with a registration, and why some have no set."""
    return dict(json.loads((folder / "session.json").read_text()))


def open_recorded(plan: Plan, trial: Trial) -> RecordedSource:
    """Return the session of a trial, from its recording."""
    path = trial.folder(plan) / "session.mcap"
    settings = plan.session_settings(trial)
    return RecordedSource(
        RecordedSettings(str(path), settings.start_contacts, start_probe=settings.start_probe)
    )


def plausible_settings_of(plan: Plan, session: RecordedSource) -> PlausibleSettings:
    """Return the definition of the plausible sets of a session."""
    config = session.recorded.config["object"]
    return plan.plausible_settings(float(config["epsilon"]))


def problems(
    plan: Plan, trial: Trial, *, session: RecordedSource, settings: OnlineSettings = _ONE
) -> Iterator[RegistrationProblem]:
    """Yield the problem of every step with a registration; none follows from a result."""
    loop = session.loop(settings, seed=trial.seed, steps=plan.steps_of(trial.configuration))
    return loop.problems(session.probes())


def made_set(
    folder: Path,
    problem: RegistrationProblem,
    *,
    truth: FloatArray,
    settings: PlausibleSettings,
) -> tuple[PlausibleSet, bool]:
    """Return the set of a step, and whether it was there."""
    found = sets.load_plausible(folder, problem, settings=settings, world_from_object=truth)
    if found is not None:
        return found, True
    found = sets.plausible_set(problem, truth, settings=settings)
    try:
        sets.save_plausible(folder, found)
    except EvaluationError as error:
        raise WritingError(str(error)) from error
    return found, False
