"""Recorders behind one list: order, errors that reach the caller, and what is on the disk when."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from chsel.errors import RecordingError
from chsel.events import Measured
from replay.files import new_file
from replay.mcap.reader import read_recording
from replay.mcap.writer import McapRecorder
from replay.recorder import Recorders


class Gate:
    """Notes what it gets once its gate is open; fails at the events that `fails_at` names."""

    def __init__(self, *fails_at, is_open=True):
        self.calls: list[object] = []
        self.threads: set[threading.Thread] = set()
        self.gate = threading.Event()
        self._fails_at = fails_at
        if is_open:
            self.gate.set()

    def record(self, event):
        self._note(event)

    def flush(self):
        self._note("flush")

    def close(self):
        self._note("close")

    def _note(self, call):
        assert self.gate.wait(600)
        self.calls.append(call)
        self.threads.add(threading.current_thread())
        if call in self._fails_at:
            raise RecordingError(f"no {call}")


def test_files_and_pictures_get_everything_in_order_at_a_flush():
    file = Gate()
    pictures = Gate(is_open=False)
    recorder = Recorders([file], pictures)
    recorder.record(1)
    recorder.record(2)
    assert file.calls == []
    recorder.flush()
    assert file.calls == [1, 2, "flush"]  # the caller waits for files alone
    assert pictures.calls == []
    recorder.record(3)
    pictures.gate.set()
    recorder.close()
    assert file.calls == pictures.calls == [1, 2, "flush", 3, "close"]
    assert file.threads == {threading.current_thread()}
    assert threading.current_thread() not in pictures.threads


@pytest.mark.parametrize("end", ["flush", "close"])
def test_what_follows_an_event_that_fails_is_dropped(end):
    file = Gate("bad")
    other = Gate()
    recorder = Recorders([file, other])
    for event in ("good", "bad", "dropped"):
        recorder.record(event)
    with pytest.raises(RecordingError, match="no bad"):
        getattr(recorder, end)()
    assert file.calls == ["good", "bad", *(["close"] if end == "close" else [])]
    assert other.calls == ["good", *(["close"] if end == "close" else [])]


@pytest.mark.parametrize("optional", ["", "it can be made anew"])
def test_an_error_of_pictures_is_raised_or_a_warning_and_files_are_closed(optional, recwarn):
    file = Gate()
    pictures = Gate("bad", is_open=False)
    recorder = Recorders([file], pictures, optional=optional)
    for event in ("good", "bad", "dropped"):
        recorder.record(event)
    recorder.flush()
    pictures.gate.set()
    if optional:
        recorder.close()
        assert [str(warning.message) for warning in recwarn] == [f"no bad; {optional}"]
    else:
        with pytest.raises(RecordingError, match="no bad"):
            recorder.close()
    assert pictures.calls == ["good", "bad"]
    assert file.calls == ["good", "bad", "dropped", "flush", "close"]


_SCRIPT = """
import os, runpy, signal, sys
from chsel.events import Recorder
from replay.recorder import Recorders
from replay.mcap.writer import McapRecorder
events = runpy.run_path(sys.argv[1])["example_events"]()
recorder = Recorders([McapRecorder(sys.argv[2])], Recorder())
for event in events:
    recorder.record(event)
    if type(event).__name__ == "Measured":
        recorder.flush()
        break
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_all_that_was_flushed_survives_sigkill(tmp_path, events, assert_same):
    path = tmp_path / "killed.mcap"
    conftest = str(Path(__file__).with_name("conftest.py"))
    command = [sys.executable, "-c", _SCRIPT, conftest, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr
    with pytest.raises(RecordingError, match="is unfinished"):
        read_recording(path)
    recording = read_recording(path, partial=True)
    assert recording.damage == "unfinished"
    last = next(i for i, event in enumerate(events) if isinstance(event, Measured))
    assert_same(recording.events(), events[: last + 1])


def test_a_recording_is_on_the_disk_when_it_is_closed(events, tmp_path, monkeypatch):
    recorder = McapRecorder(tmp_path / "a.mcap")
    synced = []
    monkeypatch.setattr(os, "fsync", lambda number: synced.append(os.fstat(number)))
    recorder.record(events[0])
    recorder.flush()
    assert synced == []  # a step waits for no disk
    recorder.close()
    last = {each.st_ino: each.st_size for each in synced}
    file = (tmp_path / "a.mcap").stat()
    folder = tmp_path.stat()
    assert (last[file.st_ino], folder.st_ino in last) == (file.st_size, True)


def test_a_link_to_nothing_is_not_written_over(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match="link exists"), new_file(tmp_path / "link"):
        pass
