"""A recording of an evaluation, of which no writing is timed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from chsel.problem.registration_problem import ArchiveSnapshot
from replay.events import Event, Recorder, SnapshotTaken
from replay.files import whole_file
from replay.mcap.writer import McapRecorder


class StepRecorder(Recorder):
    """Hands the events of a step to another recorder, if there is one, when the step ends."""

    def __init__(self, recorder: Recorder | None) -> None:
        self.snapshots: list[ArchiveSnapshot] = []  # of the last step
        self._recorder = recorder
        self._waiting: list[Event] = []

    def record(self, event: Event) -> None:
        """Keep it until the step ends."""
        self._waiting.append(event)

    def flush(self) -> None:
        """Record what was kept."""
        self.snapshots = [e.archive for e in self._waiting if isinstance(e, SnapshotTaken)]
        if self._recorder is not None:
            for event in self._waiting:
                self._recorder.record(event)
            self._recorder.flush()
        self._waiting.clear()


@contextmanager
def recording_in(path: Path | None) -> Iterator[StepRecorder]:
    """A recorder into a file that is there whole at the end of the context, or not at all.

    path: None for no file.
    """
    if path is None:
        yield StepRecorder(None)
        return
    with whole_file(path) as beside:
        file = McapRecorder(beside)
        try:
            recorder = StepRecorder(file)
            yield recorder
            recorder.flush()
        finally:
            file.close()
