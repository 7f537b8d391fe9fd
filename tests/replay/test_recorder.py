"""Recorders behind one list: order, the same files, errors that reach the caller."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from chsel.errors import RecordingError
from replay.events import Measured
from replay.mcap.reader import read_recording
from replay.recorder import Recorders


class Gate:
    """Notes what it gets once its gate is open; fails at the events that `fails_at` names."""

    def __init__(self, *fails_at: object, is_open: bool = True) -> None:
        self.calls: list[object] = []
        self.threads: set[threading.Thread] = set()
        self.gate = threading.Event()
        self._fails_at = fails_at
        if is_open:
            self.gate.set()

    def record(self, event: object) -> None:
        self._note(event)

    def flush(self) -> None:
        self._note("flush")

    def close(self) -> None:
        self._note("close")

    def _note(self, call: object) -> None:
        assert self.gate.wait(60)
        self.calls.append(call)
        self.threads.add(threading.current_thread())
        if call in self._fails_at:
            raise RecordingError(f"no {call}")


def test_files_and_pictures_get_everything_in_order_at_a_flush():
    file, pictures = Gate(), Gate(is_open=False)
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


def test_who_records_faster_than_the_pictures_are_drawn_has_to_wait():
    pictures = Gate(is_open=False)
    recorder = Recorders([], pictures)

    def record() -> None:
        for event in range(1000):
            recorder.record(event)

    caller = threading.Thread(target=record)
    caller.start()
    caller.join(0.2)
    assert caller.is_alive()
    pictures.gate.set()
    caller.join(60)
    recorder.close()
    assert pictures.calls == [*range(1000), "close"]


@pytest.mark.parametrize("end", ["flush", "close"])
def test_what_follows_an_event_that_fails_is_dropped(end):
    file, other = Gate("bad"), Gate()
    recorder = Recorders([file, other])
    for event in ("good", "bad", "dropped"):
        recorder.record(event)
    with pytest.raises(RecordingError, match="no bad"):
        getattr(recorder, end)()
    assert file.calls == ["good", "bad", *(["close"] if end == "close" else [])]
    assert other.calls == ["good", *(["close"] if end == "close" else [])]


def test_an_error_of_pictures_reaches_the_caller_and_files_are_closed():
    file, pictures = Gate(), Gate("bad", is_open=False)
    recorder = Recorders([file], pictures)
    for event in ("good", "bad", "dropped"):
        recorder.record(event)
    recorder.flush()
    pictures.gate.set()
    with pytest.raises(RecordingError, match="no bad"):
        recorder.close()
    assert pictures.calls == ["good", "bad"]
    assert file.calls == ["good", "bad", "dropped", "flush", "close"]


def test_pictures_that_are_optional_end_with_a_warning(recwarn):
    file, pictures = Gate(), Gate("bad")
    recorder = Recorders([file], pictures, optional="it can be made anew")
    for event in ("good", "bad", "dropped"):
        recorder.record(event)
    recorder.flush()
    recorder.close()
    assert pictures.calls == ["good", "bad"]
    assert file.calls[-1] == "close"
    assert [str(warning.message) for warning in recwarn] == ["no bad; it can be made anew"]


_SCRIPT = """
import runpy, sys
from replay.events import Recorder
from replay.recorder import Recorders
from replay.mcap.writer import McapRecorder
events = runpy.run_path(sys.argv[1])["example_events"]()
recorder = Recorders([McapRecorder(sys.argv[2])], Recorder())
for event in events:
    recorder.record(event)
    if type(event).__name__ == "Measured":
        recorder.flush()
        break
"""


def run_script(end: str, path: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", _SCRIPT + end, str(Path(__file__).with_name("conftest.py"))]
    return subprocess.run([*command, str(path)], capture_output=True, text=True, check=False)


@pytest.mark.skipif(os.name == "nt", reason="there is no SIGKILL on Windows")
def test_all_that_was_flushed_survives_sigkill(tmp_path, events, assert_same):
    path = tmp_path / "killed.mcap"
    done = run_script("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", path)
    assert done.returncode == -signal.SIGKILL, done.stderr
    last = next(i for i, event in enumerate(events) if isinstance(event, Measured))
    assert_same(read_recording(path, partial=True).events(), events[: last + 1])
