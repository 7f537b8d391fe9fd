"""The recorders between a session and its files."""

from __future__ import annotations

import os
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from chsel.errors import RecordingError
from chsel.events import Event, Recorder
from replay.mcap.writer import McapRecorder

_MOST = 64  # events that wait for their turn, or to be drawn
# What Rerun itself would print of a failing disk, over several lines; one line of ours says it.
_LOG_FILTER = "error,re_log_encoding=off,re_sdk=off"


def open_recorder(mcap: Path | None, rerun: Path | None = None, *, live: bool = False) -> Recorder:
    """Open a recorder to an MCAP file, a Rerun recording, or both. live: to the viewer, too.

    The session waits for the MCAP file, the full record, and not for the pictures; beside that
    file, pictures that cannot be written are a warning. Raise RecordingError if a file exists.
    """
    files = [] if mcap is None else [McapRecorder(mcap)]
    pictures: Recorder | None = None
    if rerun is not None or live:
        os.environ.setdefault("RUST_LOG", _LOG_FILTER)  # read once, when Rerun is imported
        from replay.rerun.rerun_recorder import RerunRecorder

        pictures = RerunRecorder(rerun, live=live)
    optional = "" if mcap is None else "`replay view` makes it"
    return Recorders(files, pictures, live=live, optional=optional)


class Recorders(Recorder):
    """Recorders of files that get every event, at `flush` or when many wait.

    So a registration has the processor for itself. The caller waits for files to be written, but
    not for pictures, which a thread draws while the session goes on: an error of theirs is raised
    by a later call. Events are frozen values, and nobody may change their arrays.
    """

    def __init__(
        self,
        files: Sequence[Recorder],
        pictures: Recorder | None = None,
        *,
        live: bool = False,
        optional: str = "",
    ) -> None:
        """Start a recorder of files and pictures. live: hand over every event at once.

        optional: what to do about pictures that cannot be drawn. Where this is given, a
        RecordingError of theirs is a warning that ends with it, and no more is drawn.
        """
        self._files = tuple(files)
        self._pictures = pictures
        self._most = 0 if live else _MOST
        self._optional = optional
        self._waiting: list[Event] = []
        self._thread = ThreadPoolExecutor(1, "recorder")
        self._jobs: deque[Future[None]] = deque()  # of the thread
        self._ended = False  # whether an error has ended drawing

    def check(self, event: Event) -> None:
        """Raise RecordingError for an event that a file cannot hold."""
        for recorder in self._files:
            recorder.check(event)

    def record(self, event: Event) -> None:
        """Keep the event for a while."""
        self._waiting.append(event)
        if len(self._waiting) > self._most:
            self._hand_over()

    def flush(self) -> None:
        """Record all events so far, and flush the files; the thread flushes the pictures soon."""
        self._hand_over()
        for recorder in self._files:
            recorder.flush()
        if self._pictures is not None:
            self._do_soon(self._pictures.flush)

    def close(self) -> None:
        """Record what waits, and close all, also after an error."""
        with ExitStack() as stack:
            stack.callback(self._end_thread)
            for recorder in self._files:
                stack.callback(recorder.close)
            self._hand_over()

    def _hand_over(self) -> None:
        """Record what waits; what follows an event that cannot be recorded is dropped."""
        events, self._waiting = self._waiting, []
        for event in events:
            for recorder in self._files:
                recorder.record(event)
            if self._pictures is not None:
                self._do_soon(self._pictures.record, event)

    def _do_soon(self, job: Callable[..., None], *given: Any) -> None:
        """Let the thread do it, or raise the error of what it has done before."""
        while len(self._jobs) > _MOST or (self._jobs and self._jobs[0].done()):
            self._jobs.popleft().result()
        self._jobs.append(self._thread.submit(self._do, job, *given))

    def _do(self, job: Callable[..., None], *given: Any) -> None:
        if self._ended:
            return
        try:
            job(*given)
        except Exception as error:
            self._ended = True
            if not self._optional or not isinstance(error, RecordingError):
                raise
            warnings.warn(f"{error}; {self._optional}", stacklevel=2)

    def _end_thread(self) -> None:
        pictures, self._pictures = self._pictures, None
        try:
            if pictures is not None:
                self._do_soon(pictures.close)
            while self._jobs:
                self._jobs.popleft().result()
        finally:
            self._thread.shutdown()
