"""What `info` shows of MCAP files that other programs wrote."""

from __future__ import annotations

import io
import json
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from replay.__main__ import main
from replay.console import Console
from replay.raw import log_info as module
from replay.raw.channels import Channel
from replay.raw.frames import frames
from replay.raw.log_display import show_log
from replay.raw.log_info import LogInfo, TopicInfo, is_other_programs, log_info
from tests.runners.sensors.small_logs import (
    BEGIN,
    SECOND,
    foxglove_sent,
    ros2_sent,
    ros2_transform,
    write_foxglove,
    write_ros2,
)

MAGIC = 8  # bytes


def cdr_header(frame: str, order: str = "<") -> bytes:
    """A std_msgs/Header."""
    return struct.pack(f"{order}iII", 1, 2, len(frame) + 1) + frame.encode() + b"\0"


def by_topic(info: LogInfo) -> dict[str, TopicInfo]:
    return {topic.topic: topic for topic in info.topics}


@pytest.mark.parametrize("check", [False, True])
def test_topics_types_counts_rates_and_frames_of_a_ros2_log(tmp_path: Path, check: bool) -> None:
    path = tmp_path / "log.mcap"
    write_ros2(path, ros2_sent(9))
    assert is_other_programs(path)
    info = log_info(path, check=check)
    topics = by_topic(info)
    assert (info.damage, info.checked, info.count) == (None, check, 9 * 15)
    assert (info.begin, info.end) == (BEGIN + 10**6, BEGIN + 8 * SECOND + 10**6)
    depth = topics["/depth"]
    assert (depth.type, depth.encoding, depth.count) == ("sensor_msgs/msg/Image", "cdr", 9)
    assert depth.rate == pytest.approx(1.0)
    assert depth.frames == ("camera",)
    assert topics["/tf"].frames == ("world > base",)
    assert topics["/cloud"].frames == ("lidar",)
    assert topics["/probe"].frames == topics["/joints"].frames == ()


def test_frames_of_foxgloves_messages(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write_foxglove(path, foxglove_sent())
    topics = by_topic(log_info(path))
    assert topics["/tf"].frames == topics["/transforms"].frames == ("world > base",)
    assert topics["/depth"].frames == ("camera",)
    assert topics["/pair"].frames == ()
    assert topics["/log"].rate is None


def test_all_transforms_of_a_message_and_all_frames_of_a_topic(tmp_path: Path) -> None:
    names = [f"link{'_' * n}" for n in range(30)]  # of all alignments
    several = {"transforms": [ros2_transform("a", name, (0, 0, 0), BEGIN) for name in names]}
    path = tmp_path / "log.mcap"
    write_ros2(path, [("/tf", "tf2_msgs/TFMessage", several, BEGIN)])
    (topic,) = log_info(path).topics
    assert topic.frames == tuple(sorted(f"a > {name}" for name in names)[:20])
    assert topic.more_frames


@pytest.mark.parametrize(
    ("encoding", "schema", "definition", "data", "expected"),
    [
        ("ros1", "a/B", "Header header\nint8 x", struct.pack("<IIII", 1, 2, 3, 3) + b"map", "map"),
        ("ros1", "a/B", "# Header header\nint8 x", bytes(20), None),
        ("ros1", "a/B", "Header header", struct.pack("<IIII", 1, 2, 3, 2**31), None),
        ("cdr", "a/B", "int8 A=1\nstd_msgs/Header h", b"\0\1\0\0" + cdr_header("arm"), "arm"),
        ("cdr", "a/B", "std_msgs/Header h", b"\0\0\0\0" + cdr_header("arm", ">"), "arm"),
        ("cdr", "a/B", "std_msgs/Header h", b"\0\1\0\0" + cdr_header("a\x1b[2J"), "a\\x1b[2J"),
        ("cdr", "a/B", "std_msgs/Header h", b"\0", None),
        ("cdr", "a/B", None, b"\0\1\0\0" + cdr_header("arm"), None),
        ("json", "x", None, b'{"frame_id": "map", "data": [1]}', "map"),
        ("json", "x", None, b'{"header": {"frame_id": "map"}}', "map"),
        ("json", "x", None, b'{"header": {"frame_id": 3}}', None),
        ("json", "x", None, b"[" * 60_000, None),
        ("protobuf", "foxglove.RawImage", None, b"\xff\xff", None),
        ("protobuf", "foxglove.os", None, b"", None),
        ("protobuf", "mine.Image", None, b"", None),
        ("unknown", "x", None, b"abc", None),
    ],
)
def test_frames_of_messages_of_any_kind(
    encoding: str, schema: str, definition: str | None, data: bytes, expected: str | None
) -> None:
    found = frames(Channel("/t", encoding, schema, definition), data)
    assert found == (() if expected is None else (expected,))


def test_unfinished_logs_are_counted_as_far_as_they_go(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "log.mcap"
    whole = write_ros2(path, ros2_sent(9))
    path.write_bytes(whole[: len(whole) // 2])
    info = log_info(path)
    assert info.checked
    assert info.damage is not None
    assert 0 < info.count < 9 * 15
    assert main(["info", str(path)]) == 1
    output = " ".join(capsys.readouterr().out.split())
    assert "damaged or unfinished: log.mcap: it is cut within a record" in output


def test_damage_in_the_middle_is_found_by_checking(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    whole = bytearray(write_ros2(path, ros2_sent(9), compression=CompressionType.NONE))
    whole[whole.index(b"begin 4") + 1] ^= 1
    path.write_bytes(whole)
    assert log_info(path).damage is None or "checksum" in str(log_info(path).damage)
    damage = log_info(path, check=True).damage
    assert damage is not None
    assert "the checksum of a chunk is wrong" in damage
    assert "its index has" in damage


def test_a_log_written_without_an_index_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        writer = Writer(
            file,
            use_chunking=False,
            use_statistics=False,
            use_summary_offsets=False,
            repeat_channels=False,
            repeat_schemas=False,
        )
        writer.start()
        schema = writer.register_schema("x", "jsonschema", b"{}")
        channel = writer.register_channel("/x", "json", schema)
        for n in range(5):
            writer.add_message(channel, n * SECOND // 10, b'{"frame_id": "map"}', 0)
        writer.finish()
    info = log_info(path)
    assert info.damage is None
    assert (info.topics[0].count, info.topics[0].frames) == (5, ("map",))
    assert info.topics[0].rate == pytest.approx(10.0)
    assert (info.begin, info.end) == (0, 4 * SECOND // 10)


def test_a_log_without_messages_has_no_times(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "log.mcap"
    write_foxglove(path, [])
    assert main(["info", str(path)]) == 0
    output = capsys.readouterr().out
    assert "0 on 0 topics" in output
    assert "1970" not in output


def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    path, noise = tmp_path / "log.mcap", np.random.default_rng(0)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=100_000, compression=CompressionType.NONE)
        writer.start()
        schema = writer.register_schema("x", "", b"")
        channel = writer.register_channel("/x", "", schema)
        for n in range(120):
            writer.add_message(channel, n, noise.bytes(200_000), n)
        writer.finish()
    for check in (False, True):
        tracemalloc.start()
        assert log_info(path, check=check).count == 120
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 5_000_000


def test_hostile_names_are_shown_as_they_are_and_many_topics_are_cut(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for n in range(130):
            schema = writer.register_schema(f"[red]\x1b[2J{n}", "x", b"")
            channel = writer.register_channel(f"/[bold]{n:03}", "y", schema)
            writer.add_message(channel, 2**63 - 2, b"", 0)
        writer.finish()
    assert main(["info", str(path)]) == 0
    output = capsys.readouterr().out
    assert "\x1b[2J" not in output
    assert "/[bold]000" in output
    assert "/[bold]110" not in output
    assert "30 more topics" in output
    assert main(["info", "--steps", str(path)]) == 0
    assert "/[bold]129" in capsys.readouterr().out


def test_no_name_is_broken_on_a_narrow_terminal() -> None:
    frames = ("camera_front_left_depth_optical_frame", "world > pad_of_the_left_finger")
    names = (f"/{frames[0]}/depth/camera_info", "/arm/left_hand/finger_pads/image_raw")
    topics = tuple(
        TopicInfo(name, "sensor_msgs/msg/CameraInfo", "cdr", 123456, 1999.0, frames)
        for name in names
    )
    text = io.StringIO()
    info = LogInfo(Path("log.mcap"), 1, topics, 0, 1, (), {}, True)
    show_log(Console(file=text, width=80), info, all_=False)
    for name in (*names, "sensor_msgs/CameraInfo", *frames):
        assert " ".join(text.getvalue().split()).count(name) >= 1, name


def test_json_and_lines_of_several_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "log.mcap"
    write_ros2(path, ros2_sent())
    assert main(["info", "--json", str(path)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["log"] is True
    assert document["integrity"] == {"whole": True, "checked": False, "damage": None}
    assert {topic["topic"] for topic in document["topics"]} >= {"/tf", "/depth"}
    assert main(["info", *[str(path)] * 4]) == 0
    lines = capsys.readouterr().out.strip().splitlines()
    assert len(lines) == 4
    assert "log of another program, 15 topics, 60 messages, 3.000 s" in lines[0]


@pytest.mark.parametrize("data", [b"", b"text", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n\x01"])
def test_what_is_no_log_is_refused_as_before(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], data: bytes
) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(data)
    assert not is_other_programs(path)
    assert main(["info", str(path)]) == 2
    assert capsys.readouterr().err.startswith("error: recording ")


def test_a_ros_1_bag_is_an_error_that_names_the_converter(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "log.bag"
    path.write_bytes(b"#ROSBAG V2.0\n")
    assert main(["info", str(path)]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert f"log {path} is a ROS 1 bag; accepted: " in told
    assert "`rosbags-convert --src LOG.bag" in told


def test_many_faults_are_counted_in_bounded_memory() -> None:
    found = module._Gathered()
    for n in range(1000):
        found.fault(f"fault {n}")
    assert len(found.faults) == 101
    assert sum(found.faults.values()) == 1000
