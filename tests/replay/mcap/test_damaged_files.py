"""Whatever damage a file takes: one clear error, or what the original says, in bounded time."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from chsel.errors import RecordingError, SessionError
from replay.events import Event, Logged, Probe, SessionEnded
from replay.mcap.log_file import RawFile, RawMessage
from replay.mcap.reader import read_recording
from replay.mcap.recovery import recover, tells_loss
from replay.verbs.info import log_info, recording_info
from tests.replay.conftest import example_events, same_bits
from tests.runners.sensors.small_logs import ros2_sent, write_ros2
from tests.tools.small_recordings import write_recording

T = TypeVar("T")
PAGE = 4096
examples = settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.data_too_large],
)


@dataclass(repr=False)
class Original:
    """A file that is whole: its bytes, those of its chunks, and what it says."""

    data: bytes
    chunks: list[bytes]
    events: Sequence[Event] = ()
    messages: Counter[RawMessage] | None = None


@st.composite
def damages(draw: st.DrawFn) -> Callable[[bytes], bytes]:
    """Up to three damages: bits flipped, bytes zeroed, removed or put in, or all cut off."""
    kinds = st.sampled_from(["flip", "flip", "zero", "remove", "insert", "cut"])
    lengths = st.sampled_from([1, 4, 60, 300, PAGE])
    places = st.floats(0.0, 1.0, exclude_max=True)
    ends = st.floats(0.97, 1.0, exclude_max=True)
    drawn = draw(
        st.lists(st.tuples(kinds, places | places | ends, lengths), min_size=1, max_size=3)
    )

    def damage(data: bytes) -> bytes:
        for kind, place, length in drawn:
            if not data:
                break
            start = int(place * len(data))
            part = data[start : start + length]
            replaced = {
                "flip": bytes([part[0] ^ (1 << length % 8)]) + part[1:],
                "zero": bytes(len(part)),
                "remove": b"",
                "insert": b"\x06" * length + part,
                "cut": b"",
            }[kind]
            data = data[:start] + replaced + (b"" if kind == "cut" else data[start + length :])
        return data

    return damage


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Original:
    """A recording with a chunk for each of six probes."""
    path = tmp_path_factory.mktemp("whole") / "whole.mcap"
    events = example_events(steps=6, free=400)
    for at in range(len(events) - 1, 0, -1):
        if isinstance(events[at], Probe):
            events.insert(at, Logged(events[at].step - 1, "info", "a chunk ends here"))
    data = write_recording(path, events)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    starts = [index.chunk_start_offset for index in summary.chunk_indexes]
    lengths = [index.chunk_length for index in summary.chunk_indexes]
    chunks = [data[start : start + n] for start, n in zip(starts, lengths, strict=True)]
    return Original(data, chunks, list(read_recording(path).events()))


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Original:
    path = tmp_path_factory.mktemp("log") / "whole.mcap"
    data = write_ros2(path, ros2_sent(8), chunk_size=1500)
    return Original(data, [], messages=Counter(messages_of(path)))


def messages_of(path: Path) -> Iterator[RawMessage]:
    return RawFile(path).messages(None, lambda fault: None)


def answer(path: Path, question: Callable[[], T]) -> T | str:
    """What comes back, or the text of an error, which has to name the file on one line."""
    try:
        return question()
    except (RecordingError, SessionError) as error:
        text = str(error)
    assert str(path) in text
    assert "\n" not in text
    return text


def events_of(path: Path, *, partial: bool) -> list[Event]:
    return list(read_recording(path, partial=partial).events())


def same(read: Sequence[Event], written: Sequence[Event]) -> bool:
    return len(read) == len(written) and all(map(same_bits, read, written))


@examples
@given(damage=damages())
def test_reading_a_damaged_recording(
    tmp_path: Path, original: Original, damage: Callable[[bytes], bytes]
) -> None:
    """All of it, or an error; what is read up to the damage is how it began."""
    path = tmp_path / "damaged.mcap"
    path.write_bytes(damage(original.data))
    events = answer(path, lambda: events_of(path, partial=False))
    assert isinstance(events, str) or same(events, original.events)
    begin = answer(path, lambda: events_of(path, partial=True))
    assert isinstance(begin, str) or same(begin, original.events[: len(begin)])
    info = answer(path, lambda: recording_info(path))
    if not isinstance(info, str):
        json.dumps(info, allow_nan=False)


@examples
@given(damage=damages())
def test_recovering_a_damaged_recording(
    tmp_path: Path, original: Original, damage: Callable[[bytes], bytes]
) -> None:
    """The chunks before the damage come back at least, and nothing that was not there."""
    path, out = tmp_path / "damaged.mcap", tmp_path / "out.mcap"
    out.unlink(missing_ok=True)
    data = damage(original.data)
    path.write_bytes(data)
    found = answer(path, lambda: recover(path, out))
    if isinstance(found, str):
        assert not out.exists()
        return
    assert path.read_bytes() == data
    kept = [event for event in read_recording(out).events() if not tells_loss(event)]
    if isinstance(kept[-1], SessionEnded) and "recovered: " in kept[-1].outcome:
        del kept[-1]
    left = iter(original.events)
    for event in kept:
        assert any(same_bits(event, written) for written in left), event
    assert found.lost or found.damage is not None or same(kept, original.events)


@examples
@given(damage=damages())
def test_reading_a_damaged_log(
    tmp_path: Path, log: Original, damage: Callable[[bytes], bytes]
) -> None:
    """No message that was not there, and a fault for every one that is missing."""
    path = tmp_path / "damaged.mcap"
    path.write_bytes(damage(log.data))
    faults: list[str] = []
    assert log.messages is not None
    file = answer(path, lambda: RawFile(path))
    if isinstance(file, str):
        assert "is not an MCAP file" in file
        return
    messages = Counter(file.messages(None, faults.append))
    assert messages <= log.messages
    assert messages == log.messages or faults
    info = log_info(path)
    json.dumps(info, allow_nan=False)
    assert sum(topic["count"] for topic in info["topics"]) <= log.messages.total()
