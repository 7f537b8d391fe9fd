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
from replay.mcap.event_messages import image_values
from replay.mcap.reader import read_recording
from replay.mcap.writer import McapRecorder
from tests.replay.conftest import with_sensors

Write = Callable[[list[Event]], Path]
Same = Callable[[Any, Any], None]


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
        list(read_recording(path).events())
    short = zstandard.compress(bytes(4))
    path = stored(tmp_path / "b.mcap", monkeypatch, few, mask=short)
    with pytest.raises(RecordingError, match=r"have 4 bytes; accepted: 5 for \(5, 7\)"):
        list(read_recording(path).events())
    path = stored(tmp_path / "c.mcap", monkeypatch, few, mask=b"no frame")
    with pytest.raises(RecordingError, match="mask of an image cannot be read"):
        list(read_recording(path).events())


def test_pixels_that_cannot_be_unpacked_are_told_of_when_they_are_read(
    few: list[Event], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = zstandard.compress(np.random.default_rng(0).bytes(70))
    path = stored(tmp_path / "a.mcap", monkeypatch, few, values=whole[:-4])
    recording = read_recording(path)
    assert len(list(recording.events(images=False))) == len(few) - 4
    with pytest.raises(RecordingError, match=r"a\.mcap: values of an image cannot be read"):
        list(recording.events())
    assert main(["info", str(path)]) == 1


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
    assert main(["info", path]) == 0
    shown = " ".join(capsys.readouterr().out.split())  # lines may be broken anywhere
    assert "cabinet, raw log sha256:0a1b" in shown
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
