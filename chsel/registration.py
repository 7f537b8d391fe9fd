"""Runs registrations, and announces them to recorders."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from chsel.errors import ChselError
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
from chsel.methods import trust_by
from chsel.methods.method import Method
from chsel.numerics.arrays import FloatArray, digest
from chsel.plausible.pose_metrics import result_numbers
from chsel.plausible.symmetry import ObjectSymmetry, object_symmetry
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses


@dataclass(frozen=True, eq=False)
class Registered:
    """What a registration gave: its result with trust, numbers, wall-clock seconds by stage."""

    hypotheses: Hypotheses
    numbers: Mapping[str, float]
    seconds: Mapping[str, float]

    @property
    def total_seconds(self) -> float:
        """Of all stages."""
        return sum(self.seconds.values())


class StepObserver:
    """Hands what happens within one registration to the recorder, and takes the time by stage."""

    def __init__(
        self,
        recorder: Recorder,
        step: int,
        snapshot_interval: int,
        show: Callable[[str, int, int], None],
    ) -> None:
        self.snapshot_interval = snapshot_interval
        self.seconds: dict[str, float] = {}
        self._recorder = recorder
        self._step = step
        self._show = show
        self._mark = time.perf_counter()

    def progress(self, stage: str, iteration: int, total: int) -> None:
        """Show it, and count the time since the last report to the stage."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._mark
        self._mark = now
        self._show(stage, iteration, total)

    def trace(self, stage: str, iteration: int, vectors: FloatArray, cost: FloatArray) -> None:
        """Record where the stage stands."""
        ordered, half = np.sort(cost), len(cost) // 2  # faster than numpy's median
        median = ordered[half] if len(cost) % 2 else (ordered[half - 1] + ordered[half]) / 2.0
        costs = (float(cost.min()), float(median), float(cost.max()))
        traced = Traced(self._step, stage, iteration, digest(vectors, cost), *costs)
        self._recorder.record(traced)

    def snapshot(self, archive: ArchiveSnapshot) -> None:
        """Record the archive."""
        self._recorder.record(SnapshotTaken(self._step, archive))


def register_recorded(
    posed: ProblemPosed,
    method: Method,
    recorder: Recorder,
    world_from_object: FloatArray | None,
    symmetry: ObjectSymmetry | None,
    *,
    snapshot_interval: int = 0,
    show: Callable[[str, int, int], None] = lambda *_: None,
) -> Registered:
    """Register a problem, and record it with all that the registration gives.

    world_from_object (4, 4): the true pose, where known. symmetry: of the object, for the errors to
    the true pose; None: without errors. show: gets stage, iteration and total.
    """
    recorder.record(posed)
    observer = StepObserver(recorder, posed.step, snapshot_interval, show)
    begun = time.perf_counter()
    hypotheses = method.register(posed.problem, observer)
    seconds = dict(observer.seconds)
    seconds["other"] = time.perf_counter() - begun - sum(observer.seconds.values())
    trust = trust_by(method, posed.problem, hypotheses)
    truth = None if symmetry is None else world_from_object
    numbers = result_numbers(hypotheses, posed.problem, truth, symmetry, trust)
    results: tuple[Event, ...] = (
        HypothesesFound(posed.step, hypotheses),
        Measured(posed.step, numbers),
    )
    for event in results:  # both or none
        recorder.check(event)
    for event in results:
        recorder.record(event)
    return Registered(replace(hypotheses, trust=trust), numbers, seconds)


def symmetry_for_errors(start: SessionStarted) -> ObjectSymmetry | None:
    """The symmetries of a session's object; None if no true pose is known to need them."""
    return None if start.world_from_object is None else object_symmetry(start.mesh)


def one_line(error: BaseException) -> str:
    """The text of an error, with its class if it is none of ours."""
    text = printable(" ".join(str(error).split()))
    return text if isinstance(error, ChselError) else f"{type(error).__name__}: {text}"


def printable(text: str) -> str:
    """A text whose control characters are shown by their codes, as recordings hold none."""
    return "".join(c if c.isprintable() or c in "\n\t" else repr(c)[1:-1] for c in text)
