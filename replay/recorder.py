"""Recorders that write nothing themselves."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack

from replay.events import Event, Recorder


class NullRecorder(Recorder):
    """Writes nothing down."""

    def record(self, event: Event) -> None:
        """Ignore it."""

    def flush(self) -> None:
        """Nothing to do."""

    def close(self) -> None:
        """Nothing to do."""


class ListRecorder(Recorder):
    """Keeps the events in `events`."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def record(self, event: Event) -> None:
        """Keep it."""
        self.events.append(event)

    def flush(self) -> None:
        """Nothing to do."""

    def close(self) -> None:
        """Nothing to do."""


class TeeRecorder(Recorder):
    """Hands every event to several recorders, in their order."""

    def __init__(self, recorders: Sequence[Recorder]) -> None:
        self._recorders = tuple(recorders)

    def record(self, event: Event) -> None:
        """Give the event to each; the first error stops it."""
        for recorder in self._recorders:
            recorder.record(event)

    def flush(self) -> None:
        """Flush each, also after one has failed."""
        with ExitStack() as stack:
            for recorder in reversed(self._recorders):
                stack.callback(recorder.flush)

    def close(self) -> None:
        """Close each, also after one has failed."""
        with ExitStack() as stack:
            for recorder in reversed(self._recorders):
                stack.callback(recorder.close)
