"""Makes a recording again with today's results, and says what changes."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from chsel.errors import RecordingError
from chsel.numerics.arrays import FloatArray
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import ObjectSymmetry
from chsel.problem.points import KnownPoints
from chsel.problem.poses import inverse
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from replay.comparing.plausible import PlausibleSets
from replay.differences import apart
from replay.environment import environment
from replay.events import (
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
    symmetry_for_errors,
)
from replay.verification import snapshot_interval

_RESULTS = (SnapshotTaken, Traced, HypothesesFound, Measured, Timed)


@dataclass(frozen=True)
class Change:
    """How the result of a step differs from the recorded one.

    equal: to the bit, with all stages on the way. ulps: the most between two of the costs or
    poses, if there are as many. Pairs are recorded and new. position, rotation: from the recorded
    best pose to the new one, metres and radians, NaN if a result has no pose. position_error,
    rotation_error: of the best, where the truth is known. All are modulo the object's symmetries,
    at its centre. diversity: PD in mm^2, where the
    plausible set of the step lies beside the recording.
    """

    step: int
    equal: bool
    ulps: int
    best_cost: tuple[float, float]
    distinct: tuple[int, int]
    position: float
    rotation: float
    position_error: tuple[float, float] | None
    rotation_error: tuple[float, float] | None
    diversity: tuple[float, float] | None


def write_blessed(recording: Recording, path: Path) -> Recording:
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


def changes(recorded: Recording, new: Recording) -> list[Change]:
    """What differs, step by step, between results that are there in both."""
    sets, truth = PlausibleSets(recorded), recorded.start.world_from_object
    symmetry = recorded_symmetry(recorded.start)
    before, after = _outputs(recorded), _outputs(new)
    found = []
    for event in recorded.events(images=False):
        if isinstance(event, ProblemPosed) and recorded.has_result(event.step):
            step = event.step
            pair = recorded.hypotheses(step), new.hypotheses(step)
            numbers = [sets.numbers(event.problem, result) for result in pair]
            equal = before[step] == after[step]
            change = _change(step, *pair, truth, numbers, symmetry=symmetry, equal=equal)
            found.append(change)
    return found


def _outputs(recording: Recording) -> dict[int, list[object]]:
    """All that today's code has a say in, by step, as far as its digests tell."""
    outputs: dict[int, list[object]] = {step: [] for step in recording.steps}
    for event in recording.events(images=False):
        match event:
            case ProblemPosed():
                outputs[event.step].append(event.problem.digest)
            case Traced():
                outputs[event.step].append(event)
            case SnapshotTaken():
                outputs[event.step].append((event.archive.iteration, event.archive.digest))
            case HypothesesFound():
                archive = event.hypotheses.archive
                outputs[event.step].append((event.hypotheses.digest, archive and archive.digest))
    return outputs


def _register_again(recording: Recording, recorder: Recorder) -> None:
    """Record a session with every registration run again; E_0 and E_l follow anew."""
    method, start = recorded_method(recording).method, recording.start

    def perceived() -> Iterator[tuple[int, KnownPoints]]:
        """Record what comes from no registration; new points of each step with a result."""
        new: list[KnownPoints] = []
        again: int | None = None  # the step whose recorded results are left out
        for event in recording.events():
            if isinstance(event, Probe):
                new.append(event.new_points)
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
        return None if start.source else registered.hypotheses  # problems of another method stay

    for _ in recorded_online(recording, method).steps(perceived(), register):
        pass


def _change(
    step: int,
    recorded: Hypotheses,
    new: Hypotheses,
    truth: FloatArray | None,
    numbers: Sequence[Mapping[str, float]],
    *,
    symmetry: ObjectSymmetry,
    equal: bool,
) -> Change:
    position = rotation = float("nan")
    errors: list[tuple[float, float]] | None = None  # of position, of rotation
    if len(recorded.cost) > 0 and len(new.cost) > 0:
        world_from_recorded = inverse(recorded.object_from_world[0])
        shift, turn = pose_errors(new.object_from_world[:1], world_from_recorded, symmetry)
        position, rotation = float(shift[0]), float(turn[0])
        if truth is not None:
            before, after = (
                pose_errors(h.object_from_world[:1], truth, symmetry) for h in (recorded, new)
            )
            errors = [
                (float(old[0]), float(now[0])) for old, now in zip(before, after, strict=True)
            ]
    diversity = [values["diversity"] for values in numbers if "diversity" in values]
    return Change(
        step=step,
        equal=equal,
        ulps=max(
            apart(recorded.cost, new.cost),
            apart(recorded.object_from_world, new.object_from_world),
        ),
        best_cost=(_best(recorded), _best(new)),
        distinct=(recorded.distinct, new.distinct),
        position=position,
        rotation=rotation,
        position_error=errors[0] if errors else None,
        rotation_error=errors[1] if errors else None,
        diversity=(diversity[0], diversity[1]) if len(diversity) == 2 else None,
    )


def _best(hypotheses: Hypotheses) -> float:
    return float(hypotheses.cost[0]) if len(hypotheses.cost) > 0 else float("nan")
