"""Whether today's code gives the recorded bits, and if not, where it first does not."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Container, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import tee
from multiprocessing import get_context
from pathlib import Path

from chsel.errors import ChselError, RecordingError
from chsel.numerics.threads import threads
from chsel.problem.online_registration import OnlineStep
from chsel.problem.registration_problem import Hypotheses
from replay.comparing.decisions_again import DecisionsAgain
from replay.comparing.results import (
    RecordedRegistration,
    ResultDifferences,
    has_measured,
    recorded_registrations,
    result_in,
    stage_name,
)
from replay.environment import environment_differences
from replay.events import Decided, Event, Probe, SnapshotTaken, Traced
from replay.mcap.reader import Recording, read_recording
from replay.recorder import ListRecorder
from replay.registration import (
    NamedMethod,
    recorded_method,
    recorded_online,
    register_recorded,
    snapshot_interval,
    symmetry_for_errors,
)

EQUAL, DIFFERS, NO_RESULT = "equal", "differs", "no result"
_PATIENCE = 10  # times the recorded iterations of a stage; more are not worth waiting for


@dataclass(frozen=True)
class Verdict:
    """What verifying one step showed."""

    step: int
    method: str  # or policy
    outcome: str  # "equal", "differs", or "no result" where the recorded registration did not end
    stage: str = ""  # the first that differs
    before: int = 0  # how many recorded stages before it are equal
    differences: tuple[str, ...] = ()  # of the recorded numbers, line by line
    largest_ulps: int = 0  # over all of them
    environment: tuple[str, ...] = ()  # what of it is not as recorded
    seconds: float = 0.0  # of registering
    is_decision: bool = False  # that follows the step, else its registration

    @property
    def label(self) -> str:
        """What it is about: "step 3, chsel", or "decision after step 3, information"."""
        return f"{'decision after ' * self.is_decision}step {self.step}, {self.method}"

    def report(self) -> str:
        """The verdict for people; several lines if it is "differs"."""
        if self.outcome != DIFFERS:
            return f"{self.label}: {self.outcome}"
        stages = "values" if self.is_decision else "stages"
        lines = [
            f"{self.label}: differs",
            f"first difference: {self.stage} ({self.before} recorded {stages} before it are equal)",
            *self.differences,
            f"largest difference: {self.largest_ulps} ulp",
            "environment: " + ("; ".join(self.environment) or "the same as recorded"),
        ]
        return "\n  ".join(lines)

    @classmethod
    def of(
        cls,
        step: int,
        method: str,
        found: ResultDifferences,
        *,
        environment: tuple[str, ...],
        seconds: float = 0.0,
        is_decision: bool = False,
    ) -> Verdict:
        """The verdict that follows from the differences of a result."""
        about = cls(step, method, EQUAL, seconds=seconds, is_decision=is_decision)
        if not found.stage:
            return replace(about, before=found.before)
        return replace(
            about,
            outcome=DIFFERS,
            stage=found.stage,
            before=found.before,
            differences=tuple(found.lines),
            largest_ulps=found.largest_ulps,
            environment=environment,
        )


def verify(recording: Recording, steps: Sequence[int] | None = None) -> Iterator[Verdict]:
    """Verdicts on steps of a recording, in their order: on registrations and decisions.

    steps: None for all that pose a problem or are followed by a decision. The belief of a decision
    is compared where the registration before it is run again. Raises RecordingError if the
    recording does not have the settings of its method or policy, or lacks a step.
    """
    method = recorded_method(recording)
    wanted = set(steps_to_verify(recording, steps))
    differing = environment_differences(recording.start)
    registrations, again = tee(recorded_registrations(recording))
    perceived = ((one.posed.step, one.new_points) for one in again)
    online = recorded_online(recording, method.method)
    walked = online.steps(perceived, catch=ChselError)
    decisions = _DecisionVerdicts(recording, wanted, differing)
    if not recording.steps:
        yield from decisions.following(recording.events(images=False))
    for recorded in registrations:
        if recorded.is_first:
            yield from decisions.following(recorded.preceding)
        if decisions.larger:
            online.start_afresh(decisions.larger)
        step = next(walked)
        found = None
        if step.step in wanted:
            verdict, found = _verified(recording, recorded, step, method, differing)
            yield verdict
        if recorded.last_result is not None:
            online.remember(recorded.last_result)
            decisions.registered(found)
        yield from decisions.following(recorded.following)


def steps_to_verify(recording: Recording, steps: Sequence[int] | None) -> tuple[int, ...]:
    """Steps with a problem or a decision, in order; None means all. RecordingError if not."""
    decided = set(recording.decision_steps)
    if steps is None:
        return tuple(sorted({*recording.steps, *decided}))
    posed = recording.checked_steps([step for step in steps if step not in decided])
    return tuple(sorted({*posed, *decided.intersection(steps)}))


class _DecisionVerdicts:
    """Makes decisions again on the way through a recording.

    larger: the size of the next registration if an outcome since the last one makes it start
    afresh, else 0.
    """

    def __init__(
        self, recording: Recording, wanted: Container[int], environment: tuple[str, ...]
    ) -> None:
        self.larger = 0
        self._again = DecisionsAgain(recording) if recording.decision_steps else None
        self._wanted, self._environment = wanted, environment
        self._result: Hypotheses | None = None  # of the last registration
        self._known = True  # whether that was run again, or there was none

    def registered(self, result: Hypotheses | None) -> None:
        """A registration had a result, and has this one again; None if it was not run."""
        self._result, self._known, self.larger = result, result is not None, 0

    def following(self, events: Iterable[Event]) -> Iterator[Verdict]:
        """Verdicts on the decisions among events."""
        again = self._again
        if again is None:
            return
        for event in events:
            if isinstance(event, Probe):
                larger = again.probed(event)
                if larger:  # what was found before is forgotten
                    self.larger, self._result, self._known = larger, None, True
            elif isinstance(event, Decided):
                if event.step in self._wanted:
                    yield self._verdict(again, event)
                again.remember(event)

    def _verdict(self, again: DecisionsAgain, decided: Decided) -> Verdict:
        begun = time.perf_counter()
        found = again.differences(decided, self._result, known=self._known)
        return Verdict.of(
            decided.step,
            again.name,
            found,
            environment=self._environment,
            seconds=time.perf_counter() - begun,
            is_decision=True,
        )


def _verified(
    recording: Recording,
    registration: RecordedRegistration,
    again: OnlineStep,
    method: NamedMethod,
    environment: tuple[str, ...],
) -> tuple[Verdict, Hypotheses | None]:
    """Register a recorded problem again, and compare; again: the problem, posed today.

    Also returns the result, if there is one.
    """
    start, posed, recorded = recording.start, registration.posed, registration.events
    if result_in(recorded) is None:
        return Verdict(posed.step, method.name, NO_RESULT), None
    found = ResultDifferences()
    if registration.follows and again.problem is not None:
        found.add_sets(posed.problem, again.problem)
    elif registration.follows:  # such as after a result whose poses are not finite
        found.fail("making E_0", f"E_0 and E_l cannot be made again: {again.failure}")
    recorder = _PatientRecorder(recorded) if registration.complete else ListRecorder()
    failure, seconds, result = "", 0.0, None
    try:
        registered = register_recorded(
            posed,
            method.method,
            recorder,
            start.world_from_object,
            symmetry_for_errors(start),
            snapshot_interval=snapshot_interval(recording.snapshots(posed.step)),
        )
        seconds, result = registered.total_seconds, registered.hypotheses
    except (_FarBeyondError, ChselError) as error:
        failure = str(error)
    found.add_stages(recorded, recorder.events)
    if failure:
        reason = f"today's registration does not end: {failure}"
        found.fail("the end of the registration", reason)
    if has_measured(registration):
        found.add_measured(recorded, recorder.events)
    verdict = Verdict.of(posed.step, method.name, found, environment=environment, seconds=seconds)
    return verdict, result


class _FarBeyondError(Exception):
    """A registration goes on long after the recorded one had ended."""


class _PatientRecorder(ListRecorder):
    """Keeps events, and stops a registration that goes on far beyond the recorded one."""

    def __init__(self, recorded: Sequence[Event]) -> None:
        super().__init__()
        traces = [event for event in recorded if isinstance(event, Traced)]
        self._last = {
            stage: max(event.iteration for event in traces if event.stage == stage)
            for stage in {event.stage for event in traces}
        }
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
                    f"{stage_name(event)} is far beyond the last recorded one, {last}"
                )
        super().record(event)


@dataclass
class FileVerdict:
    """What verifying one file showed."""

    path: Path
    verdicts: list[Verdict] = field(default_factory=list)
    unusable: str = ""  # why the file could not be verified
    digest: str = ""  # of the file
    seconds: float = 0.0  # from reading the file to its last verdict, summed over processes

    @property
    def status(self) -> int:
        """0 if all steps are equal, 1 if one differs, 2 if the file cannot be used."""
        if self.unusable:
            return 2
        return int(any(verdict.outcome == DIFFERS for verdict in self.verdicts))

    @property
    def equal(self) -> int:
        """How many registrations are equal."""
        return sum(verdict.outcome == EQUAL for verdict in self.registrations)

    @property
    def registrations(self) -> list[Verdict]:
        """The verdicts on registrations."""
        return [verdict for verdict in self.verdicts if not verdict.is_decision]

    @property
    def decisions(self) -> list[Verdict]:
        """The verdicts on decisions."""
        return [verdict for verdict in self.verdicts if verdict.is_decision]


def recordings_in(paths: Sequence[str | Path]) -> list[Path]:
    """The files named, and for each folder the recordings in it and below, by name."""
    found: list[Path] = []
    for path in map(Path, paths):
        inside = sorted(path.rglob("*.mcap")) if path.is_dir() else [path]
        if not inside:
            raise RecordingError(f"folder {path} has no recordings; accepted: files *.mcap in it")
        found += inside
    return found


def verified_files(
    paths: Sequence[Path], steps: Sequence[int] | None = None, *, jobs: int = 1
) -> Iterator[FileVerdict]:
    """Verdicts on files, in their order, on as many processes as `jobs`; a thread in each."""
    if jobs == 1:
        for path in paths:
            yield _verified_part(path, steps, 0, 1)
        return
    parts = -(-jobs // max(len(paths), 1))
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        waiting: dict[int, list[Future[FileVerdict]]] = defaultdict(list)
        for index, path in enumerate(paths):
            for part in range(parts):
                waiting[index].append(pool.submit(_verified_part, path, steps, part, parts))
        for futures in waiting.values():
            yield _joined([future.result() for future in futures])


def _verified_part(path: Path, steps: Sequence[int] | None, part: int, parts: int) -> FileVerdict:
    """Verdicts on one of several equal parts of the steps, by one thread."""
    begun, verdict = time.perf_counter(), FileVerdict(path)
    try:
        recording = read_recording(path)
        verdict.digest = recording.digest
        wanted = steps_to_verify(recording, steps)
        first, last = (len(wanted) * part // parts, len(wanted) * (part + 1) // parts)
        decided = set(recording.decision_steps)
        if not any(recording.has_result(step) or step in decided for step in wanted):
            raise RecordingError(
                f"recording {path} has no registration with a result to verify; accepted: a "
                "recording of at least one"
            )
        with threads(1):
            verdict.verdicts = list(verify(recording, wanted[first:last]))
    except (ChselError, OSError, MemoryError) as error:
        verdict.unusable = str(error) or f"recording {path} does not fit into memory"
    verdict.seconds = time.perf_counter() - begun
    return verdict


def _joined(parts: Sequence[FileVerdict]) -> FileVerdict:
    verdicts = [verdict for part in parts for verdict in part.verdicts]
    unusable = next((part.unusable for part in parts if part.unusable), "")
    seconds = sum(part.seconds for part in parts)
    return FileVerdict(parts[0].path, verdicts, unusable, parts[0].digest, seconds)
