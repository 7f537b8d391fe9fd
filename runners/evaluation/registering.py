"""A method on the session of a trial: its registrations, recorded, and a row about each."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

from chsel.methods.method import Method
from chsel.plausible.symmetry import object_symmetry
from chsel.problem.registration_problem import (
    ArchiveSnapshot,
    Hypotheses,
    Observer,
    RegistrationProblem,
)
from chsel.problem.warm_start import OnlineSettings
from replay.environment import environment
from replay.events import (
    Event,
    HypothesesFound,
    Logged,
    Probe,
    ProblemPosed,
    Recorder,
    SessionEnded,
    SessionStarted,
    SnapshotTaken,
)
from replay.file_digest import file_digest
from replay.mcap.writer import McapRecorder
from replay.recorder import NullRecorder
from runners.evaluation.contenders import Contender
from runners.evaluation.draws import draw_seed
from runners.evaluation.judge import Judge, one_line
from runners.evaluation.plan import OWN, Plan, Trial
from runners.evaluation.table import ITERATIONS, RESULTS, Row, write_part
from runners.evaluation.trial_session import open_recorded
from runners.recording import RecordingConfig
from runners.session_run import SessionRun
from runners.sessions.recorded import RecordedSession
from runners.whole_file import whole_file


def register_trial(plan: Plan, trial: Trial, contender: Contender, warm: set[str]) -> None:
    """Write METHOD.mcap, if recordings are wanted, and then the method's part of the table.

    warm: labels that have registered in this process before; others do so once untimed, so that
    no time holds the loading of compiled kernels.
    """
    folder = trial.folder(plan)
    session = open_recorded(plan, trial)
    method = _TimedMethod(contender.method(), plan.leader(), warm=contender.label in warm)
    warm.add(contender.label)
    rows: list[Row] = []
    iterations: list[Row] = []
    with ExitStack() as stack:
        recorder: Recorder = NullRecorder()
        if plan.recordings:
            beside = stack.enter_context(whole_file(folder / f"{contender.label}.mcap"))
            recorder = McapRecorder(beside)
        recorder.record(_started(plan, trial, contender, session))
        following = _Following(recorder)
        seed = draw_seed(trial.seed, contender.draw)
        run = _EvaluatedRun(plan, trial, session, method, following, seed)
        judge = Judge(plan, trial, session, contender.label, contender.preset)
        for _ in run.steps():
            if following.posed is not None:
                problem, found = following.posed.problem, following.found
                members, missing = judge.members(problem)
                row = judge.row(problem, found, members, run.failure or missing)
                if found is not None:
                    row["seconds"] = method.seconds
                rows.append(row)
                if found is not None and members is not None and plan.every is not None:
                    taken = following.snapshots
                    iterations += judge.iterations(problem, taken, method.settings, members)
            following.forget()
        recorder.record(Logged(run.step, "info", "session finished"))
        recorder.record(SessionEnded(run.step, "finished"))
        recorder.close()
    if plan.every is not None:
        write_part(folder / f"{contender.label}.iterations.parquet", iterations, ITERATIONS)
    write_part(folder / f"{contender.label}.parquet", rows, RESULTS)


class _TimedMethod:
    """A method whose last registration is timed; the first of all runs twice unless warm."""

    def __init__(self, method: Method, leader: Method | None, *, warm: bool) -> None:
        """leader: the method whose problems are posed to this one, if they are not its own."""
        self.inner, self.leader, self._warm = method, leader, warm
        self.settings: Any = method.settings
        self.seconds: float | None = None

    @property
    def online(self) -> OnlineSettings:
        """How a session makes the next problem."""
        return (self.leader or self.inner).online

    def register(
        self, problem: RegistrationProblem, observer: Observer | None = None
    ) -> Hypotheses:
        """What the method finds."""
        if not self._warm:
            self._warm = True
            self.inner.register(problem)
        self.seconds = None
        begun = time.perf_counter()
        found = self.inner.register(problem, observer)
        self.seconds = time.perf_counter() - begun
        return found


class _Following(Recorder):
    """Keeps the events of a step, and records them when it ends, so that no writing is timed.

    Of the snapshots that measuring takes, the first and the last of a search are recorded.
    """

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._waiting: list[Event] = []
        self.forget()

    def forget(self) -> None:
        """A new step begins."""
        self.posed: ProblemPosed | None = None
        self.found: Hypotheses | None = None
        self.snapshots: list[ArchiveSnapshot] = []

    def record(self, event: Event) -> None:
        """Keep it."""
        self._waiting.append(event)
        if isinstance(event, ProblemPosed):
            self.posed = event
        elif isinstance(event, HypothesesFound):
            self.found = event.hypotheses
        elif isinstance(event, SnapshotTaken):
            self.snapshots.append(event.archive)

    def flush(self) -> None:
        """Record what was kept."""
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


class _EvaluatedRun(SessionRun):
    """A session that registers at chosen steps, and goes on where a registration fails."""

    def __init__(
        self,
        plan: Plan,
        trial: Trial,
        session: RecordedSession,
        method: _TimedMethod,
        recorder: Recorder,
        seed: int,
    ) -> None:
        super().__init__(
            session,
            method,
            session.recorded.sdf,
            recorder,
            symmetry=object_symmetry(session.recorded.mesh),
            seed=seed,
            start=session.start,
            recording=RecordingConfig(snapshot_interval=plan.every or 0),
            show=lambda *_: None,
        )
        self._chosen = frozenset(plan.steps_of(trial.configuration))
        self._leader = method.leader
        self.failure = ""

    def _enough(self, probe: Probe) -> bool:
        taking_part = self._leader is not None or probe.step in self._chosen
        return taking_part and super()._enough(probe)

    def _register(self, step: int, seconds: dict[str, float]) -> dict[str, Any]:
        self.failure = ""
        before, row = self.previous, {}
        try:
            if step in self._chosen:
                row = super()._register(step, seconds)
        except Exception as error:
            self.failure = one_line(error)
            self._recorder.record(Logged(step, "warning", f"no result: {self.failure}"))
        if self._leader is not None:
            self.previous = self._leader.register(self._pose(step, before))
        return row


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
