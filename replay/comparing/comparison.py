"""Several methods on the same recorded problems: what each finds, as numbers under one cost."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_settings import CostSettings
from chsel.errors import ChselError
from chsel.plausible.pose_metrics import closest_pose, pose_errors
from chsel.problem.registration_problem import Hypotheses
from chsel.problem.settings import PRESETS, in_preset
from replay.comparing.contenders import Contender, recorded_or_none
from replay.comparing.plausible import PlausibleSets
from replay.events import ProblemPosed, SessionStarted
from replay.mcap.reader import Recording
from replay.recorder import NullRecorder
from replay.registration import recorded_symmetry, register_recorded


@dataclass(frozen=True, eq=False)
class Outcome:
    """What one method, or the recording, has for one step.

    numbers: by the names of `replay.comparing.columns`; empty without hypotheses. failure: why
    there are none. as_recorded: whether all bits of the hypotheses are the recorded ones; None if
    there is no recorded result, or the method has other settings than the recorded one.
    """

    step: int
    label: str
    hypotheses: Hypotheses | None
    numbers: Mapping[str, float] = field(default_factory=dict)
    failure: str = ""
    as_recorded: bool | None = None


@dataclass(frozen=True)
class CommonCost:
    """The one cost that the hypotheses of all methods are judged by; name: for people."""

    settings: CostSettings
    name: str


def common_cost(recording: Recording) -> CommonCost:
    """The cost of the recorded method; that of the default preset if the recording has none."""
    recorded = recorded_or_none(recording)
    settings = getattr(recorded.method.settings, "cost", None) if recorded else None
    if not isinstance(settings, CostSettings):
        return CommonCost(CostSettings(), "preset default")
    assert recorded is not None
    for preset in PRESETS:
        if settings == in_preset(CostSettings(), preset):
            return CommonCost(settings, f"preset {preset}, as recorded")
    return CommonCost(settings, f"{recorded.name}'s, as recorded")


def recorded_label(recording: Recording) -> str:
    """How the row of the recorded result is called."""
    return f"recorded: {recording.start.method}"


def compared(
    recording: Recording,
    methods: Sequence[Contender],
    steps: Sequence[int],
    cost: CommonCost,
    plausible: PlausibleSets | None = None,
) -> Iterator[Outcome]:
    """Outcomes step by step: the recorded one, then one of each method in turn.

    plausible: the sets that hypotheses are also measured by. A registration that fails is an
    outcome, too. Before its first step a method registers once uncounted, so that no time holds
    the compiling of kernels.
    """
    start, warm = recording.start, False
    for posed in _problems(recording, steps):
        recorded = recording.hypotheses(posed.step) if recording.has_result(posed.step) else None
        judge = CompiledCost.of(posed.problem, cost.settings)
        yield _recorded(recording, posed, recorded, judge, plausible)
        for method in methods:
            yield _again(start, posed, method, recorded, judge, plausible, warm=warm)
        warm = True


def numbers_under(
    cost: CompiledCost, hypotheses: Hypotheses, start: SessionStarted
) -> dict[str, float]:
    """Numbers about hypotheses, judged by a cost that may be another than their method's.

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
        symmetry = recorded_symmetry(start)
        position, rotation = pose_errors(poses, start.world_from_object, symmetry)
        closest = closest_pose(poses, start.world_from_object, start.sdf)
        for name, index in (("best", best), ("closest", closest)):
            numbers[f"{name}_position_error"] = float(position[index])
            numbers[f"{name}_rotation_error"] = float(rotation[index])
    return numbers


def medians(outcomes: Sequence[Outcome]) -> dict[str, float]:
    """The median of every number over those outcomes that have it."""
    names = dict.fromkeys(name for outcome in outcomes for name in outcome.numbers)
    return {
        name: float(np.median([o.numbers[name] for o in outcomes if name in o.numbers]))
        for name in names
    }


def _problems(recording: Recording, steps: Sequence[int]) -> Iterator[ProblemPosed]:
    """The problems of steps, each once."""
    left = set(steps)
    for event in recording.events(images=False):
        if isinstance(event, ProblemPosed) and event.step in left:
            left.remove(event.step)
            yield event


def _recorded(
    recording: Recording,
    posed: ProblemPosed,
    found: Hypotheses | None,
    judge: CompiledCost,
    plausible: PlausibleSets | None,
) -> Outcome:
    label = recorded_label(recording)
    if found is None:
        return Outcome(posed.step, label, None, failure="no result was recorded")
    numbers = numbers_under(judge, found, recording.start)
    if plausible is not None:
        numbers |= plausible.numbers(posed.problem, found)
    return Outcome(posed.step, label, found, numbers)


def _again(
    start: SessionStarted,
    posed: ProblemPosed,
    method: Contender,
    recorded: Hypotheses | None,
    judge: CompiledCost,
    plausible: PlausibleSets | None,
    *,
    warm: bool,
) -> Outcome:
    """Run a method; whatever goes wrong in it is its own failure, and the others go on."""
    try:
        if not warm:
            register_recorded(posed, method.named.method, NullRecorder(), None, None)
        registered = register_recorded(posed, method.named.method, NullRecorder(), None, None)
        found = registered.hypotheses
        numbers = numbers_under(judge, found, start) | {"seconds": registered.total_seconds}
        if plausible is not None:
            numbers |= plausible.numbers(posed.problem, found)
    except Exception as error:
        known = isinstance(error, ChselError)
        failure = str(error) if known else f"{type(error).__name__}: {error}"
        return Outcome(posed.step, method.label, None, failure=failure)
    same = None
    if method.as_recorded and recorded is not None:
        same = found.digest == recorded.digest and _archive(found) == _archive(recorded)
    return Outcome(posed.step, method.label, found, numbers, as_recorded=same)


def _archive(hypotheses: Hypotheses) -> str | None:
    return None if hypotheses.archive is None else hypotheses.archive.digest
