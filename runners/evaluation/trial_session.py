"""The session of a trial: probed once, recorded, with its plausible sets beside it."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from chsel.errors import EvaluationError, RecordingError
from chsel.numerics.arrays import FloatArray
from chsel.plausible.plausible_set import (
    PlausibleSet,
    load_plausible,
    plausible_set,
    save_plausible,
)
from chsel.plausible.plausible_settings import PlausibleSettings
from chsel.problem.online_registration import OnlineSettings
from chsel.problem.registration_problem import ArchiveSnapshot, RegistrationProblem
from replay.environment import environment
from replay.events import (
    Event,
    Logged,
    Probe,
    Recorder,
    SessionEnded,
    SessionStarted,
    SnapshotTaken,
)
from replay.files import WritingError, whole_file
from replay.mcap.writer import McapRecorder
from runners.evaluation.plan import Plan, Trial
from runners.evaluation.trial_configurations import SENSORS
from runners.evaluation.true_poses import ensure_log, guessed_pose, simulated_truth, sought_pose
from runners.objects.loader import check_size, load_object
from runners.sessions import open_session
from runners.sessions.problem_source import ProbedProblems
from runners.sessions.recorded import RecordedSession, RecordedSettings

METHOD = "none"
"""The method that the recording of a session alone names."""
TRUTH = "truth"
"""Key of the configuration under which stands how a true pose was found."""
_ONE = OnlineSettings(hypotheses=1)


class StepRecorder(Recorder):
    """Hands the events of a step to another recorder, if there is one, when the step ends."""

    def __init__(self, recorder: Recorder | None) -> None:
        self.snapshots: list[ArchiveSnapshot] = []  # of the last step
        self._recorder = recorder
        self._waiting: list[Event] = []

    def record(self, event: Event) -> None:
        """Keep it until the step ends."""
        self._waiting.append(event)

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
    """A recorder into a file that is there whole at the end of the context, or not at all.

    path: None for no file.
    """
    if path is None:
        yield StepRecorder(None)
        return
    with whole_file(path) as beside:
        file = McapRecorder(beside)
        try:
            recorder = StepRecorder(file)
            yield recorder
            recorder.flush()
        finally:
            file.close()


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
    try:
        sdf = model.grid(settings)
        truth: FloatArray | None = session.world_from_object
        events: Iterable[Event] = session.probes()
        if log is not None:
            for warning in check_size(model, session.workspace):
                warnings.warn(warning, stacklevel=2)
            # The true pose stands at the beginning, and is found with what is known at the end.
            events = list(events)
            found = ProbedProblems(events, session, sdf, trial.seed)
            at_end = found.problem(max(found.steps, default=0))
            known = guessed_pose(log), plan.truth, simulated_truth(log)
            truth, config[TRUTH] = sought_pose(at_end, model.mesh, *known)
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


@dataclass(frozen=True)
class TrialSession:
    """What session.json tells: steps with a registration, and why some have no plausible set."""

    steps: tuple[int, ...]
    failures: Mapping[int, str]


def make_session(plan: Plan, trial: Trial) -> None:
    """Probe, and make the plausible sets of all steps at which methods will register.

    Those of a session with faults are the sets of the one without.
    """
    folder, clean = trial.folder(plan), trial.without_faults(plan)
    if not (folder / "session.mcap").exists():
        with recording_in(folder / "session.mcap") as recorder:
            record_session(plan, trial, recorder)
    session = open_recorded(plan, trial)
    settings, truth = plausible_settings_of(plan, session), session.world_from_object
    assert truth is not None
    steps, failures = [], {}
    for problem in problems(plan, trial, session):
        step = problem.key.step
        steps.append(step)
        if clean != trial or not plan.plausible:
            continue
        try:
            make_set(folder / "plausible", problem, truth, settings)
        except EvaluationError as error:
            failures[str(step)] = " ".join(str(error).split())
    told: dict[str, Any] = {"steps": steps, "no_plausible_set": failures}
    if TRUTH in session.recorded.config:
        told[TRUTH] = session.recorded.config[TRUTH]
    with whole_file(folder / "session.json") as beside:
        beside.write_text(json.dumps(told, indent=2) + "\n")


def read_session(plan: Plan, trial: Trial) -> TrialSession:
    """What `make_session` wrote down. Raises RecordingError if the file is damaged."""
    return read_told(trial.folder(plan) / "session.json")


def read_told(path: Path) -> TrialSession:
    """What a session.json tells. Raises RecordingError if it is damaged."""
    try:
        told = json.loads(path.read_text())
        failures = {int(step): str(text) for step, text in told["no_plausible_set"].items()}
        steps = tuple(int(step) for step in told["steps"])
        return TrialSession(steps, failures)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise RecordingError(f"{path} is damaged ({error}); remove it") from None


def open_recorded(plan: Plan, trial: Trial) -> RecordedSession:
    """The session of a trial, from its recording."""
    path = trial.folder(plan) / "session.mcap"
    settings = plan.session_settings(trial)
    start = settings.start_contacts, settings.start_probe
    try:
        return RecordedSession(RecordedSettings(str(path), *start))
    except RecordingError as error:
        raise RecordingError(
            f"{error}; or remove it and session.json beside it to have both made again"
        ) from None


def plausible_settings_of(plan: Plan, session: RecordedSession) -> PlausibleSettings:
    """The definition of the plausible sets of a session."""
    config = session.recorded.config["object"]
    return plan.plausible_settings(float(config["epsilon"]))


def problems(
    plan: Plan, trial: Trial, session: RecordedSession, settings: OnlineSettings = _ONE
) -> Iterator[RegistrationProblem]:
    """What is known at every step with a registration, none of which follows from a result.

    settings: of E_0, which is one pose by default, that stands for any.
    """
    online = session.online(settings, trial.seed, only=plan.steps_of(trial.configuration))
    steps = online.steps(session.perceived())
    return (step.problem for step in steps if step.problem is not None)


def load_members(
    plan: Plan, trial: Trial, session: RecordedSession, problem: RegistrationProblem
) -> PlausibleSet:
    """The plausible set of a step, which `make_session` made."""
    folder = trial.folder(plan) / "plausible"
    settings = plausible_settings_of(plan, session)
    found = load_plausible(folder, problem, settings, world_from_object=session.world_from_object)
    if found is None:
        raise EvaluationError(
            f"{folder} has no set of step {problem.key.step}; remove session.json"
        )
    return found


def make_set(
    folder: Path, problem: RegistrationProblem, truth: FloatArray, settings: PlausibleSettings
) -> None:
    """Make the set of a step unless it is there."""
    if load_plausible(folder, problem, settings, world_from_object=truth) is None:
        found = plausible_set(problem, truth, settings)
        try:
            save_plausible(folder, found)
        except EvaluationError as error:
            raise WritingError(str(error)) from error
