"""The rig and the images of a robot session: written, read, bounded, and never half."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader

from chsel.errors import RecordingError
from replay.__main__ import main
from replay.events import (
    Event,
    Logged,
    RigDescribed,
    SensorImage,
    SessionStarted,
)
from replay.mcap import event_reader
from replay.mcap.encoding import message_class
from replay.mcap.foxglove_messages import FOXGLOVE, VIEWS
from replay.mcap.reader import read_recording
from replay.mcap.recovery import recover
from replay.mcap.schemas import RECORDS, UNSTEERED_VERSION
from replay.mcap.sensor_messages import image_values, plausible_pixels
from replay.mcap.writer import McapRecorder
from tests.replay.conftest import with_sensors
from tests.replay.mcap.test_reader import edited, rewritten

Write = Callable[[list[Event]], Path]
Same = Callable[[Any, Any], None]
STORED = Path(__file__).parents[2] / "replays" / "points_exact_descent.mcap"


@pytest.fixture
def few(make_events: Callable[..., list[Event]]) -> list[Event]:
    """A session of one probe, with sensors."""
    return with_sensors(make_events(steps=1, free=3))


def first(events: list[Event], kind: type) -> int:
    return next(i for i, event in enumerate(events) if isinstance(event, kind))


def changed(events: list[Event], kind: type, /, **values: Any) -> list[Event]:
    """The same events, but for values of the first of a kind."""
    place = first(events, kind)
    return [*events[:place], dataclasses.replace(events[place], **values), *events[place + 1 :]]


def messages(path: Path, topic: str) -> list[bytes]:
    with path.open("rb") as file:
        return [message.data for _, _, message in make_reader(file).iter_messages([topic])]


def version(path: Path) -> int:
    session: Any = message_class("Session").FromString(messages(path, "/session")[0])
    return int(session.format_version)


def topics(path: Path) -> set[str]:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return {channel.topic for channel in summary.channels.values()}


def test_rig_and_images_are_found_by_step(sensor_events: list[Event], write: Write) -> None:
    recording = read_recording(write(sensor_events))
    written = [event for event in sensor_events if isinstance(event, SensorImage)]
    assert recording.rig is not None
    assert (recording.rig.name, recording.rig.source) == ("cabinet", "sha256:0a1b")
    assert recording.image_steps == (0, 1, 2)
    found = list(recording.sensor_images([1]))
    expected = [event for event in written if event.step == 1]
    pair = [("camera", "depth"), ("pad_1", "deformation")]
    assert [(image.sensor, image.kind) for image in found] == pair * 2
    for one, other in zip(found, expected, strict=True):
        assert one.values.tobytes() == other.values.tobytes()
        assert one.mask.tolist() == other.mask.tolist()
        with pytest.raises(ValueError, match="read-only"):
            one.mask[0, 0] = True
    assert len(list(recording.sensor_images())) == len(written) == 12
    assert not any(isinstance(event, SensorImage) for event in recording.events(images=False))
    with pytest.raises(RecordingError, match="no image of a sensor of step 7; accepted: 0, 1, 2"):
        recording.sensor_images([7])


def test_a_rig_without_a_hand_and_images_of_one_pixel_come_back(
    few: list[Event], write: Write, assert_same: Same
) -> None:
    events = changed(few, RigDescribed, hand=None, name="", source="")
    one = np.full((1, 1), 2**16 - 1, dtype=np.uint16)
    events = changed(events, SensorImage, values=one, mask=one > 0, unit=1e-9)
    assert_same(read_recording(write(events)).events(), events)


def test_new_recordings_without_decisions_are_of_one_version_and_older_ones_are_read(
    few: list[Event], write: Write
) -> None:
    bare = write([event for event in few if not isinstance(event, RigDescribed | SensorImage)])
    assert version(bare) == version(write(few)) == UNSTEERED_VERSION
    described = {*RECORDS, *FOXGLOVE} - {"/actions", "/decision", "/next_probe"}
    assert topics(bare) == topics(write(few)) == described
    assert version(STORED) == 1
    copy = write([*read_recording(STORED).events()])
    assert topics(copy) - set(VIEWS) - topics(STORED) == {"/rig", "/sensor_image", "/seal"}
    for name in ("/probe", "/hypotheses"):
        assert messages(copy, name) == messages(STORED, name)


def test_a_reader_of_the_first_version_says_that_it_is_too_old(
    few: list[Event], write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(few)
    monkeypatch.setattr(event_reader, "FORMAT_VERSION", 1)
    with pytest.raises(RecordingError, match="written by a newer version: format 3; this one"):
        read_recording(path)


def test_what_was_flushed_before_the_rig_is_in_the_file_once(
    tmp_path: Path, few: list[Event], assert_same: Same
) -> None:
    """As a run does it, which cannot know at its start that there will be a rig."""
    recorder = McapRecorder(tmp_path / "a.mcap")
    events = [few[0], Logged(-1, "info", "opening"), *few[1:]]
    for event in events:
        recorder.record(event)
        recorder.flush()
    recorder.close()
    assert_same(read_recording(tmp_path / "a.mcap").events(), events)
    assert len(messages(tmp_path / "a.mcap", "/rig")) == 1


def stored(path: Path, monkeypatch: pytest.MonkeyPatch, events: list[Event], **values: Any) -> Path:
    """A recording whose images are stored with other values."""
    monkeypatch.setattr(
        "replay.mcap.event_messages.image_values", lambda event: image_values(event) | values
    )
    recorder = McapRecorder(path)
    for event in events:
        recorder.record(event)
    recorder.close()
    return path


def test_pixels_are_counted_before_they_are_unpacked(
    few: list[Event], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bomb = zstandard.compress(bytes(2**26))
    path = stored(tmp_path / "a.mcap", monkeypatch, few, values=bomb)
    with pytest.raises(RecordingError, match="values of an image of camera have 67108864 bytes"):
        read_recording(path)
    short = zstandard.compress(bytes(4))
    path = stored(tmp_path / "b.mcap", monkeypatch, few, mask=short)
    with pytest.raises(RecordingError, match=r"have 4 bytes; accepted: 5 for \(5, 7\)"):
        read_recording(path)
    path = stored(tmp_path / "c.mcap", monkeypatch, few, mask=b"no frame")
    with pytest.raises(RecordingError, match="accepted: 5 for"):
        read_recording(path)


def test_pixels_that_cannot_be_unpacked_are_told_of_when_they_are_read(
    few: list[Event], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = zstandard.compress(np.random.default_rng(0).bytes(70))
    path = stored(tmp_path / "a.mcap", monkeypatch, few, values=whole[:-4])
    recording = read_recording(path)
    assert len(list(recording.events(images=False))) == len(few) - 4
    with pytest.raises(RecordingError, match=r"a\.mcap: values of an image cannot be read"):
        list(recording.events())
    assert main(["info", str(path), "--check"]) == 1


def test_many_blank_images_are_no_bomb(tmp_path: Path, few: list[Event]) -> None:
    """They compress further than whatever else a recording holds."""
    place = first(few, SensorImage)
    seen = few[place]
    assert isinstance(seen, SensorImage)
    blank = dataclasses.replace(
        seen, values=np.zeros((480, 640), np.uint16), mask=np.zeros((480, 640), bool)
    )
    path = tmp_path / "a.mcap"
    recorder = McapRecorder(path)
    for event in [*few[:place], *[blank] * 100, *few[place:]]:
        recorder.record(event)
    recorder.close()
    assert 100 * blank.values.nbytes > 16 * 2**20 + 100 * path.stat().st_size
    assert len(list(read_recording(path).sensor_images([0]))) == 104


def test_images_have_no_more_pixels_than_can_be_looked_at(
    few: list[Event], write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(few)
    monkeypatch.setattr("replay.mcap.event_reader.plausible_pixels", lambda size: 4 * 35 - 1)
    with pytest.raises(RecordingError, match="its images have more pixels than a file of its size"):
        read_recording(path)
    monkeypatch.setattr("replay.mcap.event_reader.plausible_pixels", lambda size: 4 * 35)
    assert len(list(read_recording(path).sensor_images())) == 4
    assert plausible_pixels(0) > 3000 * 480 * 640


def test_the_first_version_has_no_rig(few: list[Event], write: Write) -> None:
    def older(name: str, data: bytes) -> bytes | None:
        return None if name == "/seal" else edited("/session", format_version=1)(name, data)

    with pytest.raises(RecordingError, match="a message on /rig is out of place"):
        read_recording(rewritten(write(few), older))


def flushed(path: Path, events: list[Event]) -> bytes:
    """A recording with a chunk for each probe and its images, as a session leaves it."""
    recorder = McapRecorder(path)
    step = -1
    for event in events:
        if getattr(event, "step", -1) != step:
            step = getattr(event, "step", -1)
            recorder.flush()
        recorder.record(event)
    recorder.close()
    return path.read_bytes()


def damaged(path: Path, data: bytes, topic: str, number: int) -> Path:
    """The file with a flipped bit in one of the chunks that have messages on a topic."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    (channel,) = [c.id for c in summary.channels.values() if c.topic == topic]
    chunks = [c for c in summary.chunk_indexes if channel in c.message_index_offsets]
    middle = chunks[number].chunk_start_offset + chunks[number].chunk_length // 2
    changed_data = data[:middle] + bytes([data[middle] ^ 16]) + data[middle + 1 :]
    other = path.with_suffix(f".damaged{path.suffix}")
    other.write_bytes(changed_data)
    return other


def test_images_survive_around_a_damaged_chunk(
    sensor_events: list[Event], tmp_path: Path, assert_same: Same
) -> None:
    path = tmp_path / "a.mcap"
    data = flushed(path, sensor_events)
    found = recover(damaged(path, data, "/sensor_image", 1), tmp_path / "out.mcap")
    kept = list(read_recording(tmp_path / "out.mcap").events())
    assert found.images == 8
    assert found.lost_probes == [(1, 1)]
    expected = [e for e in sensor_events if isinstance(e, SensorImage) and e.step != 1]
    assert_same([e for e in kept if isinstance(e, SensorImage)], expected)
    assert isinstance(kept[1], RigDescribed)


def test_images_without_their_rig_are_told_of_once(
    sensor_events: list[Event], tmp_path: Path
) -> None:
    path, out = tmp_path / "a.mcap", tmp_path / "out.mcap"
    data = flushed(path, sensor_events)
    found = recover(damaged(path, data, "/rig", 0), out)
    assert found.images == 0
    assert found.probes == [0, 1, 2]
    assert found.events == ["all images of sensors: their rig was lost before"]
    assert not messages(out, "/rig")


def test_a_whole_recording_with_sensors_is_copied(
    sensor_events: list[Event],
    tmp_path: Path,
    assert_same: Same,
    capsys: pytest.CaptureFixture[str],
) -> None:
    flushed(tmp_path / "a.mcap", sensor_events)
    out = tmp_path / "out.mcap"
    assert main(["recover", str(tmp_path / "a.mcap"), "-o", str(out)]) == 0
    assert "2 results, 12 images\n" in capsys.readouterr().out
    assert_same(read_recording(out).events(), sensor_events)


def test_a_file_that_changes_while_it_is_read_is_told_of(few: list[Event], write: Write) -> None:
    path = write(few)
    recording = read_recording(path)
    events = recording.events()
    assert isinstance(next(events), SessionStarted)
    other = write([event for event in few if not isinstance(event, SensorImage)])
    path.write_bytes(other.read_bytes())
    with pytest.raises(RecordingError, match="has changed while it was read"):
        list(events)


def test_info_tells_of_the_rig(
    few: list[Event], write: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(write(few))
    for more in ([], ["--check"]):
        assert main(["info", path, *more]) == 0
        shown = " ".join(capsys.readouterr().out.split())  # lines may be broken anywhere
        assert "cabinet, raw log sha256:0a1b" in shown
        assert "version 3" in shown
    assert "4 /sensor_image" in shown


def test_diff_tells_which_sensor_saw_something_else(
    few: list[Event], write: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    seen = few[first(few, SensorImage)]
    assert isinstance(seen, SensorImage)
    values = seen.values.copy()
    values[2, 3] += 1
    other = changed(few, SensorImage, values=values)
    assert main(["diff", str(write(few)), str(write(other))]) == 1
    assert "/sensor_image, step 0, camera: values: 1 of 35 entries" in capsys.readouterr().out
