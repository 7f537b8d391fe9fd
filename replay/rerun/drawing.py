"""The Rerun recording made anew, from the events of a recording alone."""

from __future__ import annotations

from pathlib import Path

from chsel.errors import RecordingError
from replay.events import Probe
from replay.mcap.reader import Recording
from replay.rerun.recorder import RerunRecorder


def draw_recording(recording: Recording, path: Path, *, last: int | None = None) -> None:
    """Write to `path`, a new file, what the run wrote beside its MCAP file.

    last: the last probe that is drawn, where the viewer opens; None: all are, and the viewer opens
    at the first registration.
    Raises RecordingError if the file exists, cannot be written, or a problem of the recording is
    not the recorded one; nothing is left of the file then.
    """
    check_new(path)
    recorder = RerunRecorder(path, follow=last is not None)
    try:
        try:
            for event in recording.events():
                if last is not None and getattr(event, "step", last) > last:
                    break
                if isinstance(event, Probe):
                    recorder.flush()
                recorder.record(event)
        finally:
            recorder.close()
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def check_new(path: Path) -> None:
    """Raise RecordingError if there is something at `path` already."""
    if path.exists() or path.is_symlink():
        raise RecordingError(f"{path} exists; accepted: a new .rrd file")
