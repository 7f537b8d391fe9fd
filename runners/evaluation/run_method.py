"""A method on the session of a trial: its registrations, recorded, and a row about each."""

from __future__ import annotations

from dataclasses import replace

from chsel.plausible.symmetry import object_symmetry
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.rehearsal import warm_up
from replay.environment import environment
from replay.events import Logged, SessionEnded, SessionStarted
from replay.files import file_digest
from runners.evaluation.contenders import Contender
from runners.evaluation.plan import OWN, Plan, Trial
from runners.evaluation.repeats import repeat_seed
from runners.evaluation.result_rows import ResultRows
from runners.evaluation.step_recorder import StepRecorder, recording_in
from runners.evaluation.table import ITERATIONS, RESULTS, Row, write_part
from runners.evaluation.trial_session import open_recorded
from runners.run.recording import RecordingConfig
from runners.run.session_run import SessionRun
from runners.sessions.recorded import RecordedSession


def run_method(plan: Plan, trial: Trial, contender: Contender) -> None:
    """Write METHOD.mcap, if recordings are wanted, and then the method's part of the table."""
    warm_up(contender.method())  # so that no time holds the loading of compiled kernels
    folder, iterations = trial.folder(plan), list[Row]()
    file = folder / f"{contender.label}.mcap" if plan.recordings else None
    with recording_in(file) as recorder:
        rows = _rows(plan, trial, contender, recorder, iterations)
    if plan.every is not None:
        write_part(folder / f"{contender.label}.iterations.parquet", iterations, ITERATIONS)
    write_part(folder / f"{contender.label}.parquet", rows, RESULTS)


def _rows(
    plan: Plan, trial: Trial, contender: Contender, recorder: StepRecorder, iterations: list[Row]
) -> list[Row]:
    """A row for every registration. iterations: gets those of the searches, where wanted."""
    session, chosen = open_recorded(plan, trial), plan.steps_of(trial.configuration)
    method, leader = contender.method(), plan.leader()
    recorder.record(_started(plan, trial, contender, session))
    run = SessionRun(
        session,
        session.online(
            (leader or method).online,
            repeat_seed(trial.seed, contender.draw),
            only=chosen if leader is None else None,
        ),
        method,
        recorder,
        symmetry=object_symmetry(session.recorded.mesh),
        recording=RecordingConfig(snapshot_interval=plan.every or 0),
        show=lambda *_: None,
    )

    def register_and_lead(problem: RegistrationProblem) -> Hypotheses:
        """The leader's result, which the next problem follows from."""
        assert leader is not None
        if problem.key.step in chosen:
            try:
                run.register(problem)
            except Exception as error:
                run.failed(problem.key.step, error)
        return leader.register(problem)

    steps = run.steps(catch=Exception) if leader is None else run.steps(register_and_lead)
    result_rows = ResultRows(plan, trial, session, contender.label, method)
    rows: list[Row] = []
    for step, _ in steps:
        problem = step.problem
        if problem is None or step.step not in chosen:
            continue
        if run.registered is None:
            rows.append(result_rows.row(problem, None, run.failure))
            continue
        row = result_rows.row(problem, run.registered.hypotheses)
        rows.append(row | {"seconds": run.registered.total_seconds})
        if plan.every is not None:
            iterations += result_rows.iterations(problem, recorder.snapshots, method.settings)
    recorder.record(Logged(run.step, "info", "session finished"))
    recorder.record(SessionEnded(run.step, "finished"))
    return rows


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
