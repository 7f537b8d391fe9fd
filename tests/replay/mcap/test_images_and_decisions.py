"""Decisions in recordings: what is written is read, and nothing else is accepted."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard

from chsel.errors import ChselError, RecordingError, SettingError
from chsel.next_probe.decision_problem import HandShape
from replay.events import (
    ActionsOffered,
    Decided,
    Event,
    Measured,
    Probe,
    ProblemPosed,
    SensorImage,
)
from replay.mcap.event_messages import image_values
from replay.mcap.reader import read_recording
from replay.mcap.writer import McapRecorder
from tests.replay.conftest import with_sensors


def changed(events: list[Event], **values: Any) -> list[Event]:
    """With other values in the decision after step 0."""
    return [
        dataclasses.replace(event, decision=dataclasses.replace(event.decision, **values))
        if isinstance(event, Decided) and event.step == 0
        else event
        for event in events
    ]


def test_a_recording_gives_actions_and_decisions_back(steered_events, write, assert_same):
    recording = read_recording(write(steered_events))
    assert recording.decision_steps == (-1, 0, 1, 2)
    written = [event for event in steered_events if isinstance(event, Decided | ActionsOffered)]
    read = [recording.offered, *map(recording.decision, recording.decision_steps)]
    assert_same(read, written)
    assert_same(read[1:], [e for e in recording.events() if isinstance(e, Decided)])
    with pytest.raises(RecordingError, match=r"no decision of step 3; accepted: -1, 0, 1, 2$"):
        recording.decision(3)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"chosen": 4}, "chosen is 4; accepted: -1 to 3"),
        ({"chosen": -2}, "chosen is -2"),
        ({"chosen": 0}, "action 0 is chosen, which cannot be taken"),
        ({"stop": "bored"}, "bored"),
        ({"stop": "gain"}, "action 1 is chosen with the stop 'gain'"),
        ({"chosen": -1}, "action -1 is chosen with the stop ''"),
        ({"score": np.array([0.0, np.nan, 0.0, 0.0])}, "score has NaN or inf"),
        ({"score": np.array([0.0, np.inf, 0.0, 0.0])}, "score has NaN or inf"),
        ({"score": np.zeros(3)}, r"it is float64 \(3,\)|shape"),
        ({"hit_chance": np.array([0.0, 1.1, 0.0, 0.0])}, "hit_chance has a number that is no"),
        ({"blocked_chance": np.full(4, np.nan)}, "blocked_chance has a number that is no"),
        ({"expected_spread": np.full(4, np.inf)}, "expected_spread has a number that is not"),
        ({"spread": float("nan")}, "spread is nan"),
        ({"contacts": np.zeros((2, 3))}, "2 contacts for 3 poses; accepted: one for each, or none"),
        ({"contacts": np.full((3, 3), np.inf)}, "a contact is not finite"),
    ],
)
def test_a_decision_that_makes_no_sense_is_not_written(steered_events, write, values, message):
    with pytest.raises(ChselError, match=message):
        write(changed(steered_events, **values))


def test_a_decision_stands_after_the_results_of_its_step(steered_events, write):
    def moved(kind: type[Event], step: int) -> list[Event]:
        """With the decision after step 1 ahead of an event."""
        (one,) = (e for e in steered_events if isinstance(e, Decided) and e.step == 1)
        rest = [event for event in steered_events if event is not one]
        place = next(i for i, e in enumerate(rest) if isinstance(e, kind) and e.step == step)
        return [*rest[:place], one, *rest[place:]]

    write(moved(Measured, 1))
    for kind, step, message in (
        (Probe, 1, "a decision of step 1 follows probe 0"),
        (ProblemPosed, 1, "the registration of step 1 follows its decision"),
        (Probe, 2, None),
        (Decided, 2, "a decision of step 1 follows probe 2|follows one of step 2"),
    ):
        if message is None:
            write(moved(kind, step))
            continue
        with pytest.raises(RecordingError, match=message):
            write(moved(kind, step))


def test_actions_are_offered_once_at_the_start_of_a_steered_session(steered_events, write):
    (offered,) = (event for event in steered_events if isinstance(event, ActionsOffered))
    rest = [event for event in steered_events if event is not offered]
    for events, message in (
        (rest, "a decision of step -1 has no actions before it"),
        ([rest[0], offered, offered], "accepted: once, before all steps"),
        ([rest[0], dataclasses.replace(offered, step=0)], "accepted: once, before all steps"),
    ):
        with pytest.raises(RecordingError, match=message):
            write(events)


def test_a_hand_far_from_its_origin_makes_no_problem(steered_events):
    """Its front, in cells of millimetres, would have none."""
    problem = next(event.problem for event in steered_events if isinstance(event, Decided))
    for offset in (2e6, 1e17, 1e300):
        hand = HandShape(problem.hand.vertices + offset, problem.hand.faces)
        with pytest.raises(SettingError, match=r"the hand reaches .* m from its origin; accepted"):
            dataclasses.replace(problem, hand=hand)


def test_the_problem_of_a_decision_follows_from_what_came_before(steered_events, write):
    (first, second, *_) = (event for event in steered_events if isinstance(event, Decided))
    stale = dataclasses.replace(second, problem=first.problem)
    events = [stale if event is second else event for event in steered_events]
    with pytest.raises(RecordingError, match="points, a grid, a workspace, actions or a hand that"):
        write(events)


@pytest.fixture
def few(make_events):
    """A session of one probe, with sensors."""
    return with_sensors(make_events(steps=1, free=3))


def first(events: list[Event], kind: type) -> int:
    return next(i for i, event in enumerate(events) if isinstance(event, kind))


def test_rig_and_images_are_found_by_step(sensor_events, write):
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


def test_pixels_are_counted_before_they_are_unpacked(few, tmp_path, monkeypatch):
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
