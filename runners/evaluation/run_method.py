"""A method on the session of a trial: its registrations, recorded, and a row about each."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

from chsel.plausible.symmetry import object_symmetry
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses, RegistrationProblem
from replay.environment import environment
from replay.events import (
    Event,
    Logged,
    Recorder,
    SessionEnded,
    SessionStarted,
    SnapshotTaken,
)
from replay.files import file_digest
from replay.mcap.writer import McapRecorder
from runners.evaluation.contenders import Contender
from runners.evaluation.plan import OWN, Plan, Trial
from runners.evaluation.repeats import repeat_seed
from runners.evaluation.result_rows import ResultRows
from runners.evaluation.table import ITERATIONS, RESULTS, Row, write_part
from runners.evaluation.trial_session import open_recorded
from runners.run.recording import RecordingConfig
from runners.run.session_run import SessionRun
from runners.sessions.recorded import RecordedSession


def run_method(plan: Plan, trial: Trial, contender: Contender, warm: set[str]) -> None:
    """Write METHOD.mcap, if recordings are wanted, and then the method's part of the table.

    warm: labels that have registered in this process before; others do so once untimed, so that
    no time holds the loading of compiled kernels.
    """
    folder = trial.folder(plan)
    session, chosen = open_recorded(plan, trial), plan.steps_of(trial.configuration)
    method, leader = contender.method(), plan.leader()
    rows: list[Row] = []
    iterations: list[Row] = []
    recorder: Recorder = Recorder()
    if plan.recordings:
        recorder = McapRecorder(folder / f"{contender.label}.mcap")
    recorder.record(_started(plan, trial, contender, session))
    by_step = _ByStep(recorder)
    run = SessionRun(
        session,
        session.online(
            (leader or method).online,
            repeat_seed(trial.seed, contender.draw),
            only=chosen if leader is None else None,
        ),
        method,
        by_step,
        symmetry=object_symmetry(session.recorded.mesh),
        recording=RecordingConfig(snapshot_interval=plan.every or 0),
        show=lambda *_: None,
    )

    def register(problem: RegistrationProblem) -> Hypotheses:
        if contender.label not in warm:
            warm.add(contender.label)
            with suppress(Exception):  # it fails again when it is recorded
                method.register(problem)
        return run.register(problem)

    def register_and_lead(problem: RegistrationProblem) -> Hypotheses:
        """The leader's result, which the next problem follows from."""
        assert leader is not None
        if problem.key.step in chosen:
            try:
                register(problem)
            except Exception as error:
                run.failed(problem.key.step, error)
        return leader.register(problem)

    steps = run.steps(register, Exception) if leader is None else run.steps(register_and_lead)
    result_rows = ResultRows(plan, trial, session, contender.label, contender.preset, method)
    for step, _ in steps:
        problem = step.problem
        if problem is None or step.step not in chosen:
            continue
        found = None if run.registered is None else run.registered.hypotheses
        members, missing = result_rows.members(problem)
        row = result_rows.row(problem, found, members, run.failure or missing)
        if run.registered is not None:
            row["seconds"] = run.registered.total_seconds
        rows.append(row)
        if found is not None and members is not None and plan.every is not None:
            taken = by_step.snapshots
            iterations += result_rows.iterations(problem, taken, method.settings, members)
    recorder.record(Logged(run.step, "info", "session finished"))
    recorder.record(SessionEnded(run.step, "finished"))
    recorder.close()
    if plan.every is not None:
        write_part(folder / f"{contender.label}.iterations.parquet", iterations, ITERATIONS)
    write_part(folder / f"{contender.label}.parquet", rows, RESULTS)


class _ByStep(Recorder):
    """Records the events of a step when it ends, so that no writing is timed.

    Of the snapshots that measuring takes, the first and the last of a search are recorded.
    snapshots: all that were taken in the last step.
    """

    def __init__(self, recorder: Recorder) -> None:
        self.snapshots: list[ArchiveSnapshot] = []
        self._recorder = recorder
        self._waiting: list[Event] = []

    def record(self, event: Event) -> None:
        """Keep it until the step ends."""
        self._waiting.append(event)

    def flush(self) -> None:
        """Record what was kept."""
        self.snapshots = [e.archive for e in self._waiting if isinstance(e, SnapshotTaken)]
        for index, event in enumerate(self._waiting):
            if not isinstance(event, SnapshotTaken) or self._ends(index):
                self._recorder.record(event)
        self._waiting.clear()
        self._recorder.flush()

    def close(self) -> None:
        """Finish the recording."""
        self._recorder.close()

    def _ends(self, index: int) -> bool:
        """Whether a snapshot is the first or the last of its pass."""
        passes = [
            event.archive.refinement if isinstance(event, SnapshotTaken) else None
            for event in self._waiting
        ]
        before, after = passes[:index], passes[index + 1 :]
        return passes[index] not in before or passes[index] not in after


def _started(
    plan: Plan, trial: Trial, contender: Contender, session: RecordedSession
) -> SessionStarted:
    of = session.recorded
    # Problems of another method do not follow from the results of this one.
    source = "" if plan.starts == OWN else file_digest(trial.folder(plan) / "session.mcap")
    return replace(
        of,
        runner="evaluate",
        method=contender.name,
        config={
            **of.config,
            "method": {"name": contender.name, **contender.settings},
            "preset": {"name": contender.preset},
        },
        environment=environment(),
        source=source,
    )
