"""A recorder that works beside the run: it hands events on in a thread of its own."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from queue import Queue
from threading import Thread

from replay.events import Event, Recorder


class BackgroundRecorder(Recorder):
    """Hands every event to another recorder, in order, while the caller goes on.

    most: events that may wait; whoever records another one then waits for its place. Events are
    frozen values, and nobody may change their arrays. `flush` and `close` return when the other
    recorder has done the same; patient: False lets `flush` only ask for it. An error of the other
    recorder is raised by the next call; what was recorded in between is dropped, as if the caller
    had stopped at the event that failed.
    """

    def __init__(self, recorder: Recorder, *, most: int = 16, patient: bool = True) -> None:
        self._recorder = recorder
        self._jobs: Queue[Callable[[], None] | None] = Queue(most)
        self._error: BaseException | None = None
        self._closed = False
        self._patient = patient
        # A daemon, so that a run that ends without closing its recorder does end.
        self._thread = Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    def record(self, event: Event) -> None:
        """Let the event be recorded soon."""
        if self._closed:
            self._recorder.record(event)
        else:
            self._raise_error()
            self._jobs.put(partial(self._recorder.record, event))

    def flush(self) -> None:
        """Wait until all events so far are recorded and flushed, or only have it done soon."""
        if self._closed:
            self._recorder.flush()
        else:
            self._jobs.put(self._recorder.flush)
            if self._patient:
                self._jobs.join()
            self._raise_error()

    def close(self) -> None:
        """Record what waits, and close the other recorder, also after an error."""
        if not self._closed:
            self._closed = True
            self._jobs.put(None)
            self._thread.join()
            try:
                self._recorder.close()
            finally:
                self._raise_error()

    def _work(self) -> None:
        """What the thread does: one job after the other, none after an error."""
        while (job := self._jobs.get()) is not None:
            try:
                if self._error is None:
                    job()
            except BaseException as error:
                self._error = error
            finally:
                self._jobs.task_done()

    def _raise_error(self) -> None:
        """Tell an error once; the jobs behind it are dropped by then."""
        if self._error is not None:
            if not self._closed:
                self._jobs.join()
            error, self._error = self._error, None
            raise error
