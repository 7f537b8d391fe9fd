"""The chain of recorders: order, the same files, errors that reach the caller, a bounded queue."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from chsel.errors import RecordingError
from replay.events import Measured, Probe
from replay.mcap.reader import read_recording
from replay.mcap.writer import McapRecorder
from replay.recorder import BackgroundRecorder, DeferredRecorder, NullRecorder, TeeRecorder


class Gate:
    """Notes what it gets once its gate is open; fails at the events that `fails_at` names."""

    def __init__(self, *fails_at: object, is_open: bool = True) -> None:
        self.calls: list[object] = []
        self.threads: set[str] = set()
        self.gate = threading.Event()
        self.entered = threading.Event()
        self._fails_at = fails_at
        if is_open:
            self.gate.set()

    def record(self, event: object) -> None:
        self._note(event)

    def record_later(self, make: Callable[[], object]) -> None:
        self._note(make())

    def flush(self) -> None:
        self._note("flush")

    def close(self) -> None:
        self._note("close")

    def _note(self, call: object) -> None:
        self.entered.set()
        assert self.gate.wait(60)
        self.calls.append(call)
        self.threads.add(threading.current_thread().name)
        if call in self._fails_at:
            raise RecordingError(f"no {call}")


def test_a_tee_hands_everything_to_all_in_order():
    gates = [Gate(), Gate()]
    tee = TeeRecorder(gates)
    for event in ("first", "second"):
        tee.record(event)
    tee.flush()
    tee.close()
    assert [gate.calls for gate in gates] == [["first", "second", "flush", "close"]] * 2


@pytest.mark.parametrize("call", ["flush", "close"])
def test_a_tee_reaches_all_even_if_one_fails(call):
    gates = [Gate(call), Gate()]
    with pytest.raises(RecordingError, match=f"no {call}"):
        getattr(TeeRecorder(gates), call)()
    assert [gate.calls for gate in gates] == [[call], [call]]


def record_often(recorder: BackgroundRecorder, event: object) -> None:
    for _ in range(10_000):
        recorder.record(event)


def test_the_caller_goes_on_while_an_event_is_recorded():
    gate = Gate(is_open=False)
    recorder = BackgroundRecorder(gate)
    recorder.record("first")
    recorder.record("second")
    assert gate.calls == []
    gate.gate.set()
    recorder.close()
    assert gate.calls == ["first", "second", "close"]
    assert "recorder" in gate.threads


def test_a_flush_in_the_background_comes_soon_and_keeps_nobody_waiting():
    gate = Gate(is_open=False)
    recorder = BackgroundRecorder(gate)
    recorder.record("first")
    recorder.flush()
    assert gate.calls == []
    gate.gate.set()
    recorder.close()
    assert gate.calls == ["first", "flush", "close"]


def test_who_records_faster_than_the_recorder_has_to_wait():
    gate = Gate(is_open=False)
    recorder = BackgroundRecorder(gate, most=3)
    recorder.record("in work")
    assert gate.entered.wait(60)
    for event in range(3):
        recorder.record(event)
    fifth = threading.Thread(target=recorder.record, args=("fifth",))
    fifth.start()
    fifth.join(0.2)
    assert fifth.is_alive()
    gate.gate.set()
    fifth.join(60)
    recorder.close()
    assert gate.calls == ["in work", 0, 1, 2, "fifth", "close"]


def test_deferred_events_are_recorded_by_a_flush_or_when_there_are_too_many():
    gate = Gate()
    recorder = DeferredRecorder(gate, most=3)
    recorder.record(0)
    recorder.record_later(lambda: 1)
    assert gate.calls == []
    recorder.flush()
    assert gate.calls == [0, 1, "flush"]
    for event in range(3):
        recorder.record(event)
    assert gate.calls[3:] == []
    recorder.record(3)
    assert gate.calls[3:] == [0, 1, 2, 3]
    recorder.record(4)
    recorder.close()
    assert gate.calls[7:] == [4, "close"]
    assert gate.threads == {threading.current_thread().name}


@pytest.mark.parametrize("end", ["flush", "close"])
def test_what_follows_a_deferred_event_that_fails_is_dropped(end):
    gate = Gate("bad")
    recorder = DeferredRecorder(gate)
    for event in ("good", "bad", "dropped"):
        recorder.record(event)
    with pytest.raises(RecordingError, match="no bad"):
        getattr(recorder, end)()
    assert gate.calls == ["good", "bad", *(["close"] if end == "close" else [])]
    recorder.record("after")
    recorder.close()
    assert gate.calls[2:] == ["after", "close"] if end == "flush" else ["close", "after", "close"]


def test_an_event_for_later_is_made_once():
    gates, made = [Gate(), Gate()], []
    background = BackgroundRecorder(gates[1])
    tee = TeeRecorder([DeferredRecorder(gates[0]), DeferredRecorder(background)])

    def make() -> int:
        made.append(1)
        return 1

    tee.record(0)
    tee.record_later(make)
    tee.record(2)
    tee.flush()
    tee.close()
    assert [gate.calls for gate in gates] == [[0, 1, 2, "flush", "close"]] * 2
    assert made == [1]


def test_an_event_for_later_is_made_by_the_thread():
    makers = []
    recorder = BackgroundRecorder(Gate())
    recorder.record_later(lambda: makers.append(threading.current_thread()))
    recorder.close()
    assert len(makers) == 1
    assert makers[0] is not threading.current_thread()


def test_an_event_for_later_is_not_made_where_nobody_records():
    for recorder in (NullRecorder(), TeeRecorder([])):
        recorder.record_later(lambda: pytest.fail("it is made"))


@pytest.mark.parametrize("kind", [BackgroundRecorder, DeferredRecorder])
def test_equal_events_give_the_bytes_of_a_recorder_alone(tmp_path, events, write, kind):
    path = tmp_path / "later.mcap"
    recorder = kind(McapRecorder(path))
    for event in events:
        recorder.record(event)
    recorder.close()
    assert path.read_bytes() == write(events).read_bytes()


def test_an_error_is_told_by_the_next_call_and_what_follows_it_is_dropped():
    gate = Gate("bad", is_open=False)
    recorder = BackgroundRecorder(gate)
    for event in ("good", "bad", "dropped", "dropped"):
        recorder.record(event)
    gate.gate.set()
    with pytest.raises(RecordingError, match="no bad"):
        record_often(recorder, "dropped")
    recorder.record("after")
    recorder.close()
    assert gate.calls == ["good", "bad", "after", "close"]


def test_an_error_that_is_known_is_told_before_another_event_is_taken():
    gate = Gate("bad")
    recorder = BackgroundRecorder(gate)
    with pytest.raises(RecordingError, match="no bad"):
        record_often(recorder, "bad")  # the queue is bounded, so the error must come
    recorder.close()
    assert gate.calls == ["bad", "close"]


@pytest.mark.parametrize("also", [(), ("close",)])  # of two errors the first is raised
def test_an_error_is_raised_at_close_at_the_latest_and_all_is_closed(also):
    gate = Gate("bad", *also, is_open=False)
    recorder = BackgroundRecorder(gate)
    recorder.record("bad")
    gate.gate.set()
    with pytest.raises(RecordingError, match="no bad"):
        recorder.close()
    assert gate.calls == ["bad", "close"]
    recorder.close()


def test_what_is_optional_ends_with_a_warning(recwarn):
    gate = Gate("bad")
    recorder = BackgroundRecorder(gate, optional="it can be made anew")
    for event in ("good", "bad", "dropped"):
        recorder.record(event)
    recorder.flush()
    recorder.close()
    assert gate.calls == ["good", "bad"]
    assert [str(warning.message) for warning in recwarn] == ["no bad; it can be made anew"]


def test_closing_twice_is_closing_once_and_ends_the_thread(tmp_path, events):
    path = tmp_path / "recording.mcap"
    before = threading.active_count()
    recorder = BackgroundRecorder(McapRecorder(path))
    recorder.record(events[0])
    recorder.close()
    assert threading.active_count() == before
    closed = path.read_bytes()
    recorder.close()
    recorder.flush()
    assert path.read_bytes() == closed
    with pytest.raises(RecordingError, match="closed"):
        recorder.record(events[1])


_SCRIPT = """
import runpy, sys
from replay.recorder import BackgroundRecorder, DeferredRecorder, NullRecorder, TeeRecorder
from replay.mcap.writer import McapRecorder
events = runpy.run_path(sys.argv[1])["example_events"]()
file = DeferredRecorder(McapRecorder(sys.argv[2]))
recorder = TeeRecorder([file, BackgroundRecorder(NullRecorder())])
for event in events:
    recorder.record(event)
    if type(event).__name__ == "Measured":
        recorder.flush()
        break
"""


def run_script(end: str, path: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", _SCRIPT + end, str(Path(__file__).with_name("conftest.py"))]
    return subprocess.run(
        [*command, str(path)], capture_output=True, text=True, timeout=120, check=False
    )


@pytest.mark.skipif(os.name == "nt", reason="there is no SIGKILL on Windows")
def test_all_that_was_flushed_survives_sigkill(tmp_path, events, assert_same):
    path = tmp_path / "killed.mcap"
    done = run_script("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", path)
    assert done.returncode == -signal.SIGKILL, done.stderr
    last = next(i for i, event in enumerate(events) if isinstance(event, Measured))
    assert_same(read_recording(path, partial=True).events(), events[: last + 1])


def test_a_run_that_dies_ends_and_leaves_what_was_flushed(tmp_path, events):
    path = tmp_path / "died.mcap"
    done = run_script("raise ValueError('died')", path)
    assert done.returncode == 1
    assert "ValueError: died" in done.stderr
    recording = read_recording(path, partial=True)
    assert recording.steps == (1,)
    probes = [event for event in events if isinstance(event, Probe)]
    assert [probe.step for probe in recording.probes] == [probe.step for probe in probes[:2]]
