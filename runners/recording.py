"""Where a run writes, and what watches its registrations."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from chsel.arrays import FloatArray, digest
from chsel.errors import RecordingError, require_positive
from chsel.problem import ArchiveSnapshot
from replay.background_recorder import BackgroundRecorder
from replay.events import Recorder, SnapshotTaken, Traced
from replay.mcap_writer import McapRecorder
from replay.recorder import TeeRecorder
from replay.rerun_recorder import RerunRecorder


@dataclass(frozen=True)
class RecordingConfig:
    """mcap, rerun: which files to write. live: show the session in the viewer while it runs.

    snapshot_interval: quality-diversity iterations between archive snapshots; 0 for the first and
    last alone.
    """

    mcap: bool = True
    rerun: bool = True
    live: bool = False
    snapshot_interval: int = 25

    def __post_init__(self) -> None:
        require_positive("snapshot_interval", self.snapshot_interval, zero=True)


def make_run_folder(logs: Path, *names: str) -> Path:
    """A new folder TIME_NAME_NAME_ID in `logs`; the random id keeps two runs of a second apart.

    Of names, which may come from a file, only letters, digits and a few signs are taken.
    """
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    parts = [stamp, *(re.sub(r"[^\w.-]", "-", name)[:60] for name in names), os.urandom(2).hex()]
    folder = logs / "_".join(parts)
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise RecordingError(
            f"run folder {folder} cannot be made ({error.strerror}); accepted: a writable logs=DIR"
        ) from None
    return folder


def open_recorder(folder: Path, config: RecordingConfig) -> Recorder:
    """A recorder to all files that `config` asks for, each written by a thread of its own.

    After every step the run waits for the MCAP file, the full record, and not for the pictures.
    """
    recorders: list[Recorder] = []
    if config.mcap:
        recorders.append(BackgroundRecorder(McapRecorder(folder / "recording.mcap")))
    if config.rerun or config.live:
        path = folder / "recording.rrd" if config.rerun else None
        pictures = RerunRecorder(path, live=config.live)
        recorders.append(BackgroundRecorder(pictures, patient=False))
    return TeeRecorder(recorders)


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
        costs = (float(cost.min()), float(np.median(cost)), float(cost.max()))
        self._recorder.record(Traced(self._step, stage, iteration, digest(vectors, cost), costs))

    def snapshot(self, archive: ArchiveSnapshot) -> None:
        """Record the archive."""
        self._recorder.record(SnapshotTaken(self._step, archive))
