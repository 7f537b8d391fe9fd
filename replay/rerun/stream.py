"""Streams of Rerun into new .rrd files and live viewers, and the times of what is logged."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread

import rerun as rr

from chsel.errors import RecordingError

PROBE = "probe"
ITERATION = "iteration"
_FLUSH_SECONDS = 10.0


def new_stream(
    application: str, path: Path | None, *, viewer: rr.GrpcSink | None = None
) -> rr.RecordingStream:
    """Return a stream without clocks to a new file, a viewer, or both.

    Raise RecordingError if the file exists or cannot be written.
    """
    sinks: list[rr.FileSink | rr.GrpcSink] = [] if viewer is None else [viewer]
    if path is not None:
        try:
            path.open("xb").close()
        except OSError as error:
            raise RecordingError(
                f"{path} cannot be written ({error.strerror or error}); accepted: a new .rrd file"
            ) from None
        sinks.append(rr.FileSink(path))
    stream = rr.RecordingStream(application, send_properties=False)
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    if sinks:
        stream.set_sinks(*sinks)
    else:
        stream.disconnect()
    return stream


@contextmanager
def new_file_stream(path: Path, application: str) -> Iterator[rr.RecordingStream]:
    """Open a stream into a new .rrd file, finished with the block, removed if that fails.

    Raise RecordingError if the file exists or cannot be written.
    """
    stream = new_stream(application, path)
    try:
        yield stream
        flush(stream, path)
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    finally:
        stream.disconnect()


def flush(stream: rr.RecordingStream, path: Path | None, *, must: bool = True) -> None:
    """Hand all that was logged to the operating system, and to the viewer if there is one.

    must: raise RecordingError, which names the file, if it is not taken, so that nothing more can
    be logged; otherwise warn. After an error, Rerun would wait for the file when the stream or the
    process ends, for ever: so neither is cleaned up.
    """
    try:
        stream.flush(timeout_sec=_FLUSH_SECONDS)
    except RuntimeError as error:
        if not must:
            warnings.warn(f"the live view or the file does not follow: {error}", stacklevel=2)
            return
        rr.unregister_shutdown()
        Thread(target=lambda _: Event().wait(), args=(stream,), daemon=True).start()
        message = f"recording {path} cannot be written: the disk may be full"
        raise RecordingError(message) from None


class Clock:
    """The times at which events are logged.

    On the timeline `probe` a moment is the step of a probe, and shows what was known and found by
    its end. On `iteration` it is a running count of the iterations of all stages of all
    registrations, one extra per registration, so that scrubbing it plays every snapshot in order,
    with the scene of its time.
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        self.iteration = 0
        self._stream = stream
        self._stages: dict[str, int] = {}

    def set_probe(self, step: int) -> None:
        """Log from here on to probe `step`."""
        self._stream.set_time(PROBE, sequence=step)
        self._set_iteration(self.iteration)

    def tick(self) -> None:
        """Begin a registration, or a moment that has something of its own to see."""
        self._stages = {}
        self._set_iteration(self.iteration + 1)

    def advance(self, stage: str, iteration: int) -> None:
        """Report that a stage has done `iteration` iterations; stages come in turn."""
        start = self._stages.setdefault(stage, self.iteration)
        self._set_iteration(max(self.iteration, start + iteration))

    def _set_iteration(self, iteration: int) -> None:
        self.iteration = iteration
        self._stream.set_time(ITERATION, sequence=iteration)
