"""A method on the session of a trial: its registrations, recorded, and a row about each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from chsel.errors import EvaluationError
from chsel.methods.method import Method
from chsel.plausible.evaluation_cost import EvaluationCost
from chsel.plausible.plausible_set import PlausibleSet
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import object_symmetry
from chsel.problem.poses import inverse
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses, RegistrationProblem
from chsel.problem.search_space import search_space
from chsel.problem.streams import Purpose, StreamKey
from chsel.qd.selection import ranked, select_elites
from chsel.rehearsal import warm_up
from replay.environment import environment
from replay.events import Logged, SessionEnded, SessionStarted
from replay.files import file_digest
from runners.evaluation.contenders import Contender, repeat_seed
from runners.evaluation.metrics import HypothesisMetrics
from runners.evaluation.plan import OWN, Plan, Trial
from runners.evaluation.table import ITERATIONS, RESULTS, Row, write_part
from runners.evaluation.trial_session import (
    StepRecorder,
    load_members,
    open_recorded,
    plausible_settings_of,
    problems,
    read_session,
    recording_in,
)
from runners.run.recording import RecordingConfig
from runners.run.session_run import SessionRun, one_line
from runners.sessions.recorded import RecordedSession


class ResultRows:
    """Makes rows of the table of what was found at the steps of a trial."""

    def __init__(
        self,
        plan: Plan,
        trial: Trial,
        session: RecordedSession,
        label: str,
        method: Method | None = None,
    ) -> None:
        """method: that made the hypotheses; one with `holds` tells whether its set has the truth.

        A session with faults is measured by the plausible sets of the same probes without any.
        """
        assert session.world_from_object is not None
        self._plan, self._trial, self._session = plan, trial, session
        self._about, self._holds = plan.about(trial, label), getattr(method, "holds", None)
        self._clean = trial.without_faults(plan)
        self._clean_problems: dict[int, RegistrationProblem] | None = None
        if self._clean != trial and plan.plausible:
            self._session = open_recorded(plan, self._clean)
            of_clean = problems(plan, self._clean, self._session)
            self._clean_problems = {problem.key.step: problem for problem in of_clean}
        self._told = read_session(plan, self._clean) if plan.plausible else None
        self._settings = plausible_settings_of(plan, session)
        mesh, truth = session.recorded.mesh, session.world_from_object
        self._metrics, self._truth = HypothesisMetrics(plan.metrics, mesh, truth), truth
        self._symmetry = object_symmetry(mesh)

    def members(self, problem: RegistrationProblem) -> tuple[PlausibleSet | None, str]:
        """The plausible set of a problem; else why there is none, "" where none is wanted."""
        if self._told is None:
            return None, ""
        step = problem.key.step
        if self._clean_problems is not None and step not in self._clean_problems:
            return None, f"without faults there is no registration at step {step}"
        if step in self._told.failures:
            return None, self._told.failures[step]
        of_session = self._of_session(problem)
        try:
            return load_members(self._plan, self._clean, self._session, of_session), ""
        except EvaluationError as error:
            return None, one_line(error).replace(f"{self._plan.folder}/", "")

    def row(
        self, problem: RegistrationProblem, found: Hypotheses | None, failure: str = ""
    ) -> dict[str, Any]:
        """The row of a step. found: None if the registration failed. failure: the reason for it."""
        points, (members, missing) = problem.points, self.members(problem)
        row: dict[str, Any] = {
            **self._about,
            "step": problem.key.step,
            "contacts": len(points.contacts),
            "free_points": len(points.free),
            "occupied_points": len(points.occupied),
            "status": f"no plausible set: {missing}" if missing else "ok",
            "problem_digest": problem.digest,
        }
        if members is not None:
            row |= {
                "members": len(members.index),
                "kept": len(members.cost),
                "local": int(members.local.sum()),
                "true_cost": members.true_cost,
            }
        if found is None:
            return row | {"status": f"failed: {failure}"}
        row |= self._numbers(problem, found)
        if members is None:
            return row
        of_session, limit = self._of_session(problem), members.true_cost + self._settings.epsilon
        cost = EvaluationCost(of_session, self._settings.cost)
        below = cost.evaluate(found.object_from_world, limit=limit) < limit
        exact = {"exact_members": float(below.mean())} if len(below) else {}
        return row | self._metrics.compute(of_session, members, found) | exact

    def _of_session(self, problem: RegistrationProblem) -> RegistrationProblem:
        """The problem without faults, with the same random numbers for all draws."""
        if self._clean_problems is not None:
            problem = self._clean_problems.get(problem.key.step, problem)
        return replace(problem, key=StreamKey(self._trial.seed, problem.key.step))

    def _numbers(self, problem: RegistrationProblem, found: Hypotheses) -> dict[str, Any]:
        """What hypotheses tell without a plausible set."""
        row: dict[str, Any] = {
            "hypotheses": len(found.cost),
            "distinct": found.distinct,
            "digest": found.digest,
        }
        if len(found.cost) == 0:
            return row
        nearest, distance = self._metrics.nearest(self._of_session(problem), found)
        chosen = found.object_from_world[[0, nearest]]
        position, rotation = pose_errors(chosen, self._truth, self._symmetry)
        if self._holds is not None:
            held = self._holds(problem, found, inverse(self._truth[None]))
            row["truth_held"] = bool(held[0])
        return row | {
            "best_cost": float(found.cost[0]),
            "mean_cost": float(found.cost.mean()),
            "position_error": float(position[0]),
            "rotation_error": float(rotation[0]),
            "nearest_hypothesis": distance,
            "nearest_position": float(position[1]),
            "nearest_rotation": float(rotation[1]),
        }

    def iterations(
        self, problem: RegistrationProblem, snapshots: Sequence[ArchiveSnapshot], settings: Any
    ) -> Iterator[Row]:
        """The rows of a step's search, of a method with these settings."""
        members, _ = self.members(problem)
        if members is None:
            return
        for snapshot in snapshots:
            found = hypotheses_of(snapshot, problem, settings)
            metrics = self._metrics.compute(self._of_session(problem), members, found, ranked=False)
            yield {
                **self._about,
                "step": problem.key.step,
                "iteration": snapshot.iteration,
                "filled": len(snapshot.cells),
                "best_cost": float(found.cost[0]),
                "mean_cost": float(found.cost.mean()),
                "qd_score": snapshot.qd_score,
                **metrics,
            }


def hypotheses_of(
    snapshot: ArchiveSnapshot, problem: RegistrationProblem, settings: Any
) -> Hypotheses:
    """The cells with the |E_0| lowest costs, chosen as the method with these settings does.

    settings: with `output` and `plane`, as every method that keeps an archive has them.
    """
    space = search_space(settings.plane, problem.sdf)
    stream = problem.key.stream(Purpose.RESAMPLE, snapshot.refinement)
    costs, poses = -snapshot.objectives, space.poses(snapshot.solutions)
    chosen = select_elites(costs, poses, problem, space, settings.output, stream)
    return ranked(poses[chosen].matrices, costs[chosen], snapshot.cells[chosen], poses.matrices)


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
