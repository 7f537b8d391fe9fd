"""Values and orders of events that writer and reader refuse, each with one clear line."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from chsel.errors import RecordingError
from chsel.problem.points import KnownPoints
from replay.events import (
    Event,
    HypothesesFound,
    Logged,
    Measured,
    Probe,
    ProblemPosed,
    RigDescribed,
    SensorImage,
    SessionEnded,
    SnapshotTaken,
    Timed,
    Traced,
)
from replay.mcap.reader import read_recording
from replay.mcap.writer import McapRecorder
from tests.replay.conftest import with_sensors

Events = list[Event]
Change = Callable[[Events], Events]
Write = Callable[[Events], Path]


def first(events: Events, kind: type) -> int:
    return next(i for i, event in enumerate(events) if isinstance(event, kind))


def changed(kind: type, /, **values: Any) -> Change:
    """Other values of the first event of a kind."""

    def change(events: Events) -> Events:
        i = first(events, kind)
        return [*events[:i], dataclasses.replace(events[i], **values), *events[i + 1 :]]

    return change


def result(make: Callable[[Any], dict[str, Any]]) -> Change:
    """Other values of the first result, made of the old ones."""

    def change(events: Events) -> Events:
        found: Any = events[first(events, HypothesesFound)]
        other = dataclasses.replace(found.hypotheses, **make(found.hypotheses))
        return changed(HypothesesFound, hypotheses=other)(events)

    return change


def archive(**values: Any) -> Change:
    """Other values of the archive of the first result."""
    return result(lambda found: {"archive": dataclasses.replace(found.archive, **values)})


def inserted(place: int, event: Event) -> Change:
    return lambda events: [*events[:place], event, *events[place:]]


def repeated(kind: type) -> Change:
    return lambda events: inserted(first(events, kind), events[first(events, kind)])(events)


def moved(kind: type, before: type) -> Change:
    def change(events: Events) -> Events:
        event = events.pop(first(events, kind))
        return inserted(first(events, before), event)(events)

    return change


def without(kind: type) -> Change:
    return lambda events: [event for event in events if not isinstance(event, kind)]


def image(height: int, width: int) -> dict[str, Any]:
    return {"values": np.zeros((height, width), np.uint16), "mask": np.zeros((height, width), bool)}


def hand(mesh: trimesh.Trimesh) -> Change:
    return changed(RigDescribed, hand=mesh)


WRONG: dict[str, Change] = {
    # results
    r"Hypotheses of step 1: cost is out of order": result(lambda e: {"cost": e.cost[::-1].copy()}),
    "cost is out of order; accepted": result(lambda e: {"cost": np.nan * e.cost}),
    "cost is -inf": result(lambda e: {"cost": np.array([-np.inf, 1, 2, 3, 4.0])}),
    r"object_from_world\[0\] is not a rigid": result(
        lambda e: {"object_from_world": 1.5 * e.object_from_world}
    ),
    "object_from_world is not finite where": result(
        lambda e: {"object_from_world": np.nan * e.object_from_world}
    ),
    r"elites\[0\] is not a rigid": result(lambda e: {"elites": 0.0 * e.elites}),
    "cell is out of range; accepted: -1 to 1599": result(
        lambda e: {"cell": np.full(5, 1600, dtype=np.int64)}
    ),
    "cell is out of range; accepted: -1 to -1": result(lambda e: {"archive": None}),
    "has cells out of order": archive(cells=np.zeros(12, dtype=np.int64)),
    "has 2 axes, but names": archive(measure_names=("x",)),
    "has an empty range": archive(lower=np.array([-0.3, 0.3])),
    "objectives has a number that is not finite": archive(objectives=np.full(12, np.nan)),
    r"cells, \(4294967295, 4294967295\)": archive(shape=(2**32 - 1,) * 2),
    # numbers and texts
    "seconds has a number that": inserted(5, Timed(0, {"a": np.inf})),
    r"a name of values holds the character '\\x1b'": inserted(5, Measured(0, {"\x1b": 1.0})),
    "a log line holds the character": inserted(5, Logged(0, "info", "\x00")),
    # images
    r"SensorImage of step 0: sensor is 'a/b'; accepted: letters, digits and _": changed(
        SensorImage, sensor="a/b"
    ),
    "sensor is ''": changed(SensorImage, sensor=""),
    "kind is 'color'; accepted: depth, deformation": changed(SensorImage, kind="color"),
    r"unit is nan; accepted: 1e-09 to 1000 \(m\)": changed(SensorImage, unit=np.nan),
    r"unit is 0\.0": changed(SensorImage, unit=0.0),
    "intrinsics .* above 0": changed(SensorImage, intrinsics=np.array([0.0, 1.0, 2.0, 3.0])),
    r"intrinsics .* up to 1e\+06": changed(
        SensorImage, intrinsics=np.array([1.0, 1.0, np.inf, 3.0])
    ),
    r"world_from_camera\[0\] is not a rigid": changed(
        SensorImage, world_from_camera=2.0 * np.eye(4)
    ),
    r"height is 0; accepted: 1 to 8192 \(pixels\)": changed(SensorImage, **image(0, 3)),
    "height is 8193; accepted": changed(SensorImage, **image(8193, 1)),
    # the rig
    "the mesh has a vertex that is not finite": hand(
        trimesh.Trimesh(np.full((3, 3), np.inf), [[0, 1, 2]], process=False)
    ),
    "no triangle of its vertices": hand(trimesh.Trimesh(np.eye(3), [[0, 1, 3]], process=False)),
    "the mesh has no faces": hand(trimesh.Trimesh()),
    # order
    "probe 0 follows probe 0": inserted(8, Probe(0, "free", KnownPoints())),
    "step 1 has a second registration problem": repeated(ProblemPosed),
    "/hypotheses of step 1 is in no registration of it": repeated(HypothesesFound),
    "/archive of step 1 is in no registration": moved(HypothesesFound, SnapshotTaken),
    "/trace of step 1 is in no registration of it": moved(Traced, ProblemPosed),
    "an event follows the end of the session": repeated(SessionEnded),
    "step 0 follows one of step 1": lambda events: inserted(
        first(events, ProblemPosed), Logged(0, "info", "")
    )(events),
    "there is a rig of step -1; accepted: one, before all steps": repeated(RigDescribed),
    "there is a rig of step 0": changed(RigDescribed, step=0),
    "an image of step 0 does not precede the probe of its": moved(SensorImage, SessionEnded),
    "image of step -1 does not precede": changed(SensorImage, step=-1),
    "an image of step 0 has no rig before it": without(RigDescribed),
}


@pytest.fixture
def robot(make_events: Callable[..., Events]) -> Events:
    """A session of two probes, with sensors and a registration."""
    return with_sensors(make_events(steps=2, free=3))


@pytest.mark.parametrize("message", WRONG)
def test_it_is_refused_by_writer_and_reader(
    robot: Events, write: Write, monkeypatch: pytest.MonkeyPatch, message: str
) -> None:
    events = WRONG[message](robot)
    if "does not precede the probe" in message:
        events = without(SessionEnded)([e for e in events if e.step < 1])
    with pytest.raises(RecordingError, match=message):
        write(events)
    with monkeypatch.context() as careless:
        careless.setattr("replay.mcap.writer.check_message", lambda name, values: None)
        careless.setattr("replay.mcap.foxglove_messages.check_text", lambda what, text: None)
        careless.setattr("replay.mcap.writer.EventOrder.take", lambda order, topic, step: None)
        path = write(events)
    with pytest.raises(RecordingError, match=message) as caught:
        read_recording(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"values": np.zeros((2, 2))}, r"values of float64 \(2, 2\); accepted: uint16"),
        ({"mask": np.zeros((5, 6), bool)}, r"mask of an image is bool \(5, 6\); accepted: bool"),
        ({"mask": np.zeros((5, 7), np.uint8)}, "mask of an image is uint8"),
        ({"values": np.zeros(4, np.uint16)}, r"values of uint16 \(4,\); accepted"),
    ],
)
def test_pixels_of_another_kind_are_refused(
    robot: Events, write: Write, values: dict[str, Any], message: str
) -> None:
    with pytest.raises(RecordingError, match=message):
        write(changed(SensorImage, **values)(robot))


def test_a_diverged_start_of_infinite_cost_is_a_result(
    robot: Events, write: Write, assert_same: Callable[..., None]
) -> None:
    def diverged(found: Any) -> dict[str, Any]:
        cost, poses = found.cost.copy(), found.object_from_world.copy()
        cost[-1], poses[-1, :3] = np.inf, np.nan
        return {"cost": cost, "object_from_world": poses}

    events = result(diverged)(robot)
    assert_same(read_recording(write(events)).events(), events)


def test_a_refused_event_is_not_in_the_recording(
    tmp_path: Path, events: Events, assert_same: Callable[..., None]
) -> None:
    recorder = McapRecorder(tmp_path / "a.mcap")
    recorder.record(events[0])
    recorder.record(events[1])
    with pytest.raises(RecordingError, match="accepted: contact, free, points"):
        recorder.record(Probe(0, "gone", KnownPoints()))
    recorder.close()
    assert_same(read_recording(tmp_path / "a.mcap").events(), events[:2])


@pytest.mark.parametrize("value", [float("nan"), {1, 2}])
def test_a_configuration_that_is_not_plain_is_refused(
    events: Events, write: Write, value: Any
) -> None:
    start = dataclasses.replace(events[0], config={"a": [value]})  # type: ignore[call-arg]
    with pytest.raises(RecordingError, match="the configuration cannot be recorded"):
        write([start])
