"""Streams of Rerun into new .rrd files, and whether these get what they are sent."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread

import rerun as rr

from chsel.errors import RecordingError
from replay.files import require_new, sync_file, sync_folder

_END = b"RRF2FOOT"  # near the end of every finished .rrd file
_END_SIZE = 64  # bytes
_FLUSH_SECONDS = 10.0
_MOMENT = 2.0  # seconds in which any disk writes something of what waits


def new_stream(application: str, *sinks: rr.FileSink | rr.GrpcSink) -> rr.RecordingStream:
    """A stream without clocks, to all sinks. Raises OSError or RuntimeError if one fails."""
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
    """A stream into a new .rrd file that is finished with the block; removed if the block fails.

    Raises RecordingError if the file exists or cannot be written.
    """
    require_new(path)
    file = RrdFile(path)
    try:
        stream = new_stream(application, file.sink)
        try:
            yield stream
        except BaseException:
            stream.disconnect()
            raise
        try:
            with suppress(RuntimeError):  # a writer that has failed, which shows in the file
                stream.flush(timeout_sec=_FLUSH_SECONDS)
            file.check(grown=True)
            stream.disconnect()
            file.finish()
        except RecordingError:
            abandon(stream)
            raise
    except BaseException:
        path.unlink(missing_ok=True)
        raise


class RrdFile:
    """A file that Rerun writes in a thread of its own, whose errors do not come to its callers."""

    def __init__(self, path: Path) -> None:
        """Raises RecordingError if the file cannot be written."""
        self._path = path
        self._size: int | None = 0  # at the last check
        try:
            path.open("wb").close()
        except OSError as error:
            raise self._error(error) from None

    @property
    def sink(self) -> rr.FileSink:
        """Where to send what belongs into the file."""
        return rr.FileSink(self._path)

    def check(self, *, grown: bool, late: bool = False) -> None:
        """Raise RecordingError if the file is gone, or has not grown though it should have.

        grown: whether something that takes space was flushed since the last check. late: the flush
        gave up, with much that waits to be written.
        """
        before = self._size
        if late:
            before = self._current_size()
            time.sleep(_MOMENT)
        self._size = self._current_size()
        if self._size is None:
            raise RecordingError(f"recording {self._path} is not there any more")
        if grown and self._size == before:
            raise RecordingError(f"recording {self._path} cannot be written: the disk may be full")

    def finish(self, *, whole: bool = True) -> None:
        """Wait until the file is on the disk. Raises RecordingError if it does not get there.

        whole: whether to see to it that the file has its end.
        """
        self.check(grown=False)
        try:
            sync_file(self._path)
        except OSError as error:
            raise self._error(error) from None
        sync_folder(self._path.parent)
        if not whole:
            return
        with self._path.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _END_SIZE))
            if _END not in file.read():
                raise RecordingError(
                    f"recording {self._path} cannot be written to its end: the disk may be full"
                )

    def _current_size(self) -> int | None:
        """In bytes; None if the file is not there."""
        try:
            return self._path.stat().st_size
        except OSError:
            return None

    def _error(self, error: OSError) -> RecordingError:
        reason = error.strerror or error
        return RecordingError(
            f"{self._path} cannot be written ({reason}); accepted: a new .rrd file"
        )


def abandon(stream: rr.RecordingStream) -> None:
    """Leave a stream as it is until the process ends.

    Rerun waits for a writer that has failed, in its clean-up at exit and when a stream goes away,
    and may do so for ever. So there is no clean-up, and a thread that waits for ever keeps it.
    """
    rr.unregister_shutdown()
    Thread(target=lambda _: Event().wait(), args=(stream,), daemon=True).start()
