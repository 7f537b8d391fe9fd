"""The rows of a trial: of a method's registrations, recorded, or of sets made elsewhere."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from chsel.errors import ChselError
from chsel.methods.method import Method
from chsel.numerics.arrays import FloatArray, frozen, read_npz
from chsel.plausible.evaluation_cost import EvaluationCost
from chsel.plausible.plausible_set import PlausibleSet, load_plausible
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import symmetry_of
from chsel.problem.poses import Poses, check_rigid, inverse
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses, RegistrationProblem
from chsel.problem.search_space import search_space
from chsel.problem.streams import Purpose, StreamKey
from chsel.qd.selection import ranked, repeated, select_elites
from chsel.session.rehearsal import warm_up
from chsel.session.run import Run
from replay.environment import environment
from replay.files import file_digest
from runners.evaluation.contenders import MOST_REPEATS, Contender, repeat_label, repeat_seed
from runners.evaluation.experiment import ITERATIONS, Row, write_part
from runners.evaluation.metrics import HypothesisMetrics
from runners.evaluation.plan import Plan, Trial
from runners.evaluation.trial_session import (
    StepRecorder,
    open_recorded,
    plausible_settings_of,
    problems,
    read_told,
)
from runners.run.session_run import steps
from runners.sessions.recorded import RecordedSource

REPEAT_FOLDER = "draw_{}"
"""Where further sets of the same sessions are, in the folder of the first ones."""
_TOLERANCE = 1e-5  # of rotations: transforms may have been written as text
_SHAPES: dict[str, Any] = {"step": (None, 4, 4), "cost": (None,), "seconds": ()}
_KEY = re.compile(r"(step|cost|seconds)_(\d{1,10})")
_NAMES = "accepted: step_K, cost_K and seconds_K"


class ResultRows:
    """Makes rows of the table of what was found at the steps of a trial."""

    def __init__(
        self, plan: Plan, trial: Trial, *, session: RecordedSource, label: str, holds: Any = None
    ) -> None:
        """Measure a session with faults by the plausible sets of the same probes without any.

        holds: of the method that made the hypotheses, tells whether its set has the truth.
        """
        self._plan, self._trial = plan, trial
        self._about = plan.about(trial, label)
        self._holds = holds
        self._clean = trial.without_faults(plan)
        self._clean_problems: dict[int, RegistrationProblem] | None = None
        if self._clean != trial and plan.plausible:
            of_clean = problems(plan, self._clean, session=open_recorded(plan, self._clean))
            self._clean_problems = {problem.key.step: problem for problem in of_clean}
        self._missing: dict[str, str] = {}  # why steps have no plausible set
        if plan.plausible:
            self._missing = read_told(self._clean.folder(plan))["no_plausible_set"]
        self._settings = plausible_settings_of(plan, session)
        mesh, self._session = session.recorded.mesh, session
        self._metrics = HypothesisMetrics(plan.metrics, mesh, world_from_object=self._truth)
        self._symmetry = symmetry_of(session.recorded.sdf, mesh)

    @property
    def _truth(self) -> FloatArray:
        """The true pose (4, 4) at the step that the session has come to."""
        assert self._session.world_from_object is not None
        return self._session.world_from_object

    def members(self, problem: RegistrationProblem) -> tuple[PlausibleSet | None, str]:
        """Return the plausible set of a problem, else why not; "" where none is wanted."""
        step = problem.key.step
        if not self._plan.plausible:
            return None, ""
        if self._clean_problems is not None and step not in self._clean_problems:
            return None, f"without faults there is no registration at step {step}"
        if str(step) in self._missing:
            return None, self._missing[str(step)]
        folder = self._clean.folder(self._plan)
        of_session = self._of_session(problem)
        truth = {"world_from_object": self._truth}
        found = load_plausible(folder / "plausible", of_session, settings=self._settings, **truth)
        return found, "" if found else f"no file in {folder.name}/plausible; remove session.json"

    def row(
        self, problem: RegistrationProblem, found: Hypotheses | None, *, failure: str = ""
    ) -> dict[str, Any]:
        """Return the row of a step. found: None if the registration failed. failure: why."""
        points = problem.points
        (members, missing) = self.members(problem)
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
        row |= {
            "hypotheses": len(found.cost),
            "distinct": found.distinct,
            "digest": found.digest,
        }
        if len(found.cost) == 0:
            return row
        of_session = self._of_session(problem)
        nearest, distance = self._metrics.nearest(of_session, found, truth=self._truth)
        chosen = found.object_from_world[[0, nearest]]
        position, rotation = pose_errors(chosen, self._truth, symmetry=self._symmetry)
        row |= {
            "best_cost": float(found.cost[0]),
            "mean_cost": float(found.cost.mean()),
            "position_error": float(position[0]),
            "rotation_error": float(rotation[0]),
            "nearest_hypothesis": distance,
            "nearest_position": float(position[1]),
            "nearest_rotation": float(rotation[1]),
        }
        if self._holds is not None:
            row["truth_held"] = bool(self._holds(problem, found, inverse(self._truth[None]))[0])
        if members is None:
            return row
        limit = members.true_cost + self._settings.epsilon
        cost = EvaluationCost(of_session, self._settings.cost)
        below = cost.evaluate(found.object_from_world, limit=limit) < limit
        row["exact_members"] = float(below.mean())
        return row | self._metrics.compute(of_session, members, found=found)

    def _of_session(self, problem: RegistrationProblem) -> RegistrationProblem:
        """Return the problem without faults, with the same random numbers for all draws."""
        if self._clean_problems is not None:
            problem = self._clean_problems.get(problem.key.step, problem)
        return replace(problem, key=StreamKey(self._trial.seed, problem.key.step))

    def iterations(
        self, problem: RegistrationProblem, snapshots: Sequence[ArchiveSnapshot], *, settings: Any
    ) -> Iterator[Row]:
        """Yield the rows of a step's search, of a method with these settings."""
        members, _ = self.members(problem)
        if members is None:
            return
        for snapshot in snapshots:
            found = hypotheses_of(snapshot, problem, settings=settings)
            metrics = self._metrics.compute(
                self._of_session(problem), members, found=found, ranked=False
            )
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
    snapshot: ArchiveSnapshot, problem: RegistrationProblem, *, settings: Any
) -> Hypotheses:
    """Return the cells with the |E_0| lowest costs, chosen as the method with the settings does."""
    space = search_space(settings.plane, problem.sdf)
    stream = problem.key.stream(Purpose.RESAMPLE, snapshot.refinement)
    costs = -snapshot.objectives
    poses = space.poses(snapshot.solutions)
    chosen = select_elites(
        costs, poses, problem=problem, space=space, settings=settings.output, stream=stream
    )
    return ranked(
        poses[chosen].matrices, costs[chosen], cells=snapshot.cells[chosen], elites=poses.matrices
    )


def method_rows(
    plan: Plan, trial: Trial, *, contender: Contender, recorder: StepRecorder
) -> list[Row]:
    """Return a row for every registration; write those of searches, where wanted."""
    session = open_recorded(plan, trial)
    chosen = plan.steps_of(trial.configuration)
    method, leader = contender.method(), plan.leader()
    warm_up(method)  # so that no time holds the loading of compiled kernels
    config = {"name": contender.name, **contender.settings}
    started = replace(
        session.recorded,
        runner="evaluate",
        method=contender.name,
        config={**session.recorded.config, "method": config, "preset": {"name": contender.preset}},
        environment=environment(),
        # Problems of another method do not follow from the results of this one.
        source="" if leader is None else file_digest(trial.folder(plan) / "session.mcap"),
        start=session.start_of(chosen if leader is None else None),
        moves=session.push_distance,
    )
    run = Run(method, recorder, snapshot_interval=plan.every or 0)
    if leader is None:
        run.begin(started, seed=repeat_seed(trial.seed, contender.draw))
        walked = steps(run, session, catch=Exception)
    else:
        run.begin(started, seed=repeat_seed(trial.seed, contender.draw), settings=leader.online)
        walked = steps(run, session, register=partial(_lead, leader=leader, chosen=chosen))
    holds = getattr(method, "holds", None)
    result_rows = ResultRows(plan, trial, session=session, label=contender.label, holds=holds)
    rows, iterations = list[Row](), list[Row]()
    for _ in walked:
        problem = run.problem
        if problem is None or run.step not in chosen:
            continue
        if run.registered is None:
            rows.append(result_rows.row(problem, None, failure=run.failure))
            continue
        row = result_rows.row(problem, run.registered.hypotheses)
        rows.append(row | {"seconds": run.registered.total_seconds})
        if plan.every is not None:
            iterations += result_rows.iterations(
                problem, recorder.snapshots, settings=method.settings
            )
    if plan.every is not None:
        path = trial.folder(plan) / f"{contender.label}.iterations.parquet"
        write_part(path, iterations, schema=ITERATIONS)
    return rows


def _lead(run: Run, *, leader: Method, chosen: Collection[int]) -> None:
    """Register the steps that are chosen; the next problem follows from the leader's result."""
    problem = run.loop.problem()
    if run.step in chosen:
        try:
            run.register_problem(problem)
        except Exception as error:
            run.fail(error)
    run.loop.remember(leader.register(problem))


class ExternalSetError(ChselError):
    """A file of hypothesis sets from elsewhere cannot be used."""


def external_folders(given: Mapping[str, Path]) -> dict[str, Path]:
    """Folders by label: those given, and under a label of its own every draw in them."""
    found = dict(given)
    for label, folder in given.items():
        for draw in range(1, MOST_REPEATS):
            of_draw = folder / REPEAT_FOLDER.format(draw)
            if not of_draw.is_dir():
                break
            found.setdefault(repeat_label(label, draw), of_draw)
    return found


def external_file(plan: Plan, trial: Trial, *, label: str) -> Path:
    """FOLDER/CONFIGURATION/seed_S.npz, or .json if there is that alone."""
    path = plan.outside[label] / trial.configuration / f"seed_{trial.seed}.npz"
    text = path.with_suffix(".json")
    return text if text.is_file() and not path.is_file() else path


def external_digest(plan: Plan, trial: Trial, *, label: str) -> str:
    """Digest of the file of a trial; "none" without one."""
    path = external_file(plan, trial, label=label)
    return file_digest(path) if path.is_file() else "none"


def read_external(plan: Plan, trial: Trial, *, label: str) -> dict[int, dict[str, Any]]:
    """Return the sets of a trial in the folder of a label, by step; none without a file.

    npz: arrays `step_K` (B, 4, 4), world_from_object of step K, best first; where known `cost_K`
    (B,) and `seconds_K`. json: the same as lists. Given as "step", "cost" and "seconds". Raises
    ExternalSetError for other names, steps that do not exist, shapes, numbers and rotations.
    """
    path = external_file(plan, trial, label=label)
    if not path.is_file():
        return {}
    try:
        json_file = path.suffix == ".json"
        values = json.loads(path.read_text()) if json_file else read_npz(path, error=ChselError)
    except (OSError, ValueError, ChselError) as error:
        reason = " ".join(str(error).split())
        raise ExternalSetError(f"{path} cannot be read ({reason})") from None
    if not isinstance(values, Mapping):
        raise ExternalSetError(f"{path} is no object; {_NAMES}")
    steps = plan.probes_of(trial.configuration)
    sets: dict[int, dict[str, Any]] = {}
    for key, value in values.items():
        match = _KEY.fullmatch(key)
        if match is None:
            raise ExternalSetError(f"{path} has {key!r}; {_NAMES}")
        step = int(match[2])
        if step not in steps:
            raise ExternalSetError(
                f"{path} has {key}; accepted: steps 0 to {steps[-1]} of {trial.configuration}"
            )
        array = frozen(f"{path}: {key}", value, shape=_SHAPES[match[1]], error=ExternalSetError)
        sets.setdefault(step, {})[match[1]] = array
    for step, found in sets.items():
        name = f"{path}: step_{step}"
        poses = found.get("step", ())
        if len(poses) == 0:
            raise ExternalSetError(f"{name} is empty; accepted: at least one transform")
        check_rigid(name, poses, tolerance=_TOLERANCE)
        if len(found.get("cost", poses)) != len(poses):
            raise ExternalSetError(f"{path}: cost_{step} is not as long as step_{step}")
    return sets


def external_rows(plan: Plan, trial: Trial, *, label: str) -> list[Row]:
    """Return the rows of the table about external results, of one trial."""
    sets, path = read_external(plan, trial, label=label), external_file(plan, trial, label=label)
    missing = f"{path} has no set of this step" if path.is_file() else f"there is no {path}"
    session = open_recorded(plan, trial)
    result_rows = ResultRows(plan, trial, session=session, label=label)
    rows: list[Row] = []
    for problem in problems(plan, trial, session=session):
        given = sets.get(problem.key.step)
        if given is None:
            row = result_rows.row(problem, None, failure=missing)
        else:
            cost = given.get("cost", np.zeros(len(given["step"])))
            order = np.argsort(cost, kind="stable")
            poses = inverse(given["step"])[order]
            cells = np.full(len(cost), -1, dtype=np.int64)
            found = Hypotheses(
                poses, cost[order], duplicate=repeated(Poses.of(poses)), cell=cells, elites=poses
            )
            row = result_rows.row(problem, found)
            row["seconds"] = float(given["seconds"]) if "seconds" in given else None
            if "cost" not in given:
                row |= {"best_cost": None, "mean_cost": None}
        rows.append(row | {"problem_digest": None})  # a problem has an E_0, which is not known
    return rows
