"""What a session records with: refuses events before they count, and survives a full disk."""

from __future__ import annotations

from collections.abc import Callable

from chsel.errors import RecordingError
from chsel.events import Event, Recorder


class SessionRecorder(Recorder):
    """Hands events to another recorder, each checked as soon as it comes.

    Where that recorder fails, as on a full disk, the next `flush` or `close` raises its error,
    once. What follows is not recorded, so that the session can go on.
    """

    def __init__(self, recorder: Recorder, advice: str = "") -> None:
        """advice: ends the text of that error."""
        self._recorder, self._advice = recorder, advice
        self._error: RecordingError | None = None  # that is not raised yet
        self._failed = False

    def check(self, event: Event) -> None:
        """Raise RecordingError for an event that cannot be recorded."""
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

    def _attempt(self, call: Callable[[], None]) -> None:
        try:
            call()
        except RecordingError as error:
            self._error, self._failed = self._error or error, True

    def _raise(self) -> None:
        error, self._error = self._error, None
        if error is not None:
            raise RecordingError(f"{error}{self._advice}") from error
