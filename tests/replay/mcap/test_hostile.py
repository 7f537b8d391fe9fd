"""Files made to do harm: refused in one line, in little time and memory."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.opcode import Opcode

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
from tests.tools.mutations import file_of, joined, packed, split, unpacked
from tests.tools.seals import resealed

Records = list[tuple[int, bytes]]
Change = Callable[[Records], None]


@pytest.fixture
def refused(
    write: Callable[[list[Event]], Path], make_events: Callable[..., list[Event]]
) -> Callable[..., None]:
    """Asserts that a recording with other records is refused with a message."""

    def check(change: Change, message: str) -> None:
        path = write(make_events(steps=2, elites=3, free=3))
        everything = split(path.read_bytes()[8:-8])
        change(everything)
        path.write_bytes(file_of(resealed(everything)))
        with pytest.raises(RecordingError, match=message) as caught:
            read_recording(path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)

    return check


def first_of(everything: Records, opcode: int) -> int:
    return next(i for i, (found, _) in enumerate(everything) if found == opcode)


def changed_message(topic: str, change: Callable[[Any], None]) -> Change:
    """A change of the first message on a topic of the project's own."""

    def apply(everything: Records) -> None:
        numbers = {
            content[8 : 8 + int.from_bytes(content[4:8], "little")]: content[:2]
            for opcode, content in everything
            if opcode == Opcode.CHANNEL
        }
        for place, (opcode, content) in enumerate(everything):
            if opcode != Opcode.CHUNK:
                continue
            inside = split(unpacked(content))
            for i, (kind, data) in enumerate(inside):
                if kind == Opcode.MESSAGE and data[:2] == numbers[topic.encode()]:
                    message: Any = message_class(RECORDS[topic]).FromString(data[22:])
                    change(message)
                    inside[i] = (kind, data[:22] + message.SerializeToString())
                    everything[place] = (opcode, packed(joined(inside)))
                    return

    return apply


def test_an_attachment_may_not_stand_twice(refused: Callable[..., None]) -> None:
    def twice(everything: Records) -> None:
        place = first_of(everything, Opcode.ATTACHMENT)
        everything.insert(place, everything[place])

    refused(twice, "the attachment 'mesh.ply' stands in it twice")


def test_no_data_stand_behind_their_end_or_outside_of_chunks(refused: Callable[..., None]) -> None:
    def behind(everything: Records) -> None:
        end = first_of(everything, Opcode.DATA_END)
        last = max(i for i, (opcode, _) in enumerate(everything) if opcode == Opcode.CHUNK)
        everything.insert(end + 1, everything.pop(last))

    def outside(everything: Records) -> None:
        everything.insert(1, (Opcode.MESSAGE, bytes(30)))

    refused(behind, "data follow the end of its data")
    refused(outside, "a message stands outside of a chunk")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (bytes(5), "a chunk ends within a record"),
        (joined([(Opcode.MESSAGE, bytes(10))]), "a message has 10 bytes; accepted: at least 22"),
        (joined([(Opcode.MESSAGE, bytes(30))])[:-1], "a record of 30 bytes does not fit"),
        (joined([(Opcode.CHANNEL, b"\1\0\1\0\xff\xff\xff\xff")]), "4294967295 bytes do not fit"),
        (joined([(Opcode.MESSAGE, bytes(22))]), "channel 0 does not exist"),
    ],
)
def test_lengths_within_a_chunk_are_not_believed(
    refused: Callable[..., None], content: bytes, message: str
) -> None:
    def other(everything: Records) -> None:
        place = first_of(everything, Opcode.CHUNK)
        everything[place] = (Opcode.CHUNK, packed(content))

    refused(other, message)


def test_a_channel_may_not_become_another(refused: Callable[..., None]) -> None:
    def redescribed(everything: Records) -> None:
        place = first_of(everything, Opcode.CHUNK)
        inside = split(unpacked(everything[place][1]))
        channels = [content for opcode, content in inside if opcode == Opcode.CHANNEL]
        other = channels[0][:2] + channels[1][2:]
        inside.append((Opcode.CHANNEL, other))
        everything[place] = (Opcode.CHUNK, packed(joined(inside)))

    refused(redescribed, r"channel \d+ is described twice, and not the same")


def test_records_of_unknown_kinds_are_passed_by(
    events: list[Event], write: Callable[[list[Event]], Path], assert_same: Callable[..., None]
) -> None:
    path = write(events)
    everything = split(path.read_bytes()[8:-8])
    for place in (1, 3, len(everything) - 2):
        everything.insert(place, (200, b"whatever"))
        everything.insert(place, (Opcode.METADATA, b"\0" * 8))
    path.write_bytes(file_of(everything))
    assert_same(read_recording(path).events(), events)


def test_a_summary_that_starts_nowhere_is_damage(
    events: list[Event], write: Callable[[list[Event]], Path]
) -> None:
    path = write(events)
    data = bytearray(path.read_bytes())
    data[-28:-20] = b"\xff" * 8
    path.write_bytes(data)
    with pytest.raises(
        RecordingError, match="in its summary, it does not start where the end says"
    ):
        read_recording(path)


def set_field(name: str, value: Any) -> Callable[[Any], None]:
    return lambda message: setattr(message, name, value)


def repeat_name(field: str) -> Callable[[Any], None]:
    def change(message: Any) -> None:
        items = getattr(message, field)
        items.add().CopyFrom(items[0])

    return change


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
        ("/session", set_field("config", "{" * 50_000), "its configuration is no JSON"),
        ("/session", set_field("config", "[" * 100_000), "its configuration is no JSON"),
        ("/session", set_field("config", '{"a": 1, "a": 2}'), "a mapping has a key twice"),
        ("/session", set_field("config", '{"a": NaN}'), r"config\.a is nan; accepted: finite"),
        ("/session", set_field("config", '{"a": 1e999}'), r"config\.a is inf; accepted: finite"),
        ("/session", set_field("config", '{"a": 1' + "0" * 9000 + "}"), "has 9001 digits"),
        ("/session", set_field("config", '{"a": "' + "x" * 2**20 + '"}'), "accepted: at most 1048"),
        ("/session", set_field("config", r'{"a": "\ud800"}'), "without control characters"),
        ("/session", set_field("object", "\x1b[2J"), r"object holds the character '\\x1b' at 0"),
        ("/session", set_field("runner", "a\nb"), "accepted: a name on one line"),
        ("/session", set_field("free_resolution", 1e-12), "free_resolution is 1e-12; accepted"),
        ("/session", set_field("free_resolution", float("nan")), "free_resolution is nan"),
        ("/session", number("world_from_object", 0, 3.0), "is not a rigid transform"),
        ("/session", number("workspace", 0, np.inf), "workspace.* is not finite"),
        ("/session", repeat_name("environment"), "Session.environment has a name twice"),
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
        ("/measured", repeat_name("values"), "Measured.values has a name twice"),
        ("/timed", repeat_name("seconds"), "Timed.seconds has a name twice"),
        ("/session_ended", set_field("outcome", "fine"), "accepted: finished, interrupted, failed"),
    ],
)
def test_what_a_message_says_is_checked(
    refused: Callable[..., None], topic: str, change: Callable[[Any], None], message: str
) -> None:
    refused(changed_message(topic, change), message)


def test_an_older_recording_without_newer_topics_and_optional_fields_is_read(
    write: Callable[[list[Event]], Path],
    make_events: Callable[..., list[Event]],
    assert_same: Callable[..., None],
) -> None:
    """What a version appends is optional: files from before it lack the topic and the field."""
    events = make_events(steps=1)[:1]
    events[0] = dataclasses.replace(events[0], world_from_object=None, environment={})
    path = write(events)
    everything = split(path.read_bytes()[8:-8])
    place = first_of(everything, Opcode.CHUNK)
    late = (b"/timed", b"/trace", b"/gripper_path", b"/measured")
    inside = [
        (opcode, content)
        for opcode, content in split(unpacked(everything[place][1]))
        if not (opcode == Opcode.CHANNEL and any(topic in content for topic in late))
    ]
    everything[place] = (Opcode.CHUNK, packed(joined(inside)))
    path.write_bytes(file_of(resealed(everything)))
    assert_same(read_recording(path).events(), events)


def test_unknown_fields_of_a_message_are_passed_by(
    events: list[Event], write: Callable[[list[Event]], Path], assert_same: Callable[..., None]
) -> None:
    """A later program of the same format version may append fields."""
    path = write(events)
    everything = split(path.read_bytes()[8:-8])

    def longer(message: Any) -> None:
        message.MergeFromString(b"\xfa\x3e\x03new")  # field 1007

    changed_message("/probe", longer)(everything)
    path.write_bytes(file_of(resealed(everything)))
    assert_same(read_recording(path).events(), events)


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


_BOMBS = """
import resource, sys
import numpy as np
from chsel.errors import RecordingError
from replay.mcap.reader import read_recording
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for path in sys.argv[1:]:
    try:
        read_recording(path, partial=path.endswith("zeros.mcap"))
        print("read")
    except RecordingError as error:
        print(error)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


def bomb(path: Path, whole: bytes, content: bytes) -> Path:
    """A recording whose first chunk is followed by another of such content."""
    everything = split(whole[8:-8])
    place = first_of(everything, Opcode.CHUNK)
    everything.insert(place + 1, (Opcode.CHUNK, packed(content)))
    path.write_bytes(file_of(everything))
    assert path.stat().st_size < 100_000
    return path


def test_bombs_take_little_memory(
    tmp_path: Path, write: Callable[[list[Event]], Path], make_events: Callable[..., list[Event]]
) -> None:
    path = write(make_events(steps=1, free=1)[:1])
    whole = path.read_bytes()
    sequence = len([o for o, _ in split(unpacked(split(whole[8:-8])[3][1])) if o == Opcode.MESSAGE])
    assert sequence > 0
    size = 15 * 2**20

    def message(channel: int, data: bytes, number: int = sequence) -> bytes:
        head = channel.to_bytes(2, "little") + number.to_bytes(4, "little")
        return joined([(Opcode.MESSAGE, head + (10**9).to_bytes(8, "little") * 2 + data)])

    numbers = {
        content[8 : 8 + int.from_bytes(content[4:8], "little")].decode(): content[0]
        for opcode, content in split(whole[8:-8])
        if opcode == Opcode.CHANNEL
    }
    bombs = {
        "zeros": bytes(size),
        "too large": bytes(2**28),
        "fields": message(numbers["/measured"], b"\x12\x00" * (size // 2)),
        "list": message(numbers["/archive"], b"\x2a\x80\x80\x80\x07" + b"\x01" * (7 * 2**21)),
        "records": joined([(Opcode.METADATA, b"")]) * (size // 9),
        "log lines": b"".join(
            message(numbers["/log"], b"\x10\x02", sequence + i) for i in range(size // 250)
        ),
        "empty messages": joined([(Opcode.MESSAGE, b"")]) * (size // 9),
    }
    paths = [bomb(tmp_path / f"{name}.mcap", whole, data) for name, data in bombs.items()]
    command = [sys.executable, "-c", _BOMBS, *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.stderr == ""
    *errors, grown = done.stdout.splitlines()
    assert len(errors) == len(bombs)
    for message in (
        "a chunk claims 268435456 bytes",
        "chsel.Measured has more fields than any recorded",
        "chsel.ArchiveSnapshot has a list of 14680064 bytes",
        "it holds more than",
        "a message has 0 bytes; accepted: at least 22",
    ):
        assert any(message in error for error in errors), message
    assert int(grown) < 150  # MB
