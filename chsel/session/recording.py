"""What a session records: registrations with all they give, and recorders that fail."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from chsel.belief import PoseBelief
from chsel.errors import ChselError, RecordingError
from chsel.events import (
    Event,
    HypothesesFound,
    Measured,
    ProblemPosed,
    Recorder,
    SessionStarted,
    SnapshotTaken,
    Traced,
)
from chsel.methods.method import Method
from chsel.numerics.arrays import FloatArray, digest
from chsel.plausible.pose_metrics import result_numbers
from chsel.plausible.symmetry import symmetry_of
from chsel.problem.object_symmetry import ObjectSymmetry
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses
from chsel.session.judging import trust_by

NO_RESULT = "no result: "
"""How the line begins that says why a step has no result."""


@dataclass(frozen=True, eq=False)
class Registered:
    """The result of a registration, with what follows from it."""

    hypotheses: Hypotheses  # with trust
    numbers: Mapping[str, float]  # as recordings have them, see `Measured`
    seconds: Mapping[str, float]  # wall-clock times, by stage
    belief: PoseBelief | None = None  # after it, where that was wanted

    @property
    def total_seconds(self) -> float:
        """Wall-clock seconds of all stages."""
        return sum(self.seconds.values())


class StepObserver:
    """Hands what happens within one registration to the recorder, and takes the time by stage."""

    def __init__(
        self,
        recorder: Recorder,
        step: int,
        *,
        snapshot_interval: int,
        show: Callable[[str, int, int], None],
    ) -> None:
        self.snapshot_interval = snapshot_interval
        self.seconds: dict[str, float] = {}
        self._recorder = recorder
        self._step = step
        self._show = show
        self._mark = time.perf_counter()

    def progress(self, stage: str, iteration: int, total: int) -> None:  # noqa: PLR0917
        """Show it, and count the time since the last report to the stage."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._mark
        self._mark = now
        self._show(stage, iteration, total)

    def trace(self, stage: str, iteration: int, vectors: FloatArray, cost: FloatArray) -> None:  # noqa: PLR0917
        """Record where the stage stands."""
        # faster than numpy's median
        ordered = np.sort(cost)
        half = len(cost) // 2
        median = ordered[half] if len(cost) % 2 else (ordered[half - 1] + ordered[half]) / 2.0
        traced = Traced(
            self._step,
            stage,
            iteration=iteration,
            digest=digest(vectors, cost),
            lowest_cost=float(cost.min()),
            median_cost=float(median),
            highest_cost=float(cost.max()),
        )
        self._recorder.record(traced)

    def snapshot(self, archive: ArchiveSnapshot) -> None:
        """Record the archive."""
        self._recorder.record(SnapshotTaken(self._step, archive))


def register_recorded(
    posed: ProblemPosed,
    method: Method,
    *,
    recorder: Recorder,
    world_from_object: FloatArray | None,
    symmetry: ObjectSymmetry | None,
    snapshot_interval: int = 0,
    show: Callable[[str, int, int], None] = lambda *_: None,
    believe: Callable[[Hypotheses], PoseBelief] | None = None,
) -> Registered:
    """Register a problem, record it with all that the registration gives, and return this.

    world_from_object (4, 4): the true pose, where known. symmetry: of the object, for the errors to
    the true pose; None: without errors. show: gets stage, iteration and total. believe: returns the
    belief after a result with a pose, where that is wanted.
    """
    recorder.record(posed)
    observer = StepObserver(recorder, posed.step, snapshot_interval=snapshot_interval, show=show)
    begun = time.perf_counter()
    hypotheses = method.register(posed.problem, observer)
    seconds = dict(observer.seconds)
    seconds["other"] = time.perf_counter() - begun - sum(observer.seconds.values())
    trust = trust_by(method, posed.problem, hypotheses=hypotheses)
    truth = None if symmetry is None else world_from_object
    numbers = result_numbers(
        hypotheses, posed.problem, world_from_object=truth, symmetry=symmetry, trust=trust
    )
    results: list[Event] = [
        HypothesesFound(posed.step, hypotheses),
        Measured(posed.step, numbers),
    ]
    hypotheses = replace(hypotheses, trust=trust)
    belief = None
    if believe is not None and trust is not None:
        belief = believe(hypotheses)
        results.append(belief.event(posed.step))
    for event in results:  # all or none
        recorder.check(event)
    for event in results:
        recorder.record(event)
    return Registered(hypotheses, numbers, seconds=seconds, belief=belief)


class SessionRecorder(Recorder):
    """Hands events to another recorder, each checked as soon as it comes.

    Where that recorder fails, as on a full disk, the next `flush` or `close` raises its error,
    once. What follows is not recorded, so that the session can go on. Events that follow `end` are
    errors, so that a registration of another thread ends there.
    """

    def __init__(self, recorder: Recorder, advice: str = "") -> None:
        """advice: ends the text of that error."""
        self._recorder, self._advice = recorder, advice
        self._error: RecordingError | None = None  # that is not raised yet
        self._failed = False
        self._ended = False
        self._lock = threading.RLock()  # another thread may end it

    def check(self, event: Event) -> None:
        """Raise RecordingError for an event that cannot be recorded."""
        if self._ended:
            raise RecordingError("the recording has ended; accepted: no more events")
        if not self._failed:
            self._recorder.check(event)

    def record(self, event: Event) -> None:
        """Record an event. Raise as `check` does, with nothing recorded."""
        self.check(event)
        if not self._failed:
            self._attempt(lambda: self._recorder.record(event))

    def flush(self) -> None:
        """Let all events so far survive, or raise why they do not."""
        if not self._failed:
            self._attempt(self._recorder.flush)
        self._raise()

    def close(self) -> None:
        """Finish what was written, or raise why it is not finished."""
        reported = self._failed and self._error is None
        self._attempt(self._recorder.close)
        if reported:
            self._error = None
        self._raise()

    def end(self, events: Sequence[Event]) -> None:
        """Record the last events and close, whatever another thread still has to record."""
        with self._lock:
            try:
                for event in events:
                    self.record(event)
            finally:
                try:
                    self.close()
                finally:
                    self._ended = True

    def _attempt(self, call: Callable[[], None]) -> None:
        with self._lock:
            if self._ended:
                return
            try:
                call()
            except RecordingError as error:
                self._error = self._error or error
                self._failed = True

    def _raise(self) -> None:
        error, self._error = self._error, None
        if error is not None:
            raise RecordingError(f"{error}{self._advice}") from error


def symmetry_for_errors(start: SessionStarted) -> ObjectSymmetry | None:
    """Return the symmetries of a session's object; None if no true pose is known to need them."""
    return None if start.world_from_object is None else symmetry_of(start.sdf, start.mesh)


def one_line(error: BaseException) -> str:
    """Return the text of an error, with its class if it is not one of `chsel.errors`."""
    text = printable(" ".join(str(error).split()))
    return text if isinstance(error, ChselError) else f"{type(error).__name__}: {text}"


def printable(text: str) -> str:
    """Return a text with control characters as their codes, as recordings hold none."""
    return "".join(c if c.isprintable() or c in "\n\t" else repr(c)[1:-1] for c in text)
