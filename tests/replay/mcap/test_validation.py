"""Values and orders of events that writer and reader refuse, each with one clear line."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import zstandard
from mcap.opcode import Opcode
from mcap.reader import make_reader

from chsel.cost.cost_settings import CostSettings, interior_points
from chsel.errors import RecordingError, SdfError, SettingError
from chsel.methods.chsel import ChselSettings
from chsel.methods.gradient_descent import DescentSettings
from chsel.problem.online_registration import OnlineSettings
from chsel.problem.points import KnownPoints
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.qd.emitters import EmitterSettings
from chsel.qd.selection import ArchiveSettings
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
def robot(make_events):
    """A session of two probes, with sensors and a registration."""
    return with_sensors(make_events(steps=2, free=3))


@pytest.mark.parametrize("message", WRONG)
def test_it_is_refused_by_writer_and_reader(robot, write, monkeypatch, message):
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
def test_pixels_of_another_kind_are_refused(robot, write, values, message):
    with pytest.raises(RecordingError, match=message):
        write(changed(SensorImage, **values)(robot))


def test_a_diverged_start_of_infinite_cost_is_a_result(robot, write, assert_same):
    def diverged(found: Any) -> dict[str, Any]:
        cost, poses = found.cost.copy(), found.object_from_world.copy()
        cost[-1], poses[-1, :3] = np.inf, np.nan
        return {"cost": cost, "object_from_world": poses}

    events = result(diverged)(robot)
    assert_same(read_recording(write(events)).events(), events)


@pytest.mark.parametrize("value", [float("nan"), {1, 2}])
def test_a_configuration_that_is_not_plain_is_refused(events, write, value):
    start = dataclasses.replace(events[0], config={"a": [value]})
    with pytest.raises(RecordingError, match="the configuration cannot be recorded"):
        write([start])


Write = Callable[[list[Event]], Path]


@pytest.mark.parametrize("hidden", [False, True])
def test_a_chunk_that_unpacks_to_too_much_is_refused_before_it_is(events, write, hidden):
    """hidden: only the compressed data say how much it is."""
    path = write(events)
    data = path.read_bytes()
    packed, size = zstandard.compress(bytes(2**29 + 1)), 2**29 + 1
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    place = summary.chunk_indexes[1].chunk_start_offset
    head = struct.pack("<QQQI", 0, 0, 5 if hidden else size, 0) + struct.pack("<I", 4) + b"zstd"
    content = head + struct.pack("<Q", len(packed)) + packed
    record = struct.pack("<BQ", Opcode.CHUNK, len(content)) + content
    path.write_bytes(data[:place] + record + data[place:])
    with pytest.raises(RecordingError, match=f"a chunk claims {size} bytes, unpacked"):
        read_recording(path)
    assert read_recording(path, partial=True).start.object == events[0].object


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: DescentSettings(restarts=1_000_001), "restarts is 1000001; accepted: at most"),
        (
            lambda: DescentSettings(restarts=10**5, iterations=11),
            "restarts x iterations is 1100000",
        ),
        (lambda: EmitterSettings(iterations=10**7), "iterations is 10000000; accepted: at most"),
        (lambda: ArchiveSettings(bins=4000), r"bins \*\* 2, the number of cells, is 16000000"),
        (lambda: ArchiveSettings(measure="rotation_6", bins=15), r"bins \*\* 6"),
        (lambda: OnlineSettings(hypotheses=10**7), "hypotheses is 10000000; accepted: at most"),
        (lambda: ChselSettings(passes=10_001), "passes is 10001; accepted: at most 10_000"),
    ],
)
def test_settings_have_upper_bounds(make, message):
    with pytest.raises(SettingError, match=message):
        make()


def test_a_spacing_too_fine_for_the_grid_is_refused(events):
    sdf: SdfGrid = events[0].sdf
    with pytest.raises(SettingError, match=r"interior_spacing 1e-06 m makes 3\.0e\+15 nodes"):
        interior_points(sdf, CostSettings(-0.01, free_term="interior", interior_spacing=1e-6))


def test_grids_whose_nodes_cannot_be_told_apart_are_refused(events):
    sdf: SdfGrid = events[0].sdf
    for resolution in (1e-320, 1e300):
        with pytest.raises(SdfError, match=r"SDF resolution is .*accepted: 1e-06 to 1000"):
            dataclasses.replace(sdf, resolution=resolution)
    with pytest.raises(SdfError, match=r"SDF origin is .*; accepted: up to 1e"):
        dataclasses.replace(sdf, origin=np.full(3, 1e308))
    problem: RegistrationProblem = next(e.problem for e in events if isinstance(e, ProblemPosed))
    with pytest.raises(SettingError, match="free_resolution is 1e-300; accepted"):
        dataclasses.replace(problem, free_resolution=1e-300)
