"""Whether today's code gives the recorded bits, and if not, where it first does not."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import tee

import numpy as np
from numpy.typing import NDArray

from chsel.errors import ChselError, RecordingError
from chsel.problem.online_registration import OnlineStep
from chsel.problem.points import KnownPoints
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses, RegistrationProblem
from replay.differences import apart, difference
from replay.environment import environment
from replay.events import (
    Event,
    HypothesesFound,
    Measured,
    Probe,
    ProblemPosed,
    SessionStarted,
    SnapshotTaken,
    Traced,
)
from replay.lost_attachment import LostAttachment
from replay.mcap.reader import Recording
from replay.mcap.recovery import tells_loss
from replay.mcap.schemas import SEALED_SINCE
from replay.measured import measured_differences
from replay.recorder import ListRecorder
from replay.registration import (
    NamedMethod,
    recorded_method,
    recorded_online,
    register_recorded,
    symmetry_for_errors,
)

EQUAL, DIFFERS, NO_RESULT = "equal", "differs", "no result"
_PATIENCE = 10  # times the recorded iterations of a stage; more are not worth waiting for
_ARCHIVE = ("lower", "upper", "cells", "solutions", "objectives", "measures")
_HYPOTHESES = ("object_from_world", "cost", "duplicate", "cell", "elites")


@dataclass(frozen=True)
class Verdict:
    """What verifying one step showed.

    outcome: "equal", "differs", or "no result" where the recorded registration did not end.
    stage: the first that differs. before: how many stages before it are equal. differences: of
    the recorded numbers, line by line. largest_ulps: over all of them. seconds: of registering.
    """

    step: int
    method: str
    outcome: str
    stage: str = ""
    before: int = 0
    differences: tuple[str, ...] = ()
    largest_ulps: int = 0
    environment: tuple[str, ...] = ()
    seconds: float = 0.0

    def report(self) -> str:
        """The verdict for people; several lines if it is "differs"."""
        if self.outcome != DIFFERS:
            return f"step {self.step}, {self.method}: {self.outcome}"
        lines = [
            f"step {self.step}, {self.method}: differs",
            f"first difference: {self.stage} ({self.before} recorded stages before it are equal)",
            *self.differences,
            f"largest difference: {self.largest_ulps} ulp",
            "environment: " + ("; ".join(self.environment) or "the same as recorded"),
        ]
        return "\n  ".join(lines)


def verify(recording: Recording, steps: Sequence[int] | None = None) -> Iterator[Verdict]:
    """Verdicts on steps of a recording (None: on all that pose a problem), in their order.

    Raises RecordingError if the recording does not tell its method, lacks a step, or has lost its
    SDF grid.
    """
    method = recorded_method(recording)
    wanted = set(recording.checked_steps(steps))
    if isinstance(recording.start.sdf, LostAttachment):
        raise RecordingError(f"recording {recording.path}: {recording.start.sdf.error()}")
    differing = environment_differences(recording.start)
    registrations, again = tee(_registrations(recording))
    perceived = ((one.posed.step, one.new_points) for one in again)
    online = recorded_online(recording, method.method)
    walked = online.steps(perceived, catch=ChselError)
    for recorded, step in zip(registrations, walked, strict=True):
        if step.step in wanted:
            yield _verified(recording, recorded, step, method, differing)
        if recorded.last_result is not None:
            online.remember(recorded.last_result)


def environment_differences(start: SessionStarted) -> tuple[str, ...]:
    """What of the recorded environment is otherwise here."""
    here = environment()
    return tuple(
        f"{name} {value} -> {here.get(name, 'unknown')}"
        for name, value in start.environment.items()
        if here.get(name) != value
    )


def snapshot_interval(snapshots: Sequence[ArchiveSnapshot]) -> int:
    """Iterations between recorded snapshots; 0 if there are the first and the last alone."""
    iterations = sorted({archive.iteration for archive in snapshots})
    return iterations[1] if len(iterations) > 2 else 0


@dataclass(frozen=True, eq=False)
class _Registration:
    """A recorded problem with the events up to the next one."""

    posed: ProblemPosed
    new_points: KnownPoints  # since the problem before
    follows: bool  # whether E_0 and E_l are of results in this recording, none of them lost
    events: list[Event]

    @property
    def last_result(self) -> Hypotheses | None:
        """The result that is known when the next problem is posed."""
        return _result(self.events[::-1])


def _registrations(recording: Recording) -> Iterator[_Registration]:
    events = recording.events(images=False)
    before, posed = _until_next_problem(events)
    lost = False
    while posed is not None:
        for event in before:
            lost = tells_loss(event) or (lost and not isinstance(event, HypothesesFound))
        new = [event.new_points for event in before if isinstance(event, Probe)]
        of_step, following = _until_next_problem(events)
        follows = not recording.start.source and not lost
        yield _Registration(posed, KnownPoints.joined([KnownPoints(), *new]), follows, of_step)
        before, posed = of_step, following


def _until_next_problem(events: Iterator[Event]) -> tuple[list[Event], ProblemPosed | None]:
    of_step: list[Event] = []
    for event in events:
        if isinstance(event, ProblemPosed):
            return of_step, event
        of_step.append(event)
    return of_step, None


def _events_of(step: int, events: Sequence[Event]) -> tuple[list[Event], bool]:
    """The events of a step, and whether all are there; its result alone if some may be lost."""
    whole = True
    for event in events:
        if isinstance(event, HypothesesFound) and event.step == step:
            break
        whole = whole and not tells_loss(event)
    own = [event for event in events if getattr(event, "step", None) == step]
    return [event for event in own if whole or isinstance(event, HypothesesFound)], whole


def _verified(
    recording: Recording,
    registration: _Registration,
    again: OnlineStep,
    method: NamedMethod,
    environment: tuple[str, ...],
) -> Verdict:
    """Register a recorded problem again, and compare; again: the problem, posed today."""
    start, posed, events = recording.start, registration.posed, registration.events
    step = posed.step
    recorded, whole = _events_of(step, events)
    expected = _result(recorded)
    if expected is None:
        return Verdict(step, method.name, NO_RESULT)
    comparison = _Comparison()
    if registration.follows:
        _compare_sets(comparison, posed.problem, again)
    watching = _Watching(recorded) if whole else ListRecorder()
    snapshots = [event.archive for event in recorded if isinstance(event, SnapshotTaken)]
    found, failure, seconds = None, "", 0.0
    try:
        registered = register_recorded(
            posed,
            method.method,
            watching,
            start.world_from_object,
            symmetry_for_errors(start),
            snapshot_interval=snapshot_interval(snapshots),
        )
        found, seconds = registered.hypotheses, registered.total_seconds
    except (_FarBeyondError, ChselError) as error:
        failure = str(error)
    _compare_stages(comparison, recorded, watching.events, ended=found is not None)
    if found is not None:
        _compare_results(comparison, expected, found)
    else:
        comparison.stage_is("the end of the registration", equal=False)
        comparison.differences.append(f"today's registration does not end: {failure}")
    numbers = [event for event in recorded if isinstance(event, Measured)]
    measured = recording.version >= SEALED_SINCE  # before, numbers may be others than today's
    if measured and (numbers or not any(map(tells_loss, events))):
        lines = measured_differences(start, posed.problem, expected, numbers, method.method)
        comparison.stage_is("the measured values", equal=not lines)
        comparison.differences += lines
    return comparison.verdict(step, method.name, environment, seconds)


@dataclass
class _Comparison:
    """Collects differences; the first names the stage."""

    stage: str = ""
    before: int = 0
    differences: list[str] = field(default_factory=list)
    largest: int = 0

    def stage_is(self, name: str, *, equal: bool) -> None:
        """A stage is compared."""
        if equal and not self.stage:
            self.before += 1
        elif not equal and not self.stage:
            self.stage = name

    def arrays(self, pairs: dict[str, tuple[NDArray, NDArray]]) -> bool:
        """Whether pairs of arrays, recorded and found, are equal; keeps how they are not."""
        texts = [difference(name, *pair) for name, pair in pairs.items()]
        self.differences += [text for text in texts if text is not None]
        self.largest = max([self.largest, *(apart(*pair) for pair in pairs.values())])
        return not any(texts)

    def verdict(
        self, step: int, method: str, environment: tuple[str, ...], seconds: float
    ) -> Verdict:
        """What all comparisons say."""
        if not self.stage:
            return Verdict(step, method, EQUAL, before=self.before, seconds=seconds)
        return Verdict(
            step,
            method,
            DIFFERS,
            self.stage,
            self.before,
            tuple(self.differences),
            self.largest,
            environment,
            seconds,
        )


class _FarBeyondError(Exception):
    """A registration goes on long after the recorded one had ended."""


class _Watching(ListRecorder):
    """Keeps events, and stops a registration that goes on far beyond the recorded one."""

    def __init__(self, recorded: Sequence[Event]) -> None:
        super().__init__()
        self._last = _last_iterations(recorded)
        snapshots = [event.archive for event in recorded if isinstance(event, SnapshotTaken)]
        self._snapshots = {archive.iteration for archive in snapshots}

    def record(self, event: Event) -> None:
        """Keep it if there is anything to compare it with, or raise."""
        if isinstance(event, SnapshotTaken) and event.archive.iteration not in self._snapshots:
            return
        if isinstance(event, Traced):
            last = self._last.get(event.stage, 0)
            if event.iteration > _PATIENCE * last + 1000:
                raise _FarBeyondError(
                    f"{_stage_name(event)} is far beyond the last recorded one, {last}"
                )
        super().record(event)


def _compare_sets(comparison: _Comparison, problem: RegistrationProblem, again: OnlineStep) -> None:
    """Whether E_0 and E_l follow from the step before as recorded (CHSEL, Alg. 2)."""
    if again.problem is None:  # such as after a result whose poses are not finite
        comparison.stage_is("making E_0", equal=False)
        comparison.differences.append(f"E_0 and E_l cannot be made again: {again.failure}")
        return
    for name, field_name in (("E_0", "initial_set"), ("E_l", "low_cost_set")):
        pair = (getattr(problem, field_name), getattr(again.problem, field_name))
        comparison.stage_is(f"making {name}", equal=comparison.arrays({name: pair}))


def _compare_stages(
    comparison: _Comparison, recorded: Sequence[Event], found: Sequence[Event], *, ended: bool
) -> None:
    """Compare traces and snapshots in the order in which they were recorded.

    ended: whether the registration ended; if not, what it did not come to is not compared.
    """
    here = _by_stage(found)
    for name, event in _by_stage(recorded).items():
        other = here.get(name)
        if other is None and ended:
            comparison.stage_is(f"{name}, which does not come about", equal=False)
        elif isinstance(event, Traced):
            comparison.stage_is(name, equal=event == other)
        elif isinstance(event, SnapshotTaken) and isinstance(other, SnapshotTaken):
            first = not comparison.stage
            equal = _snapshot_bits(event.archive) == _snapshot_bits(other.archive)
            comparison.stage_is(name, equal=equal)
            if first and not equal:
                comparison.arrays(_archive_pairs(name, event.archive, other.archive))


def _compare_results(comparison: _Comparison, expected: Hypotheses, found: Hypotheses) -> None:
    pairs = {name: (getattr(expected, name), getattr(found, name)) for name in _HYPOTHESES}
    equal = comparison.arrays(pairs)
    comparison.stage_is("choosing the hypotheses", equal=equal)
    kept, ours = expected.archive, found.archive
    if (kept is None) is not (ours is None):
        comparison.stage_is("the last archive", equal=False)
    elif kept is not None and ours is not None:
        same = _snapshot_bits(kept) == _snapshot_bits(ours)
        comparison.stage_is("the last archive", equal=same)
        if not same:
            comparison.arrays(_archive_pairs("last archive", kept, ours))


def _by_stage(events: Sequence[Event]) -> dict[str, Traced | SnapshotTaken]:
    """Traces and snapshots by a name; those of later passes are numbered."""
    named: dict[str, Traced | SnapshotTaken] = {}
    for event in events:
        if isinstance(event, Traced | SnapshotTaken):
            name, number = _stage_name(event), 1
            while name in named:
                number += 1
                name = f"{_stage_name(event)} (pass {number})"
            named[name] = event
    return named


def _stage_name(event: Traced | SnapshotTaken) -> str:
    if isinstance(event, Traced):
        return f"{event.stage}, iteration {event.iteration}"
    return f"archive, iteration {event.archive.iteration}"


def _archive_pairs(
    name: str, recorded: ArchiveSnapshot, found: ArchiveSnapshot
) -> dict[str, tuple[NDArray, NDArray]]:
    return {f"{name}: {part}": (getattr(recorded, part), getattr(found, part)) for part in _ARCHIVE}


def _snapshot_bits(archive: ArchiveSnapshot) -> tuple[object, ...]:
    """All of a snapshot, range and names included."""
    bytes_of = tuple(np.ascontiguousarray(getattr(archive, part)).tobytes() for part in _ARCHIVE)
    return (archive.iteration, archive.refinement, archive.measure_names, archive.shape, *bytes_of)


def _result(events: Sequence[Event]) -> Hypotheses | None:
    return next((e.hypotheses for e in events if isinstance(e, HypothesesFound)), None)


def _last_iterations(events: Sequence[Event]) -> dict[str, int]:
    """The last recorded iteration of each stage."""
    last: dict[str, int] = {}
    for event in events:
        if isinstance(event, Traced):
            last[event.stage] = max(last.get(event.stage, 0), event.iteration)
    return last
