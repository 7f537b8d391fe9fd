"""Recorders that hand on or ignore what they get."""

from __future__ import annotations

import pytest

from chsel.errors import RecordingError
from replay.recorder import NullRecorder, TeeRecorder


class Listing:
    """Notes what is asked of it; fails at what it is told to."""

    def __init__(self, fails_at: str = "") -> None:
        self.calls: list = []
        self.fails_at = fails_at

    def record(self, event) -> None:
        self._note(event)

    def flush(self) -> None:
        self._note("flush")

    def close(self) -> None:
        self._note("close")

    def _note(self, call) -> None:
        self.calls.append(call)
        if call == self.fails_at:
            raise RecordingError(f"no {call}")


def test_a_tee_hands_everything_to_all_in_order():
    listings = [Listing(), Listing()]
    tee = TeeRecorder(listings)
    for event in ("first", "second"):
        tee.record(event)
    tee.flush()
    tee.close()
    assert [listing.calls for listing in listings] == [["first", "second", "flush", "close"]] * 2


@pytest.mark.parametrize("call", ["flush", "close"])
def test_a_tee_reaches_all_even_if_one_fails(call):
    listings = [Listing(fails_at=call), Listing()]
    with pytest.raises(RecordingError, match=f"no {call}"):
        getattr(TeeRecorder(listings), call)()
    assert [listing.calls for listing in listings] == [[call], [call]]


def test_nothing_comes_of_a_null_recorder(events, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    recorder = NullRecorder()
    for event in events:
        recorder.record(event)
    recorder.flush()
    recorder.close()
    assert list(tmp_path.iterdir()) == []
