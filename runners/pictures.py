"""The Rerun recording of a run, and whether it is whole."""

from __future__ import annotations

import ctypes
import os
import sys
import time
import warnings
from pathlib import Path

from chsel.errors import RecordingError
from replay.events import Event, Logged, Probe, Recorder, SessionStarted

_END = b"RRF2FOOT"  # near the end of every finished .rrd file
_END_SIZE = 64  # bytes
_LONG = 5.0  # seconds, for a flush
_MOMENT = 2.0  # seconds in which any disk writes something of what waits
# What Rerun itself would print of a failing disk, over several lines; it is told here instead.
_LOG_FILTER = "error,re_log_encoding=off,re_sdk=off"


def open_pictures(path: Path | None, *, live: bool, alone: bool) -> Recorder:
    """A recorder to a new .rrd file, a live viewer or both.

    alone: there is no other recording, so that a file that is not whole is an error.
    """
    os.environ.setdefault("RUST_LOG", _LOG_FILTER)  # read once, when Rerun is imported
    from replay.rerun.recorder import RerunRecorder

    recorder = RerunRecorder(path, live=live)
    # A slow viewer may hold the file up too, so that with one nothing can be told from that.
    return recorder if path is None or live else CheckedPictures(recorder, path, alone=alone)


class CheckedPictures(Recorder):
    """Hands events on, and tells when the file they should go to does not get them.

    Rerun writes in a thread of its own, whose errors do not come to its callers. What is told is
    a RecordingError if the file is `alone`, else one warning: the view can be made anew. After it
    nothing more is handed on.
    """

    def __init__(self, recorder: Recorder, path: Path, *, alone: bool) -> None:
        self._recorder, self._path, self._alone = recorder, path, alone
        self._broken = self._closed = False
        self._size: int | None = 0  # of the file, at the last flush
        self._drawn = False  # something that takes space, since then

    def record(self, event: Event) -> None:
        """Hand it on."""
        if not self._broken:
            self._recorder.record(event)
            self._drawn |= isinstance(event, SessionStarted | Probe | Logged)

    def flush(self) -> None:
        """Flush, and see whether the file is still there and has grown."""
        if self._broken:
            return
        begun, before = time.monotonic(), self._size
        self._recorder.flush()
        if time.monotonic() - begun > _LONG:  # it gave up, with much that waits to be written
            before = _size(self._path)
            time.sleep(_MOMENT)
        size = _size(self._path)
        if size is None:
            self._tell("is not there any more")
        elif self._drawn and size == before:
            self._tell("cannot be written: the disk may be full")
        self._size, self._drawn = size, False

    def close(self) -> None:
        """Close, and see whether the file has its end."""
        if self._broken or self._closed:
            return
        self._closed = True
        self.flush()
        if self._broken:
            return
        synced = True
        try:
            self._recorder.close()
        except RecordingError:
            synced = False
        if _size(self._path) is None:
            self._tell("is not there any more")
        elif not synced or _END not in _last_bytes(self._path):
            self._tell("cannot be written to its end: the disk may be full")

    def _tell(self, what: str) -> None:
        self._broken = True
        _never_wait_for(self._recorder)
        if self._alone:
            raise RecordingError(f"recording {self._path} {what}")
        warnings.warn(f"{self._path} {what}; `replay view` makes it anew", stacklevel=2)


def _never_wait_for(recorder: Recorder) -> None:
    """Leave a recorder as it is until the process ends.

    Rerun waits for a writer that has failed, in its clean-up at exit and when a stream goes away,
    and may do so for ever. So there is no clean-up, and the stream stays.
    """
    rerun = sys.modules.get("rerun")
    if rerun is not None:
        rerun.unregister_shutdown()
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(recorder))


def _size(path: Path) -> int | None:
    """Of a file in bytes; None if it is not there."""
    try:
        return path.stat().st_size
    except OSError:
        return None


def _last_bytes(path: Path) -> bytes:
    with path.open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - _END_SIZE))
        return file.read()
