"""What `info` shows of MCAP files that other programs wrote."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from mcap.writer import Writer

from replay.__main__ import main
from replay.content.log_info import LogInfo, is_other_programs, log_info
from tests.runners.sensors.small_logs import BEGIN, SECOND, ros2_sent, write_foxglove, write_ros2


def counts(info: LogInfo) -> dict[str, int]:
    return {channel.topic: count for channel, count in info.topics}


def test_topics_types_counts_and_rates_of_a_log(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write_ros2(path, ros2_sent(9))
    assert is_other_programs(path)
    info = log_info(path)
    assert (info.damage, info.count, len(info.topics)) == (None, 9 * 15, 15)
    assert (info.begin, info.end) == (BEGIN + 10**6, BEGIN + 8 * SECOND + 10**6)
    (depth,) = [channel for channel, _ in info.topics if channel.topic == "/depth"]
    assert (depth.schema, depth.encoding) == ("sensor_msgs/msg/Image", "cdr")
    assert counts(info)["/depth"] == 9
    assert info.rate(9) == pytest.approx(9.0 / 8.0)


def test_unfinished_logs_are_counted_as_far_as_they_go(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "log.mcap"
    whole = write_ros2(path, ros2_sent(9), chunk_size=1500)
    path.write_bytes(whole[: len(whole) // 3])
    info = log_info(path)
    assert info.damage is not None
    assert 0 < info.count < 9 * 15
    assert main(["info", str(path)]) == 1
    output = " ".join(capsys.readouterr().out.split())
    assert "unfinished or damaged: log.mcap: a record is cut short; what is whole" in output


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
            writer.add_message(channel, n * SECOND // 10, b"{}", 0)
        writer.finish()
    info = log_info(path)
    assert info.damage is None
    assert counts(info) == {"/x": 5}
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


def test_names_with_control_characters_are_quoted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("[red]\x1b[2J", "x", b"")
        writer.add_message(writer.register_channel("/[bold]", "y", schema), 2**63 - 2, b"", 0)
        writer.finish()
    assert main(["info", str(path)]) == 0
    output = capsys.readouterr().out
    assert "\x1b[2J" not in output
    assert "/[bold]" in output


def test_json_and_lines_of_several_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "log.mcap"
    write_ros2(path, ros2_sent())
    assert main(["info", "--json", str(path)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["log"] is True
    assert document["integrity"] == {"whole": True, "damage": None}
    assert {topic["topic"] for topic in document["topics"]} >= {"/tf", "/depth"}
    assert main(["info", *[str(path)] * 4]) == 0
    lines = capsys.readouterr().out.strip().splitlines()
    assert len(lines) == 4
    assert "log of another program, 15 topics, 60 messages, 3.000 s" in lines[0]


@pytest.mark.parametrize("data", [b"", b"text", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n\x01"])
def test_what_is_no_log_is_refused(
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
