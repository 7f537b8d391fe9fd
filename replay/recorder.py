"""The chain between a session and its files: in order, to each file, in the background."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import cache, partial
from queue import Queue
from threading import Thread

from chsel.errors import RecordingError
from replay.events import Event, Recorder


class NullRecorder(Recorder):
    """Writes nothing down."""

    def record_later(self, make: Callable[[], Event]) -> None:
        """Let the event be."""


class ListRecorder(Recorder):
    """Keeps the events in `events`."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def record(self, event: Event) -> None:
        """Keep it."""
        self.events.append(event)


class TeeRecorder(Recorder):
    """Hands every event to several recorders, in their order."""

    def __init__(self, recorders: Sequence[Recorder]) -> None:
        self._recorders = tuple(recorders)

    def record(self, event: Event) -> None:
        """Give the event to each; the first error stops it."""
        for recorder in self._recorders:
            recorder.record(event)

    def record_later(self, make: Callable[[], Event]) -> None:
        """Let the event be made once, by the first that records it."""
        make = cache(make)
        for recorder in self._recorders:
            recorder.record_later(make)

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


class DeferredRecorder(Recorder):
    """Hands events to another recorder at `flush`, all at once, or when many wait.

    What happens in between has the processor for itself.
    """

    def __init__(self, recorder: Recorder, *, most: int = 64) -> None:
        """most: events that wait; with one more, all are handed over."""
        self._recorder, self._most = recorder, most
        self._kept: list[Callable[[], None]] = []

    def record(self, event: Event) -> None:
        """Keep the event."""
        self._keep(partial(self._recorder.record, event))

    def record_later(self, make: Callable[[], Event]) -> None:
        """Keep what makes the event."""
        self._keep(partial(self._recorder.record_later, make))

    def flush(self) -> None:
        """Let the other recorder record all events so far, and flush it."""
        self._hand_over()
        self._recorder.flush()

    def close(self) -> None:
        """Let the other recorder record all events, and close it, also after an error."""
        try:
            self._hand_over()
        finally:
            self._recorder.close()

    def _keep(self, job: Callable[[], None]) -> None:
        self._kept.append(job)
        if len(self._kept) > self._most:
            self._hand_over()

    def _hand_over(self) -> None:
        """Record what was kept; what follows an event that cannot be recorded is dropped."""
        kept, self._kept = self._kept, []
        for job in kept:
            job()


class BackgroundRecorder(Recorder):
    """Hands every event to another recorder, in order, in a thread of its own.

    Events are frozen values, and nobody may change their arrays. `close` returns when the other
    recorder is closed, `flush` at once. An error of the other recorder is raised by the next call;
    what was recorded in between is dropped, as if the caller had stopped at the event that failed.
    """

    def __init__(self, recorder: Recorder, *, most: int = 64, optional: str = "") -> None:
        """A recorder in front of another one.

        most: events that may wait; the caller who records one more waits for its place. optional:
        what to do about a recording that is not written; where this is given, a RecordingError is a
        warning that ends with it, and no more is recorded.
        """
        self._recorder = recorder
        self._jobs: Queue[Callable[[], None] | None] = Queue(most)
        self._error: BaseException | None = None
        self._closed = False
        self._optional = optional
        self._ended = False  # by an error of what is optional
        # A daemon, so that a run that ends without closing its recorder does end.
        self._thread = Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    def record(self, event: Event) -> None:
        """Let the event be recorded soon."""
        self._do_soon(partial(self._recorder.record, event))

    def record_later(self, make: Callable[[], Event]) -> None:
        """Let the event be made and recorded soon, both by the thread."""
        self._do_soon(partial(self._recorder.record_later, make))

    def flush(self) -> None:
        """Let all events so far be flushed soon."""
        self._do_soon(self._recorder.flush)

    def close(self) -> None:
        """Record what waits, and close the other recorder, also after an error."""
        if not self._closed:
            self._closed = True
            self._jobs.put(None)
            self._thread.join()
            try:
                self._run(self._recorder.close)
            finally:
                self._raise_error()

    def _do_soon(self, job: Callable[[], None]) -> None:
        if self._closed:
            job()
        else:
            self._raise_error()
            self._jobs.put(job)

    def _work(self) -> None:
        """What the thread does: one job after the other, none after an error."""
        while (job := self._jobs.get()) is not None:
            try:
                if self._error is None:
                    self._run(job)
            except BaseException as error:
                self._error = error
            finally:
                self._jobs.task_done()

    def _run(self, job: Callable[[], None]) -> None:
        if self._ended:
            return
        try:
            job()
        except RecordingError as error:
            if not self._optional:
                raise
            warnings.warn(f"{error}; {self._optional}", stacklevel=2)
            self._ended = True

    def _raise_error(self) -> None:
        """Raise an error once; the jobs behind it are dropped by then."""
        if self._error is not None:
            if not self._closed:
                self._jobs.join()
            error, self._error = self._error, None
            raise error
