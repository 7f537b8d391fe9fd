"""Makes a recording again with today's results, and compares them with the recorded ones."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from chsel.errors import RecordingError
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import ObjectSymmetry
from chsel.problem.poses import inverse
from chsel.problem.registration_problem import Hypotheses
from replay.comparing.again import Again, made_again, result_in
from replay.comparing.plausible import PlausibleSets
from replay.comparing.verification import Verdict
from replay.environment import environment, environment_differences
from replay.events import Event, HypothesesFound, Measured, SessionStarted, Timed
from replay.mcap.reader import Recording
from replay.mcap.recovery import tells_loss
from replay.mcap.writer import McapRecorder
from replay.registration import recorded_symmetry


@dataclass(frozen=True)
class ResultChange:
    """How a result differs from the recorded one.

    Numbers are those measured, best_cost, and where the plausible set of the step lies beside the
    recording coverage, plausibility and diversity in mm^2.
    """

    verdict: Verdict
    recorded: dict[str, float]  # numbers about the recorded result
    new: dict[str, float]  # numbers about the new one
    moved: tuple[float, float] = (math.nan, math.nan)  # the best pose: metres, radians


def write_accepted(recording: Recording, path: Path) -> list[ResultChange]:
    """Write the recording with today's results to a new file; how each result differs.

    Registrations follow from today's results; decisions are of the recorded probes, whatever they
    choose. The file is removed again if that fails. Raises RecordingError if the recording was
    recovered with losses, behind which E_0 and E_l do not follow from what is left.
    """
    recorder, changes = McapRecorder(path), []
    seconds: dict[int, Timed] = {}
    differing, sets = environment_differences(recording.start), PlausibleSets(recording)
    try:
        for event in made_again(recording, anew=True):
            if isinstance(event, Again):
                changes.append(_change(recording, event, sets, differing))
                seconds[event.step] = Timed(event.step, event.seconds)
                for inner in event.today or event.recorded:
                    recorder.record(inner)
                recorder.flush()
                continue
            if tells_loss(event):
                raise RecordingError(
                    f"recording {recording.path} has lost events; accepted: whole ones"
                )
            if isinstance(event, SessionStarted):
                event = dataclasses.replace(event, environment=environment())
            elif isinstance(event, Timed):
                event = seconds.get(event.step, event)
            recorder.record(event)
        recorder.close()
    except BaseException:
        recorder.close()
        os.unlink(path)
        raise
    return changes


def _change(
    recording: Recording, again: Again, sets: PlausibleSets, differing: tuple[str, ...]
) -> ResultChange:
    verdict = Verdict.of(again, differing)
    recorded, new = result_in(again.recorded), again.result
    if recorded is None or new is None:
        return ResultChange(verdict, {}, {})
    problem = recording.problem(again.step)
    old, now = (
        _measured(events) | sets.numbers(problem, found)
        for events, found in ((again.recorded, recorded), (again.today, new))
    )
    symmetry = recorded_symmetry(recording.start)
    return ResultChange(verdict, old, now, best_pose_moves(recorded, new, symmetry))


def _measured(events: Sequence[Event]) -> dict[str, float]:
    numbers: dict[str, float] = {}
    for event in events:
        if isinstance(event, HypothesesFound):
            cost = event.hypotheses.cost
            numbers["best_cost"] = float(cost[0]) if len(cost) else math.nan
        elif isinstance(event, Measured):
            numbers |= event.values
    return numbers


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
