"""Rerun recordings that are written in one go, such as views of what is recorded already."""

from __future__ import annotations

from pathlib import Path

import rerun as rr

from chsel.errors import RecordingError
from replay.rerun.drawing import check_new


def new_file_stream(path: Path, application: str) -> rr.RecordingStream:
    """A stream into a new .rrd, without clocks. Raises RecordingError if it cannot be written."""
    check_new(path)
    stream = rr.RecordingStream(application, send_properties=False)
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    try:
        stream.set_sinks(rr.FileSink(path))
    except (OSError, RuntimeError) as error:
        raise RecordingError(f"{path} cannot be written ({error}); accepted: a new .rrd") from None
    return stream
