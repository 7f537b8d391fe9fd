"""What nobody should write: messages and settings beyond all bounds, refused in one line."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.reader import make_reader

from chsel.cost.cost_settings import CostSettings, interior_points
from chsel.errors import RecordingError, SdfError, SettingError
from chsel.methods.chsel import ChselSettings
from chsel.methods.gradient_descent import DescentSettings
from chsel.problem.online_registration import OnlineSettings
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.qd.emitters import EmitterSettings
from chsel.qd.selection import ArchiveSettings
from replay.events import (
    Event,
    ProblemPosed,
)
from replay.mcap.encoding import message_class
from replay.mcap.reader import read_recording
from replay.mcap.schemas import RECORDS
from tests.replay.mcap.test_reader import Change, rewritten

Write = Callable[[list[Event]], Path]


def changed_message(topic: str, change: Callable[[Any], None]) -> Change:
    """A change of the messages on a topic of the project's own."""

    def apply(name: str, data: bytes) -> bytes:
        if name != topic:
            return data
        message: Any = message_class(RECORDS[topic]).FromString(data)
        change(message)
        changed: bytes = message.SerializeToString()
        return changed

    return apply


def test_records_of_unknown_kinds_are_passed_by(
    events: list[Event], write: Write, assert_same: Callable[..., None]
) -> None:
    path = write(events)
    data = path.read_bytes()
    place = data.index(b"mesh.ply") - 29  # where the attachment's record begins
    unknown = bytes([200]) + (8).to_bytes(8, "little") + b"whatever"
    path.write_bytes(data[:place] + unknown + data[place:])
    assert_same(read_recording(path, partial=True).events(), events)


def set_field(name: str, value: Any) -> Callable[[Any], None]:
    return lambda message: setattr(message, name, value)


def number(field: str, place: int, value: float) -> Callable[[Any], None]:
    def change(message: Any) -> None:
        array = getattr(message, field)
        numbers = np.frombuffer(array.data, array.dtype).copy()
        numbers[place] = value
        array.data = numbers.tobytes()

    return change


@pytest.mark.parametrize(
    ("topic", "change", "message"),
    [
        ("/session", set_field("config", "[" * 100_000), "its configuration is not valid JSON"),
        ("/session", set_field("object", "\x1b[2J"), r"object holds the character '\\x1b' at 0"),
        ("/session", set_field("runner", "a\nb"), "accepted: a name on one line"),
        ("/session", set_field("free_resolution", 1e-12), "free_resolution is 1e-12; accepted"),
        ("/session", set_field("free_resolution", float("nan")), "free_resolution is nan"),
        ("/session", number("world_from_object", 0, 3.0), "is not a rigid transform"),
        ("/session", number("workspace", 0, np.inf), "workspace.* is not finite"),
        ("/probe", set_field("outcome", "gone"), "accepted: contact, free, points"),
        ("/probe", set_field("step", 1), "has a time of step 0, not its own"),
        ("/probe", number("gripper_path", 0, np.nan), r"gripper_path\[0\] is not a rigid"),
        ("/trace", set_field("lowest_cost", 1e12), "accepted: lowest, median, highest"),
        ("/trace", set_field("median_cost", float("nan")), "accepted: lowest, median, highest"),
        ("/trace", set_field("stage", "a\x07b"), "without control characters"),
        (
            "/problem",
            number("initial_set", 5, 7.0),
            r"step 1: initial_set\[0\] is not a rigid",
        ),
        ("/problem", set_field("sdf_digest", "0"), "the SDF grid of the problem of step 1"),
        ("/problem", set_field("free_resolution", 0.0), "free_resolution is 0.0"),
        ("/session_ended", set_field("outcome", "fine"), "accepted: finished, interrupted, failed"),
    ],
)
def test_what_a_message_says_is_checked(
    make_events: Callable[..., list[Event]],
    write: Write,
    topic: str,
    change: Callable[[Any], None],
    message: str,
) -> None:
    path = rewritten(write(make_events(steps=2, free=3)), changed_message(topic, change))
    with pytest.raises(RecordingError, match=message) as caught:
        read_recording(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_unknown_fields_of_a_message_are_passed_by(
    events: list[Event], write: Write, assert_same: Callable[..., None]
) -> None:
    """A later program of the same format version may append fields."""
    longer = changed_message("/probe", lambda m: m.MergeFromString(b"\xfa\x3e\x03new"))
    assert_same(read_recording(rewritten(write(events), longer)).events(), events)


@pytest.mark.parametrize("hidden", [False, True])
def test_a_chunk_that_unpacks_to_too_much_is_refused_before_it_is(
    events: list[Event], write: Write, hidden: bool
) -> None:
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
    assert read_recording(path, partial=True).start.object == events[0].object  # type: ignore[union-attr]


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
def test_settings_have_upper_bounds(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        make()


def test_a_spacing_too_fine_for_the_grid_is_refused(events: list[Event]) -> None:
    sdf: SdfGrid = events[0].sdf  # type: ignore[union-attr]
    with pytest.raises(SettingError, match=r"interior_spacing 1e-06 m makes 3\.0e\+15 nodes"):
        interior_points(sdf, CostSettings(-0.01, free_term="interior", interior_spacing=1e-6))


def test_grids_whose_nodes_cannot_be_told_apart_are_refused(events: list[Event]) -> None:
    sdf: SdfGrid = events[0].sdf  # type: ignore[union-attr]
    for resolution in (1e-320, 1e300):
        with pytest.raises(SdfError, match=r"SDF resolution is .*accepted: 1e-06 to 1000"):
            dataclasses.replace(sdf, resolution=resolution)
    with pytest.raises(SdfError, match=r"SDF origin is .*; accepted: up to 1e"):
        dataclasses.replace(sdf, origin=np.full(3, 1e308))
    problem: RegistrationProblem = next(e.problem for e in events if isinstance(e, ProblemPosed))
    with pytest.raises(SettingError, match="free_resolution is 1e-300; accepted"):
        dataclasses.replace(problem, free_resolution=1e-300)
