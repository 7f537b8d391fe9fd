"""What cannot be recorded changes nothing; a full disk loses the recording alone; threads wait."""

import threading
import warnings

import numpy as np
import pytest

import chsel
from chsel import events
from chsel.errors import RecordingError
from replay.comparing.verification import EQUAL, verify
from replay.mcap.reader import read_recording
from replay.mcap.writer import McapRecorder
from tests.chsel.session.test_session import BOX, CAMERA, CONTACTS, HAND, LOOK

QUICK = {"settings": {"size": "small"}, "hand": HAND}
ROOM = chsel.Workspace((0.2, -0.1, 0.0), (0.6, 0.3, 0.3))
DEPTH = np.full((60, 80), 0.35)
IMAGE = {"depth": DEPTH, "camera": CAMERA, "world_from_camera": LOOK}


class Refusing(McapRecorder):
    """Refuses the next event of a kind, as if it had a value that the format has no place for."""

    refused: type | None = None

    def check(self, event):
        if self.refused is not None and isinstance(event, self.refused):
            raise RecordingError(f"no {type(event).__name__}")
        super().check(event)


def state(session):
    """What the calls of a session can see."""
    parts = (session.step, session.started.workspace, session.stop, session.warnings[:])
    answer = None if session.answer is None else session.answer.digest
    return *parts, session.points.digest, answer


def full(*_, **__):
    raise OSError(28, "No space left on device")


CALLS = (
    (events.SessionStarted, "add"),
    (events.Probe, "add"),
    (events.SensorImage, "look"),
    (events.ProblemPosed, "register"),
    (events.HypothesesFound, "register"),
    (events.Measured, "register"),
    (events.ActionsOffered, "next_probe"),
    (events.Decided, "next_probe"),
    (events.Believed, "register"),
)


@pytest.mark.parametrize(("kind", "refused"), CALLS, ids=[kind.__name__ for kind, _ in CALLS])
def test_what_a_recorder_refuses_is_an_error_before_anything_changes(tmp_path, kind, refused):
    path = tmp_path / "touches.mcap"
    recorder = Refusing(path)
    session = chsel.Session(BOX, record=recorder, **QUICK)
    calls = {
        "add": lambda: session.add(contacts=CONTACTS),
        "look": lambda: session.add(**IMAGE),
        "register": session.register,
        "next_probe": session.next_probe,
    }
    for name, call in calls.items():
        if name == refused:
            before = state(session)
            recorder.refused = kind
            with pytest.raises(RecordingError, match=f"no {kind.__name__}"):
                call()
            recorder.refused = None
            assert state(session)[:-1] == before[:-1] or name == "register"
            if name == "register":  # as after any other failure: until something is added
                session.add(**IMAGE)
        call()
    session.close()
    recording = read_recording(path)
    assert len(recording.probes) == session.step + 1
    verdicts = [verdict.outcome for verdict in verify(recording)]
    assert verdicts.count(EQUAL) == 2  # of the registration, and of the decision


def test_after_a_full_disk_the_session_goes_on_in_memory(tmp_path, monkeypatch):
    path = tmp_path / "touches.mcap"
    session = chsel.Session(BOX, record=path, seed=3, **QUICK)
    session.add(contacts=CONTACTS[:10])

    monkeypatch.setattr("mcap.writer.Writer.add_message", full)
    with pytest.raises(RecordingError, match=r"touches.mcap cannot be written: No space .*nothing"):
        session.add(contacts=CONTACTS[10:])
    monkeypatch.undo()
    found = session.register()  # of all points, and without another error
    whole = chsel.Session(BOX, seed=3, **QUICK)
    whole.add(contacts=CONTACTS[:10])
    whole.add(contacts=CONTACTS[10:])
    assert found.digest == whole.register().digest
    session.next_probe()
    whole.next_probe()
    assert session.stop == whole.stop
    session.close()
    partial = read_recording(path, partial=True)
    assert [probe.contacts.tolist() for probe in partial.probes] == [CONTACTS[:10].tolist()]


def test_a_disk_that_is_full_during_a_registration_loses_no_result(tmp_path, monkeypatch):
    session = chsel.Session(BOX, record=tmp_path / "touches.mcap", **QUICK)
    session.add(contacts=CONTACTS)
    monkeypatch.setattr("mcap.writer.Writer.add_message", full)
    with pytest.raises(RecordingError, match="cannot be written"):
        session.register()
    whole = chsel.Session(BOX, **QUICK)
    whole.add(contacts=CONTACTS)
    assert session.register().digest == whole.register().digest
    session.close()


def test_threads_that_add_to_one_session_lose_nothing(tmp_path):
    path = tmp_path / "touches.mcap"
    session = chsel.Session(BOX, record=path, workspace=ROOM, **QUICK)
    start = threading.Barrier(3)
    failures = []

    def in_thread(call, times):
        def run():
            start.wait()
            try:
                for n in range(times):
                    call(n)
            except Exception as error:
                failures.append(error)

        return threading.Thread(target=run)

    threads = [
        in_thread(lambda n: session.add(contacts=CONTACTS[n : n + 1]), 20),
        in_thread(lambda _: session.add(**IMAGE), 20),
        in_thread(lambda _: session.step < 0 or session.register(), 5),
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        session.close()
    assert failures == []
    recording = read_recording(path)
    assert [probe.step for probe in recording.probes] == list(range(40))
    contacts = np.concatenate([probe.contacts for probe in recording.probes])
    np.testing.assert_array_equal(contacts, CONTACTS)
    assert all(verdict.outcome == EQUAL for verdict in verify(recording))


def test_a_text_that_no_recording_can_hold_does_not_hide_the_programs_error(tmp_path):
    path = tmp_path / "touches.mcap"
    with pytest.raises(ValueError, match="arm"), chsel.Session(BOX, record=path):
        raise ValueError("the \x1b[31marm\x1b[0m stopped")
    assert (
        read_recording(path).ended.outcome == r"failed: ValueError: the \x1b[31marm\x1b[0m stopped"
    )
