"""What watches the registration of a step and records it."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from chsel.numerics.arrays import FloatArray, digest
from chsel.problem.registration_problem import ArchiveSnapshot
from replay.events import Recorder, SnapshotTaken, Traced


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
        self._recorder.record(traced(self._step, stage, iteration, vectors, cost))

    def snapshot(self, archive: ArchiveSnapshot) -> None:
        """Record the archive."""
        self._recorder.record(SnapshotTaken(self._step, archive))


def traced(step: int, stage: str, iteration: int, vectors: FloatArray, cost: FloatArray) -> Traced:
    """The event of a stage that stands at search vectors (B, d) with costs (B,), B > 0."""
    costs = (float(cost.min()), float(np.median(cost)), float(cost.max()))
    return Traced(step, stage, iteration, digest(vectors, cost), costs)
