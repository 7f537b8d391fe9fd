"""Makes a recording again with today's results, and compares them with the recorded ones."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from chsel.errors import RecordingError
from chsel.plausible.pose_metrics import pose_errors, result_numbers
from chsel.plausible.symmetry import ObjectSymmetry
from chsel.problem.points import KnownPoints
from chsel.problem.poses import inverse
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from replay.comparing.decisions_again import DecisionsAgain, decision_differences
from replay.comparing.plausible import PlausibleSets
from replay.comparing.policies import recorded_policy
from replay.comparing.results import ResultDifferences, has_measured, recorded_registrations
from replay.comparing.verification import Verdict
from replay.environment import environment, environment_differences
from replay.events import (
    Decided,
    HypothesesFound,
    Measured,
    Probe,
    ProblemPosed,
    Recorder,
    SessionStarted,
    SnapshotTaken,
    Timed,
    Traced,
)
from replay.mcap.reader import Recording, read_recording
from replay.mcap.recovery import tells_loss
from replay.mcap.writer import McapRecorder
from replay.recorder import ListRecorder
from replay.registration import (
    recorded_method,
    recorded_online,
    recorded_symmetry,
    register_recorded,
    snapshot_interval,
    symmetry_for_errors,
)

_RESULTS = (SnapshotTaken, Traced, HypothesesFound, Measured, Timed)  # of a registration


@dataclass(frozen=True)
class ResultChange:
    """How the result of a step differs from the recorded one.

    Numbers are those of `result_numbers`, best_cost, and where the plausible set of the step lies
    beside the recording coverage, plausibility and diversity in mm^2.
    """

    verdict: Verdict
    recorded: Mapping[str, float]  # numbers about the recorded result
    new: Mapping[str, float]  # numbers about the new one
    moved: tuple[float, float]  # of the best pose, modulo symmetries: metres, radians; or NaN


def write_accepted(recording: Recording, path: Path) -> Recording:
    """Write the recording with today's results to a new file; as it reads.

    The file is removed again if that fails. Raises RecordingError if the recording was recovered
    with losses, behind which E_0 and E_l do not follow from what is left.
    """
    if any(tells_loss(event) for event in recording.events(images=False)):
        raise RecordingError(f"recording {recording.path} has lost events; accepted: whole ones")
    recorder = McapRecorder(path)
    try:
        _register_again(recording, recorder)
        recorder.close()
        return read_recording(path)
    except BaseException:
        recorder.close()
        os.unlink(path)
        raise


def result_changes(recorded: Recording, new: Recording) -> list[ResultChange]:
    """What differs, step by step, between the results of both: as `verify` compares them."""
    method = recorded_method(recorded).name
    sets, truth = PlausibleSets(recorded), recorded.start.world_from_object
    symmetry = recorded_symmetry(recorded.start)
    differing = environment_differences(recorded.start)

    def numbers(problem: RegistrationProblem, result: Hypotheses) -> dict[str, float]:
        best = {"best_cost": float(result.cost[0]) if len(result.cost) else math.nan}
        about = result_numbers(result, problem, truth, symmetry)
        return best | about | sets.numbers(problem, result)

    changes = []
    pairs = zip(recorded_registrations(recorded), recorded_registrations(new), strict=True)
    for before, after in pairs:
        problem, step = before.posed.problem, before.posed.step
        if not recorded.has_result(step):
            continue
        found = ResultDifferences()
        found.add_sets(problem, after.posed.problem)
        found.add_stages(before.events, after.events)
        if has_measured(before):
            found.add_measured(before.events, after.events)
        verdict = Verdict.of(step, method, found, environment=differing)
        results = recorded.hypotheses(step), new.hypotheses(step)
        old, now = (numbers(problem, result) for result in results)
        changes.append(ResultChange(verdict, old, now, best_pose_moves(*results, symmetry)))
    return changes


def decision_changes(recorded: Recording, new: Recording) -> list[Verdict]:
    """What differs, step by step, between the decisions of both: as `verify` compares them."""
    if not recorded.decision_steps:
        return []
    policy, differing = recorded_policy(recorded).name, environment_differences(recorded.start)
    verdicts = []
    for step in recorded.decision_steps:
        now = new.decision(step)
        found = decision_differences(
            recorded.decision(step), now.problem.belief, now.decision, now.surprise
        )
        verdict = Verdict.of(step, policy, found, environment=differing, is_decision=True)
        verdicts.append(verdict)
    return verdicts


def best_pose_moves(
    recorded: Hypotheses, new: Hypotheses, symmetry: ObjectSymmetry
) -> tuple[float, float]:
    """From the recorded best pose to the new one, metres and radians; NaN without a pose.

    symmetry: of the object, modulo which it is, at its centre.
    """
    if len(recorded.cost) == 0 or len(new.cost) == 0:
        return math.nan, math.nan
    world_from_recorded = inverse(recorded.object_from_world[0])
    position, rotation = pose_errors(new.object_from_world[:1], world_from_recorded, symmetry)
    return float(position[0]), float(rotation[0])


def _register_again(recording: Recording, recorder: Recorder) -> None:
    """Record a session with every registration run again; E_0 and E_l follow anew.

    Decisions are made again as well, of the recorded probes, whatever they choose.
    """
    method, start = recorded_method(recording).method, recording.start
    online = recorded_online(recording, method)
    decisions = DecisionsAgain(recording) if recording.decision_steps else None

    found: list[Hypotheses] = []  # the last result

    def perceived() -> Iterator[tuple[int, KnownPoints]]:
        """Record what comes from no registration; new points of each step with a result."""
        new: list[KnownPoints] = []
        again: int | None = None  # the step whose recorded results are left out
        for event in recording.events():
            if isinstance(event, Probe):
                new.append(event.new_points)
                larger = 0 if decisions is None else decisions.probed(event)
                if larger:
                    online.start_afresh(larger)
                    found.clear()
            if isinstance(event, Decided) and decisions is not None:
                event = decisions.again(event, found[-1] if found else None)
                decisions.remember(event)
            if isinstance(event, SessionStarted):
                recorder.record(dataclasses.replace(event, environment=environment()))
            elif isinstance(event, ProblemPosed) and recording.has_result(event.step):
                again = event.step
                yield again, KnownPoints.joined([KnownPoints(), *new])
                new.clear()
            elif not (isinstance(event, _RESULTS) and event.step == again):
                recorder.record(event)

    def register(problem: RegistrationProblem) -> Hypotheses | None:
        step, kept = problem.key.step, ListRecorder()
        registered = register_recorded(
            ProblemPosed(step, recording.problem(step) if start.source else problem),
            method,
            kept,
            start.world_from_object,
            symmetry_for_errors(start),
            snapshot_interval=snapshot_interval(recording.snapshots(step)),
        )
        for event in kept.events:
            recorder.record(event)
            if isinstance(event, HypothesesFound):
                recorder.flush()
        if recording.has_timings:
            recorder.record(Timed(step, registered.seconds))
        found[:] = [registered.hypotheses]
        return None if start.source else registered.hypotheses  # problems of another method stay

    for _ in online.steps(perceived(), register):
        pass
