"""Record the results of the code as it stands as the expected ones, after asking."""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from rich.table import Table

from chsel.errors import RecordingError
from chsel.events import (
    Believed,
    Event,
    HypothesesFound,
    Measured,
    ProblemPosed,
    SessionStarted,
    Timed,
)
from chsel.plausible.pose_metrics import pose_errors
from chsel.plausible.symmetry import symmetry_of
from chsel.problem.object_symmetry import ObjectSymmetry
from chsel.problem.poses import inverse
from chsel.problem.registration_problem import Hypotheses
from replay.comparing.beliefs import BeliefSequence
from replay.comparing.comparison import PlausibleSets
from replay.comparing.recomputation import Recomputed, recomputed, result_in
from replay.comparing.verification import DIFFERS, Verdict, recordings_in
from replay.console import Console, plain_table
from replay.environment import environment, environment_differences
from replay.files import sync_folder
from replay.mcap.reader import Recording, read_recording
from replay.mcap.recovery import tells_loss
from replay.mcap.writer import McapRecorder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add files, and whether to ask."""
    parser.add_argument("files", nargs="+", metavar="FILE", help="recordings, or folders of them")
    parser.add_argument("--yes", action="store_true", help="do not ask")


def run(given: argparse.Namespace) -> int:
    """Accept file by file; status 1 if the answer was no."""
    paths = recordings_in(given.files)
    if not given.yes and not sys.stdin.isatty():
        raise RecordingError("nobody can be asked here; accepted: --yes")
    return max(_accept(path, ask=not given.yes) for path in paths)


def _accept(path: Path, *, ask: bool) -> int:
    console = Console(soft_wrap=True)
    new = path.with_name(f"{path.name}.{os.getpid()}.new")
    try:
        changes = write_accepted(read_recording(path), new)
        differing = [change for change in changes if change.verdict.outcome == DIFFERS]
        if not differing:
            console.print(f"{path}: all {len(changes)} results are as recorded, nothing to change")
            return 0
        for change in differing:
            for line in change.verdict.report().split("\n"):
                console.print(line)
        counts = f"{len(differing)} of {len(changes)} results"
        registrations = [change for change in differing if not change.verdict.is_decision]
        console.print(_table(f"{path}: {counts} change", registrations))
        if ask and console.input("record these results as the expected ones? [y/N] ") != "y":
            console.print(f"{path}: left as it was")
            return 1
        new.replace(path)
        sync_folder(path.parent)
        console.print(f"{path}: {counts} are new")
        return 0
    finally:
        new.unlink(missing_ok=True)


def _table(title: str, changes: Sequence[ResultChange]) -> Table:
    """Return a row for each registration whose result changes."""
    table = plain_table(title, texts=["step", "up to", "best pose moves", *_NUMBERS])
    for change in changes:
        position, rotation = change.moved
        cells = [str(change.verdict.step), f"{change.verdict.largest_ulps:.3g} ulp"]
        cells.append(f"{1e3 * position:.2f} mm {math.degrees(rotation):.2f}°")
        for name, form, unit in _NUMBERS.values():
            values = (unit * of.get(name, math.nan) for of in (change.recorded, change.new))
            old, new = ("-" if math.isnan(value) else f"{value:{form}}" for value in values)
            cells.append(old if old == new else f"{old} -> {new}")
        table.add_row(*cells)
    return table


_NUMBERS = {
    "best cost": ("best_cost", ".5g", 1.0),
    "distinct": ("distinct_hypotheses", ".0f", 1.0),
    "error, mm": ("best_position_error", ".2f", 1e3),
    "error, °": ("best_rotation_error", ".2f", math.degrees(1.0)),
    "PD, mm²": ("diversity", ".4g", 1.0),
}
"""Columns of the table: a number of a result, its form, and what turns it into the unit shown."""


@dataclass(frozen=True)
class ResultChange:
    """The change of a result from the recorded one.

    Numbers are those measured, best_cost, and where the plausible set of the step lies beside the
    recording coverage, plausibility and diversity in mm^2.
    """

    verdict: Verdict
    recorded: dict[str, float]  # numbers about the recorded result
    new: dict[str, float]  # numbers about the new one
    moved: tuple[float, float] = (math.nan, math.nan)  # the best pose: metres, radians


def write_accepted(recording: Recording, path: Path) -> list[ResultChange]:
    """Write the recording with computed results to a new file; return how each result differs.

    Registrations follow from computed results; decisions are of the recorded probes, whatever they
    choose, and the steps that register stay. A recorded belief becomes that of the computed result.
    Raise RecordingError if the recording was recovered with losses, behind which E_0 and E_l do not
    follow from what is left.
    """
    changes: list[ResultChange] = []
    seconds: dict[int, Timed] = {}
    differing = environment_differences(recording.start)
    sets = PlausibleSets(recording)
    beliefs = BeliefSequence(recording)
    with closing(McapRecorder(path)) as recorder:
        for event in recomputed(recording, follow_computed=True):
            if isinstance(event, Recomputed):
                posed = event.computed[0] if event.computed else None
                if event.result is not None and isinstance(posed, ProblemPosed):
                    problem, result = posed.problem, event.result
                changes.append(_change(recording, event, sets=sets, differing=differing))
                seconds[event.step] = Timed(event.step, event.seconds)
                for inner in event.computed or event.recorded:
                    recorder.record(inner)
                continue
            if tells_loss(event):
                raise RecordingError(
                    f"recording {recording.path} has lost events; accepted: whole ones"
                )
            if isinstance(event, SessionStarted):
                event = dataclasses.replace(event, environment=environment())
            elif isinstance(event, Timed):
                event = seconds.get(event.step, event)
            elif isinstance(event, Believed):
                belief = beliefs.after(problem, result)
                if belief is None:
                    continue
                event = belief.event(event.step)
            recorder.record(event)
    return changes


def _change(
    recording: Recording, found: Recomputed, *, sets: PlausibleSets, differing: tuple[str, ...]
) -> ResultChange:
    verdict = Verdict.of(found, differing)
    recorded = result_in(found.recorded)
    new = found.result
    if recorded is None or new is None:
        return ResultChange(verdict, {}, new={})
    problem = recording.problem(found.step)
    old = _measured(found.recorded) | sets.numbers(problem, recorded)
    now = _measured(found.computed) | sets.numbers(problem, new)
    symmetry = symmetry_of(recording.start.sdf, recording.start.mesh)
    return ResultChange(
        verdict, old, new=now, moved=best_pose_moves(recorded, new, symmetry=symmetry)
    )


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
    recorded: Hypotheses, new: Hypotheses, *, symmetry: ObjectSymmetry
) -> tuple[float, float]:
    """Return how far the new best pose is off the recorded one, metres and radians.

    symmetry: of the object, modulo which it is, at its centre. NaN without a pose.
    """
    if len(recorded.cost) == 0 or len(new.cost) == 0:
        return math.nan, math.nan
    world_from_recorded = inverse(recorded.object_from_world[0])
    position, rotation = pose_errors(
        new.object_from_world[:1], world_from_recorded, symmetry=symmetry
    )
    return float(position[0]), float(rotation[0])
