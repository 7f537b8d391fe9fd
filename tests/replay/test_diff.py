"""`diff`: the first difference between two recordings, and all of them."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from chsel.errors import RecordingError, SettingError
from chsel.problem.sdf_grid import SdfGrid
from replay.__main__ import main
from replay.comparing.recording_diff import FIRST, SECOND, Ignored, recording_diff
from replay.events import HypothesesFound, Logged, Measured, SnapshotTaken, Traced
from replay.mcap.encoding import decode, encode, message_class
from replay.mcap.foxglove_messages import FOXGLOVE
from replay.mcap.reader import read_recording
from replay.mcap.schemas import RECORDS
from tests.replay.conftest import with_decisions

Messages = list[tuple[str, int, bytes]]


def changed(events: list, kind: type, number: int, **values) -> list:
    """The events, one of a kind with other values."""
    places = [place for place, event in enumerate(events) if isinstance(event, kind)]
    place = places[number]
    return [*events[:place], dataclasses.replace(events[place], **values), *events[place + 1 :]]


def rewritten(
    path: Path, change: Callable[[Messages], Messages], attachments: dict[str, bytes] | None = None
) -> Path:
    """A valid, checksummed copy in which messages (topic, log time, bytes) are others."""
    copy = path.with_suffix(".other.mcap")
    with path.open("rb") as source, copy.open("wb") as target:
        reader = make_reader(source)
        writer = Writer(target, compression=CompressionType.NONE, enable_data_crcs=True)
        writer.start("chsel", "")
        for item in reader.iter_attachments():
            data = (attachments or {}).get(item.name, item.data)
            if data:
                writer.add_attachment(0, 0, item.name, item.media_type, data)
        summary = reader.get_summary()
        for schema in summary.schemas.values():
            writer.register_schema(schema.name, schema.encoding, schema.data)
        channels = {
            channel.topic: writer.register_channel(channel.topic, "protobuf", channel.schema_id)
            for channel in summary.channels.values()
        }
        messages = [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages()]
        for sequence, (topic, time, data) in enumerate(change(messages)):
            writer.add_message(channels[topic], time, data, time, sequence)
        writer.finish()
    return copy


def edited(topic: str, number: int, edit: Callable[[bytes], bytes]) -> Callable[..., Messages]:
    """A change of the n-th message on a topic."""

    def change(messages: Messages) -> Messages:
        place = [i for i, message in enumerate(messages) if message[0] == topic][number]
        name, time, data = messages[place]
        return [*messages[:place], (name, time, edit(data)), *messages[place + 1 :]]

    return change


def session_with(**values) -> Callable[[bytes], bytes]:
    return lambda data: encode("Session", decode("Session", data) | values)


def texts(first: Path, second: Path, *ignored: str) -> list[str]:
    found = recording_diff(first, second, ignored=Ignored(ignored))
    return [str(item) for item in found.differences]


def test_equal_files_are_equal_to_the_byte(events, write, capsys):
    first, second = write(events), write(events)
    assert main(["diff", str(first), str(second)]) == 0
    assert capsys.readouterr().out == "equal to the byte\n"


def test_the_same_content_in_other_bytes_is_equal(events, write, capsys):
    first = write(events)
    second = rewritten(first, lambda messages: messages)
    assert main(["diff", str(first), str(second)]) == 0
    assert capsys.readouterr().out == "equal in content; the files differ in other bytes\n"


def test_a_bit_of_one_cost_is_found_with_all_that_follows_from_it(events, write, capsys):
    hypotheses = [e for e in events if isinstance(e, HypothesesFound)][1].hypotheses
    cost = hypotheses.cost.copy()
    cost[0] = np.nextafter(np.nextafter(cost[0], 9.0), 9.0)
    other = dataclasses.replace(hypotheses, cost=cost)
    first, second = write(events), write(changed(events, HypothesesFound, 1, hypotheses=other))
    assert main(["diff", str(first), str(second)]) == 1
    lines = capsys.readouterr().out.split("\n")
    assert re.fullmatch(
        r"first difference: /hypotheses, step 2: cost: 1 of 5 numbers by up to 2 ulp \(\S+\), "
        "the first at 0",
        lines[0],
    )
    rows = [re.split(r"\s{2,}", line.strip()) for line in lines]
    assert ["/hypotheses", "2", "cost, digest", "1", "2", "0", "0", "2"] in rows
    assert lines[-2] == "18 of 19 topics and attachments are equal"
    found = recording_diff(first, second)
    assert [item.ulps for item in found.differences] == [2, None]
    assert [name for name, topic in found.topics.items() if not topic.is_equal] == ["/hypotheses"]
    assert found.topics["/hypotheses"].count == 2


def test_a_trace_is_named_by_its_stage(events, write, capsys):
    first, second = write(events), write(changed(events, Traced, 0, digest="0" * 32))
    assert main(["diff", str(first), str(second), "--all"]) == 1
    out = capsys.readouterr().out
    assert out.startswith("first difference: /trace, step 1, descent iteration 100: digest: ")


def test_settings_and_environment_differ_by_key(events, write, capsys):
    start = events[0]
    config = {"object": {"name": "电钻", "scale": 2.5}, "flags": [True, None, -1.0], "new": {}}
    other = dataclasses.replace(
        start, config=config, environment={"torch": "2.14.0", "numpy": "2.4.6", "libigl": "2.6"}
    )
    first, second = write(events), write([other, *events[1:]])
    assert texts(first, second) == [
        "/session, start: config.object.scale: 1.5 -> 2.5",
        "/session, start: config.flags[2]: -1 -> -1.0",
        "/session, start: config.flags[3]: 1e-300 -> absent",
        "/session, start: environment.torch: 2.13.0 -> 2.14.0",
        "/session, start: environment.platform: Linux -> absent",
        "/session, start: config.new: absent -> {}",
        "/session, start: environment.libigl: absent -> 2.6",
    ]
    assert texts(first, second, "environment", "config.flags", "config.new") == [
        "/session, start: config.object.scale: 1.5 -> 2.5"
    ]
    assert main(["diff", str(first), str(second)]) == 1
    out = capsys.readouterr().out
    assert "config.flags[2]: -1 -> -1.0" in out
    assert main(["diff", str(first), str(second), "--ignore", "environment", "config"]) == 0
    expected = "equal in content, leaving out environment, config; the files differ in other bytes"
    assert capsys.readouterr().out == f"{expected}\n"


def test_a_message_too_many_shifts_nothing(events, write):
    place = next(i for i, event in enumerate(events) if isinstance(event, Traced))
    more = [*events[:place], Traced(1, "descent", 50, "1" * 32, 0.0, 1.0, 2.0), *events[place:]]
    first, second = write(events), write(more)
    assert texts(first, second) == [
        "/trace, step 1, descent iteration 50: only in the second recording"
    ]
    assert texts(second, first) == [
        "/trace, step 1, descent iteration 50: only in the first recording"
    ]
    found = recording_diff(first, second)
    trace = found.topics["/trace"]
    assert (trace.count, trace.differing, trace.only_first, trace.only_second) == (3, 0, 0, 1)
    assert found.differences[0].having == SECOND


def test_a_shorter_session_lacks_its_last_messages(make_events, write):
    first, second = write(make_events(steps=3)), write(make_events(steps=2))
    found = recording_diff(first, second)
    lonely = [item for item in found.differences if item.having == FIRST]
    assert {item.key.step for item in lonely} == {2}
    assert {"/probe", "/problem", "/hypotheses"} <= {item.key.topic for item in lonely}
    assert not any(item.having == SECOND and item.key.step == 2 for item in found.differences)


def test_the_order_of_messages_matters(events, write):
    first = write(events)

    def swapped(messages: Messages) -> Messages:
        topics = [message[0] for message in messages]
        place = topics.index("/trace")
        (a, time_a, data_a), (b, time_b, data_b) = messages[place : place + 2]
        assert (a, b) == ("/trace", "/archive")
        return [*messages[:place], (b, time_a, data_b), (a, time_b, data_a), *messages[place + 2 :]]

    assert texts(first, rewritten(first, swapped)) == [
        "/trace, step 1, descent iteration 100: order: it stands later in the second recording"
    ]


def test_signed_zeros_differ_and_equal_nan_do_not(events, write):
    def with_values(*values: float) -> Path:
        numbers = {f"number_{index}": value for index, value in enumerate(values)}
        return write(changed(events, Measured, 0, values=numbers))

    first = with_values(0.0, math.nan, 1.0, math.inf)
    assert recording_diff(first, with_values(0.0, math.nan, 1.0, math.inf)).same_bytes
    second = with_values(-0.0, math.nan, 1.0 + 2.0**-52, -math.inf)
    step = next(event.step for event in events if isinstance(event, Measured))
    at = f"/measured, step {step}: values.number_"
    found = texts(first, second)
    assert found[:2] == [
        f"{at}0: 0.0 -> -0.0 (1 ulp)",
        f"{at}2: 1.0 -> 1.0000000000000002 (1 ulp)",
    ]
    assert found[2].startswith(f"{at}3: inf -> -inf (")
    assert len(found) == 3


def test_arrays_of_another_length_are_named_by_their_shape(events, write):
    archive = next(e for e in events if isinstance(e, SnapshotTaken)).archive
    fewer = dataclasses.replace(
        archive,
        **{
            name: getattr(archive, name)[:-1]
            for name in ("cells", "solutions", "objectives", "measures")
        },
    )
    found = texts(write(events), write(changed(events, SnapshotTaken, 0, archive=fewer)))
    where = "/archive, step 1, iteration 0 (pass 2)"
    assert found[:2] == [
        f"{where}: cells: int64 (12,) -> int64 (11,)",
        f"{where}: solutions: float64 (12, 9) -> float64 (11, 9)",
    ]


def test_mesh_and_grid_are_compared_by_number(events, write):
    start = events[0]
    mesh = trimesh.Trimesh(start.mesh.vertices.copy(), start.mesh.faces, process=False)
    mesh.vertices[3, 1] = np.nextafter(mesh.vertices[3, 1], 1.0)
    values = np.array(start.sdf.values)
    values.reshape(-1)[7] += 1.0
    sdf = SdfGrid(start.sdf.origin, start.sdf.resolution, values, np.array(start.sdf.gradients))
    first = write(events[:1])
    second = write([dataclasses.replace(start, mesh=mesh, sdf=sdf)])
    found = recording_diff(first, second).differences
    assert [(item.key.topic, item.field) for item in found] == [
        ("mesh.ply", "vertices"),
        ("sdf_grid", "values"),
        ("/session", "mesh_digest"),
        ("/session", "sdf_digest"),
    ]
    assert found[0].ulps == 1
    assert "1 of 24 numbers by up to 1 ulp" in found[0].text
    assert "the first at 7" in found[1].text
    ignored = ("mesh.ply", "mesh_digest", "sdf_digest", "sdf_grid")
    assert texts(first, second, *ignored) == []


def test_points_are_compared_by_number(events, write):
    first = write(events)

    def nudge(data: bytes) -> bytes:
        place = data.index(message_points(data)) + 8
        return data[:place] + bytes([data[place] ^ 3]) + data[place + 1 :]

    second = rewritten(first, edited("/points/free", 1, nudge))
    found = recording_diff(first, second).differences
    assert [item.field for item in found] == ["points"]
    assert re.match(
        r"/points/free, step 0: points: 1 of 120 numbers by up to [13] ulp \(\S+\), the first at 1",
        str(found[0]),
    )
    assert texts(first, second, "/points") == texts(first, second, "points/free") == []


def message_points(data: bytes) -> bytes:
    return FOXGLOVE["/points/free"].FromString(data).data


def test_recordings_that_contradict_themselves_are_compared_all_the_same(events, write):
    """Where the reader refuses them, the difference is what one wants to see."""
    first = write(events)
    broken = rewritten(first, edited("/problem", 0, problem_of_another_seed))
    with pytest.raises(RecordingError):
        read_recording(broken).problem(1)
    assert texts(first, broken) == [f"/problem, step 1: key_seed: {2**64 - 1} -> 1"]
    malformed = rewritten(first, edited("/problem", 0, lambda data: b"\xff" + data))
    assert texts(first, malformed)[-2:] == [
        "/problem, step 1: malformed: absent -> a message is not a valid chsel.Problem",
        f"/problem, step 1: bytes: absent -> {len(problem_bytes(first)) + 1} bytes",
    ]
    assert texts(malformed, malformed) == []


def problem_of_another_seed(data: bytes) -> bytes:
    return encode("Problem", decode("Problem", data) | {"key_seed": 1})


def problem_bytes(path: Path) -> bytes:
    with path.open("rb") as file:
        return next(
            m.data for _, c, m in make_reader(file).iter_messages() if c.topic == "/problem"
        )


def test_no_setting_hides_behind_another_of_the_same_path(events, write):
    first = write(events)
    configs = [{"a.b": 1, "a": {"b": 2}}, {"a.b": 3, "a": {"b": 2}}, {"a.b": 1, "a": {"b": 3}}]
    paths = [
        rewritten(first, edited("/session", 0, session_with(config=json.dumps(config)))).rename(
            first.with_name(f"config{index}.mcap")
        )
        for index, config in enumerate(configs)
    ]
    assert texts(paths[0], paths[1]) == ["/session, start: config.a.b: 1 -> 3"]
    assert texts(paths[0], paths[2]) == ["/session, start: config.a.b': 2 -> 3"]


def test_no_control_character_reaches_the_terminal(events, write, capsys):
    first = write(events)
    config = json.dumps({"\x1b[2J": "\x1b]0;title\x07"})
    second = rewritten(first, edited("/session", 0, session_with(config=config)))
    trace = edited(
        "/trace", 0, lambda data: encode("Trace", decode("Trace", data) | {"stage": "\x1bc"})
    )
    third = rewritten(second, trace)
    assert main(["diff", str(first), str(third), "--all"]) == 1
    out = capsys.readouterr().out
    assert "title" in out
    assert "\x1b" not in out
    assert "\x07" not in out


def test_log_lines_are_compared_by_text(events, write):
    first, second = write(events), write(changed(events, Logged, 0, text="other"))
    assert texts(first, second) == ["/log, start: message: ready — los geht's -> other"]


def test_a_time_stamp_differs_only_where_it_is_not_the_log_time(events, write):
    first = write(events)
    kind = FOXGLOVE["/log"]

    def stamped(nanos: int | None) -> Path:
        def edit(data: bytes) -> bytes:
            message = kind.FromString(data)
            message.ClearField("timestamp")
            if nanos is not None:
                message.timestamp.nanos = nanos
            return message.SerializeToString()

        return rewritten(first, edited("/log", 0, edit))

    assert texts(first, stamped(None)) == ["/log, start: timestamp: absent -> None"]
    assert texts(first, stamped(7)) == [
        "/log, start: timestamp.seconds: absent -> 0",
        "/log, start: timestamp.nanos: absent -> 7",
    ]


@pytest.mark.parametrize("word", ["enviroment", "/hypothesis", "", "/", "mesh"])
def test_what_cannot_be_left_out_is_named(word):
    with pytest.raises(SettingError, match="names nothing in a recording; accepted: names of"):
        Ignored([word])


def test_files_that_cannot_be_used_are_named(events, write, tmp_path, capsys):
    path = write(events)
    whole = path.read_bytes()
    cut, flipped = tmp_path / "cut.mcap", tmp_path / "flipped.mcap"
    cut.write_bytes(whole[:-9])
    middle = len(whole) // 2
    flipped.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    for bad, message in ((cut, "is unfinished"), (flipped, "damaged"), (tmp_path / "no", "exist")):
        for pair in ((path, bad), (bad, path), (bad, bad)):
            assert main(["diff", *map(str, pair)]) == 2
            error = capsys.readouterr().err
            assert str(bad) in error
            assert message in error


def test_every_topic_is_met(sensor_events, write):
    """So that no topic of the table is passed over in silence."""
    path = write(with_decisions(sensor_events))
    with path.open("rb") as file:
        topics = {channel.topic for _, channel, _ in make_reader(file).iter_messages()}
    assert set(RECORDS) <= topics
    for topic in sorted(RECORDS):
        kind = message_class(RECORDS[topic])

        def other(data: bytes, kind=kind) -> bytes:
            message = kind.FromString(data)
            if hasattr(message, "step"):
                message.step += 1
            else:
                message.runner += "!"
            return message.SerializeToString()

        found = recording_diff(path, rewritten(path, edited(topic, 0, other)))
        assert [item.key.topic for item in found.differences] == [topic], topic
