"""A recorder whose file is taken away, and a recovery onto a disk that is full."""

from __future__ import annotations

import resource
import shutil
import signal
from pathlib import Path

import pytest

from chsel.errors import RecordingError
from replay.events import Event, Measured
from replay.mcap.reader import read_recording
from replay.mcap.recovery import recover
from replay.mcap.writer import McapRecorder


@pytest.mark.parametrize("removed", ["file", "folder"])
def test_a_removed_recording_is_told_at_the_next_flush(
    tmp_path: Path, events: list[Event], removed: str
) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    recorder = McapRecorder(folder / "recording.mcap")
    recorder.record(events[0])
    recorder.flush()
    if removed == "folder":
        shutil.rmtree(folder)
    else:
        (folder / "recording.mcap").unlink()
    recorder.record(events[1])
    with pytest.raises(RecordingError, match=r"recording\.mcap was removed while it was written"):
        recorder.flush()
    with pytest.raises(RecordingError, match="is closed"):
        recorder.record(events[2])


def test_a_recording_removed_before_its_end_is_told(tmp_path: Path, events: list[Event]) -> None:
    recorder = McapRecorder(tmp_path / "recording.mcap")
    for event in events:
        recorder.record(event)
    (tmp_path / "recording.mcap").unlink()
    with pytest.raises(RecordingError, match="was removed while it was written"):
        recorder.close()
    recorder.close()
    assert list(tmp_path.iterdir()) == []


def test_a_recording_that_is_renamed_goes_on(
    tmp_path: Path, events: list[Event], assert_same
) -> None:
    recorder = McapRecorder(tmp_path / "recording.mcap")
    for event in events:
        recorder.record(event)
        if isinstance(event, Measured) and event.step == 1:
            recorder.flush()
            (tmp_path / "recording.mcap").rename(tmp_path / "renamed.mcap")
    recorder.close()
    assert_same(read_recording(tmp_path / "renamed.mcap").events(), events)


def test_a_recovery_onto_a_full_disk_leaves_nothing(tmp_path: Path, events: list[Event]) -> None:
    path, out = tmp_path / "recording.mcap", tmp_path / "out.mcap"
    recorder = McapRecorder(path)
    for event in events:
        recorder.record(event)
    recorder.close()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))
    try:
        with pytest.raises(RecordingError, match="cannot be written: File too large"):
            recover(path, out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert signal.getsignal(signal.SIGXFSZ) == signal.SIG_IGN
    assert list(tmp_path.iterdir()) == [path]
