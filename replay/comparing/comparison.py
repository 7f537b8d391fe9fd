"""Several methods on the same recorded problems: what each finds, as numbers under one cost."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_settings import CostSettings
from chsel.errors import ChselError, RecordingError, require_choice
from chsel.events import ProblemPosed, Recorder, SessionEnded, SessionStarted
from chsel.methods.method import Method
from chsel.plausible.plausible_set import PlausibleSet, read_plausible
from chsel.plausible.plausible_settings import DEFINITIONS, plausible_settings
from chsel.plausible.pose_metrics import closest_pose, plausible_diversity, pose_errors
from chsel.plausible.surface_distance import DistanceSettings, SurfaceDistance, surface_points
from chsel.plausible.symmetry import symmetry_of
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.settings import PRESETS, in_preset
from chsel.problem.streams import StreamKey
from chsel.session.recording import Registered, register_recorded, symmetry_for_errors
from chsel.session.rehearsal import warm_up
from replay.comparing.choices import Choice, is_recorded, recorded_method
from replay.comparing.recomputation import snapshot_interval
from replay.environment import environment
from replay.files import file_digest, new_file
from replay.mcap.reader import Recording
from replay.mcap.writer import McapRecorder


class Column(NamedTuple):
    """A number of a comparison."""

    csv_name: str  # with its unit
    title: str  # of a plot, with the unit shown
    heading: str = ""  # of a table, lines by "\\n"; "" to leave it out
    times: float = 1.0  # what turns the number into the unit shown


_DEGREES = math.degrees(1.0)
COLUMNS: Mapping[str, Column] = {
    "best_cost": Column("best_cost", "best cost", heading="best\ncost"),
    "median_cost": Column("median_cost", "median cost", heading="median\ncost"),
    "hypotheses": Column("hypotheses", "hypotheses"),
    "distinct": Column("distinct", "distinct hypotheses", heading="dis-\ntinct"),
    "best_position_error": Column(
        "best_position_error_m", "position error of the best, mm", heading="best\nmm", times=1e3
    ),
    "best_rotation_error": Column(
        "best_rotation_error_rad",
        "rotation error of the best, °",
        heading="best\n°",
        times=_DEGREES,
    ),
    "closest_position_error": Column(
        "closest_position_error_m",
        "position error of the closest, mm",
        heading="near\nmm",
        times=1e3,
    ),
    "closest_rotation_error": Column(
        "closest_rotation_error_rad",
        "rotation error of the closest, °",
        heading="near\n°",
        times=_DEGREES,
    ),
    "coverage": Column("coverage_mm2", "coverage, mm²", heading="cover-\nage"),
    "plausibility": Column("plausibility_mm2", "plausibility, mm²", heading="plausi-\nbility"),
    "diversity": Column("diversity_mm2", "plausible diversity, mm²", heading="PD\nmm²"),
    "seconds": Column("seconds_s", "time, ms", heading="ms", times=1e3),
}
"""Columns by the names of `Outcome.numbers`, in the order in which they are shown."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of one method, or of the recording, at one step."""

    step: int
    label: str
    hypotheses: Hypotheses | None
    numbers: Mapping[str, float] = field(default_factory=dict)  # none without hypotheses
    failure: str = ""  # why there are none
    # Whether the hypotheses have the recorded bits; None if there is no recorded result, or the
    # method has other settings than the recorded one.
    as_recorded: bool | None = None


@dataclass(frozen=True)
class CommonCost:
    """The one cost by which the hypotheses of all methods are judged."""

    settings: CostSettings
    name: str  # for people


def common_cost(recording: Recording) -> CommonCost:
    """Return the cost of the recorded method, or that of the default preset if it has none."""
    settings = None
    with suppress(RecordingError):
        method = recorded_method(recording)
        settings = getattr(method.settings, "cost", None)
    if not isinstance(settings, CostSettings):
        return CommonCost(CostSettings(), "preset default")
    for preset in PRESETS:
        if settings == in_preset(CostSettings(), preset):
            return CommonCost(settings, f"preset {preset}, as recorded")
    return CommonCost(settings, f"{method.name}'s, as recorded")


def recorded_label(recording: Recording) -> str:
    """Return the label of the row of the recorded result."""
    return f"recorded: {recording.start.method}"


def compared(
    recording: Recording,
    methods: Sequence[Choice[Method]],
    *,
    steps: Sequence[int],
    cost: CommonCost,
    plausible: PlausibleSets | None = None,
    out: Path | None = None,
) -> Iterator[Outcome]:
    """Yield outcomes step by step: the recorded one, then one of each method in turn.

    plausible: the sets that hypotheses are also measured by. out: where to record the registration
    of one method and one step, with all that its problem follows from. A registration that
    fails is an outcome, too; with `out` its error is raised, and no file is left.
    """
    built = {choice.label: choice.build() for choice in methods}
    for method in built.values():
        warm_up(method)  # so that no time holds the compiling of kernels
    for posed in _problems(recording, steps):
        step = posed.step
        judge = CompiledCost.of(posed.problem, cost.settings)
        start = recording.start_at(posed.step)
        recorded = None
        numbers: dict[str, float] = {}
        failure = "no result was recorded"
        if recording.has_result(step):
            recorded = recording.hypotheses(step)
            failure = ""
            numbers = _all_numbers(
                recorded, judge, start=start, problem=posed.problem, plausible=plausible
            )
        yield Outcome(
            step, recorded_label(recording), hypotheses=recorded, numbers=numbers, failure=failure
        )
        for choice in methods:
            try:
                with _recorder(recording, step, choice=choice, out=out) as recorder:
                    registered = _register(
                        recording, posed, method=built[choice.label], recorder=recorder
                    )
                found = registered.hypotheses
                numbers = _all_numbers(
                    found, judge, start=start, problem=posed.problem, plausible=plausible
                ) | {"seconds": registered.total_seconds}
            except Exception as error:  # the others go on
                if out is not None:
                    raise
                known = isinstance(error, ChselError)
                failure = str(error) if known else f"{type(error).__name__}: {error}"
                yield Outcome(step, choice.label, hypotheses=None, failure=failure)
                continue
            same = None
            if recorded is not None and is_recorded(recording, choice):
                same = _digests(found) == _digests(recorded)
            yield Outcome(step, choice.label, hypotheses=found, numbers=numbers, as_recorded=same)


def frame(
    outcomes: Sequence[Outcome],
    methods: Sequence[Choice[Method]],
    *,
    cost: CommonCost,
    definition: str,
) -> pd.DataFrame:
    """Return a row for each step and method; names of columns end in their unit.

    step, label, method, changes (to the settings, with "; " between), cost (by which all are
    judged), definition (of the plausible sets, empty where a row has no PD), then the numbers with
    all digits, empty where there are none, then bits_as_recorded (yes, no, or empty where the
    method is not the recorded one) and failure.
    """
    by_label = {choice.label: choice for choice in methods}
    rows = []
    for outcome in outcomes:
        choice = by_label.get(outcome.label)
        numbers = outcome.numbers
        rows.append(
            {
                "step": outcome.step,
                "label": outcome.label,
                "method": choice.name if choice else outcome.label.split(": ", 1)[-1],
                "changes": "; ".join(choice.changes) if choice else "",
                "cost": cost.name,
                "definition": definition if "diversity" in numbers else "",
                **{column.csv_name: numbers.get(name) for name, column in COLUMNS.items()},
                "bits_as_recorded": {True: "yes", False: "no", None: ""}[outcome.as_recorded],
                "failure": outcome.failure,
            }
        )
    return pd.DataFrame(rows)


def write_csv(rows: pd.DataFrame, path: Path) -> None:
    """Write a new CSV file."""
    with new_file(path) as beside:
        rows.to_csv(beside, index=False)


def numbers_under(
    cost: CompiledCost, hypotheses: Hypotheses, *, start: SessionStarted
) -> dict[str, float]:
    """Return numbers about hypotheses, by a cost that may be another than their method's.

    Best is the one of the lowest cost, closest the one whose surface is nearest to the true one.
    Errors in metres and radians, modulo the object's symmetries, at its centre.
    """
    poses = hypotheses.object_from_world
    numbers = {"hypotheses": float(len(poses)), "distinct": float(hypotheses.distinct)}
    if len(poses) == 0:
        return numbers
    costs = cost.evaluate(poses)
    best = int(np.argmin(costs))
    numbers["best_cost"] = float(costs[best])
    numbers["median_cost"] = float(np.median(costs))
    if start.world_from_object is not None:
        symmetry = symmetry_of(start.sdf, start.mesh)
        position, rotation = pose_errors(poses, start.world_from_object, symmetry=symmetry)
        closest = closest_pose(poses, start.world_from_object, sdf=start.sdf)
        for name, index in (("best", best), ("closest", closest)):
            numbers[f"{name}_position_error"] = float(position[index])
            numbers[f"{name}_rotation_error"] = float(rotation[index])
    return numbers


def _all_numbers(
    found: Hypotheses,
    judge: CompiledCost,
    *,
    start: SessionStarted,
    problem: RegistrationProblem,
    plausible: PlausibleSets | None,
) -> dict[str, float]:
    about = numbers_under(judge, found, start=start)
    return about if plausible is None else about | plausible.numbers(problem, found)


def _problems(recording: Recording, steps: Sequence[int]) -> Iterator[ProblemPosed]:
    """Yield the problems of steps, each once."""
    left = set(steps)
    for event in recording.events(images=False):
        if isinstance(event, ProblemPosed) and event.step in left:
            left.remove(event.step)
            yield event


def _register(
    recording: Recording, posed: ProblemPosed, *, method: Method, recorder: Recorder
) -> Registered:
    start = recording.start
    return register_recorded(
        posed,
        method,
        recorder=recorder,
        world_from_object=recording.start_at(posed.step).world_from_object,
        symmetry=symmetry_for_errors(start),
        snapshot_interval=snapshot_interval(recording.snapshots(posed.step)),
    )


@contextmanager
def _recorder(
    recording: Recording, step: int, *, choice: Choice[Method], out: Path | None
) -> Iterator[Recorder]:
    """Open the recorder of a registration: a new file with the probes before it, or none."""
    if out is None:
        yield Recorder()
        return
    facts: dict[str, Any] = {"step": step, "method": recording.start.method, "hypotheses": None}
    if recording.has_result(step):
        facts["hypotheses"] = recording.hypotheses(step).digest
    config = {**recording.start.config, "method": choice.config, "source": facts}
    config.pop("policy", None)  # no decision is part of it
    if choice.preset:
        config["preset"] = {"name": choice.preset}
    start = replace(
        recording.start,
        method=choice.name,
        config=config,
        environment=environment(),
        source=file_digest(recording.path),
    )
    with new_file(out) as beside:
        recorder = McapRecorder(beside)
        try:
            recorder.record(start)
            for probe in recording.probes:
                if probe.step <= step:
                    recorder.record(probe)
            yield recorder
            recorder.record(SessionEnded(step, "finished"))
        finally:
            recorder.close()


def _digests(found: Hypotheses) -> tuple[str, str | None]:
    return found.digest, None if found.archive is None else found.archive.digest


class PlausibleSets:
    """The sets of a recording's steps by one definition, as `runners.plausible` keeps them.

    folder: by default `plausible` beside the recording. Raises RecordingError for a folder that
    does not exist, unless it is the default, and SettingError for an unknown definition.
    """

    def __init__(
        self, recording: Recording, folder: Path | None = None, *, definition: str = "default"
    ) -> None:
        require_choice("definition", definition, accepted=DEFINITIONS)
        if folder is not None and not folder.is_dir():
            raise RecordingError(f"{folder} is not a folder; accepted: one with plausible sets")
        self._folder = folder or recording.path.parent / "plausible"
        self._definition = definition
        self._start = recording.start

    @cached_property
    def _distance(self) -> SurfaceDistance:
        start = self._start
        points = surface_points(start.mesh, DistanceSettings().points, key=StreamKey(start.seed, 0))
        return SurfaceDistance(start.sdf, start.mesh, points=points)

    def numbers(self, problem: RegistrationProblem, hypotheses: Hypotheses) -> dict[str, float]:
        """Return coverage, plausibility and PD in mm^2 (CHSEL, Sec. V), nothing without a set.

        Raise EvaluationError for a set that is damaged.
        """
        members = self._members(problem)
        if members is None or len(hypotheses.object_from_world) == 0:
            return {}
        poses = hypotheses.object_from_world
        found = plausible_diversity(self._distance.between(poses, members.world_from_object))
        return {
            "coverage": found.coverage,
            "plausibility": found.plausibility,
            "diversity": found.diversity,
        }

    def _members(self, problem: RegistrationProblem) -> PlausibleSet | None:
        """Return the set of these points and this object by the definition, whatever its eps."""
        for path in sorted(self._folder.glob(f"{problem.points.digest}_*.npz")):
            found = read_plausible(path)
            usual = plausible_settings(self._definition, found.settings.epsilon)
            if found.settings == usual and found.sdf_digest == problem.sdf.digest:
                return found
        return None
