"""Logs as files and folders: in order, within bounds, and what is left of damaged ones."""

import hashlib
import shutil
import struct
import tracemalloc
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType

from chsel.errors import SessionError
from replay.files import file_digest
from runners.sensors.log.messages import MarkerMessage
from runners.sensors.log.raw_log import RawLog
from tests.runners.sensors.small_logs import BEGIN, ros2_image, ros2_sent, write_ros2

MAGIC = 8  # bytes


def texts(path: Path, *topics: str) -> list[str]:
    """Messages as text that can be compared."""
    log = RawLog(path)
    return [repr(one) for one in log.messages(topics or log.topics)]


def summary_start(data: bytes) -> int:
    return int(struct.unpack_from("<Q", data, len(data) - MAGIC - 20)[0])


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("finished", [True, False])
def test_files_of_all_kinds_give_the_same(
    tmp_path: Path, compression: CompressionType, finished: bool
) -> None:
    write_ros2(tmp_path / "usual.mcap", ros2_sent(3))
    write_ros2(tmp_path / "log.mcap", ros2_sent(3), compression=compression)
    if not finished:  # as a recorder that was killed leaves it
        data = (tmp_path / "log.mcap").read_bytes()
        (tmp_path / "log.mcap").write_bytes(
            data[: summary_start(data) - 13]
        )  # without summary and data end
    log = RawLog(tmp_path / "log.mcap")
    assert log.topics == RawLog(tmp_path / "usual.mcap").topics
    assert texts(tmp_path / "log.mcap") == texts(tmp_path / "usual.mcap")
    assert len(list(log.messages(log.topics))) == 45
    assert bool(log.faults) == (not finished)


def test_messages_come_in_order_of_log_time(tmp_path: Path) -> None:
    sent = ros2_sent(6)
    mixed = [sent[i] for i in np.random.default_rng(0).permutation(len(sent))]
    write_ros2(tmp_path / "log.mcap", mixed, chunk_size=300)
    ordered = texts(tmp_path / "log.mcap")
    times = [one.log_time for one in RawLog(tmp_path / "log.mcap").messages(["/tf", "/probe"])]
    assert times == sorted(times)
    assert len(ordered) == len(sent)


def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    values = np.random.default_rng(0).integers(0, 2**16, (64, 128)).astype(np.uint16)
    message = ros2_image(values, BEGIN)
    sent = [("/depth", "sensor_msgs/Image", message, time) for time in range(500)]
    path = tmp_path / "log.mcap"
    write_ros2(path, sent, chunk_size=100_000, compression=CompressionType.NONE)
    log = RawLog(tmp_path / "log.mcap")
    tracemalloc.start()
    assert sum(1 for _ in log.messages(["/depth"])) == 500
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert log.size > 500 * 64 * 128 * 2
    assert peak < 1_500_000  # two chunks or so, of the file's many


@pytest.mark.parametrize("chunk_size", [300, 10**6])
def test_only_what_is_asked_for_is_given(tmp_path: Path, chunk_size: int) -> None:
    write_ros2(tmp_path / "log.mcap", ros2_sent(6), chunk_size=chunk_size)
    log = RawLog(tmp_path / "log.mcap")
    told: list[tuple[int, int]] = []
    given = log.messages(["/probe", "/nothing"], progress=lambda *done: told.append(done))
    contents = [received.content for received in given]
    assert contents == [MarkerMessage(f"begin {step}") for step in range(6)]
    assert told[-1] == (log.size, log.size)


def test_a_topic_that_is_not_there_is_an_error_that_lists_the_others(tmp_path: Path) -> None:
    write_ros2(tmp_path / "log.mcap", ros2_sent(1))
    with pytest.raises(SessionError, match=r"no topic /a; it has .*/depth \(sensor_msgs/msg/Ima"):
        RawLog(tmp_path / "log.mcap").messages(["/a"])


@pytest.mark.parametrize("content", [b"", b"SQLite format 3\0", b"\x89MCAP1\r\n"])
def test_what_is_no_log_is_an_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "log.mcap").write_bytes(content)
    with pytest.raises(SessionError, match=r"log\.mcap is not an MCAP file"):
        RawLog(tmp_path / "log.mcap")
    with pytest.raises(SessionError, match=r"other\.mcap does not exist"):
        RawLog(tmp_path / "other.mcap")
    (tmp_path / "folder").mkdir()
    with pytest.raises(SessionError, match=r"without \.mcap files"):
        RawLog(tmp_path / "folder")


def flip(data: bytearray) -> None:
    """A bit of a chunk, or of a message that is not compressed."""
    name = next(n for n in (b"zstd", b"lz4", b"begin 5") if n in data)
    data[data.index(name, len(data) // 3) + (6 if name == b"begin 5" else 30)] ^= 1


@pytest.mark.parametrize("compression", list(CompressionType))
def test_damage_costs_the_messages_of_one_chunk_alone(
    tmp_path: Path, compression: CompressionType
) -> None:
    path = tmp_path / "log.mcap"
    data = bytearray(write_ros2(path, ros2_sent(8), chunk_size=1500, compression=compression))
    whole = Counter(texts(path))
    flip(data)
    path.write_bytes(data)
    log = RawLog(path)
    left = Counter(repr(one) for one in log.messages(log.topics))
    assert left < whole
    assert left.total() > 0.5 * whole.total()
    total = log.faults.total()
    assert list(log.messages(log.topics))
    assert log.faults.total() == total  # reading again does not count it again


@pytest.mark.parametrize("part", [0.1, 0.25, 0.4])
def test_a_cut_file_gives_what_is_before_the_cut(tmp_path: Path, part: float) -> None:
    data = write_ros2(tmp_path / "log.mcap", ros2_sent(8), chunk_size=1500)
    whole = texts(tmp_path / "log.mcap")
    (tmp_path / "log.mcap").write_bytes(data[: int(part * len(data))])
    log = RawLog(tmp_path / "log.mcap")
    left = texts(tmp_path / "log.mcap")
    assert 0 < len(left) < len(whole)
    assert left == whole[: len(left)]
    assert any("without its index" in text for text in log.warnings)
    assert log.faults


def rosbag(folder: Path, metadata: str | None = None) -> None:
    """A bag of eleven files, a second each."""
    folder.mkdir()
    sent = ros2_sent(11)
    for step in range(11):
        write_ros2(folder / f"bag_{step}.mcap", sent[15 * step : 15 * (step + 1)])
    names = "".join(f"\n    - bag_{step}.mcap" for step in range(11))
    usual = (
        "rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: mcap\n"
        f"  compression_mode: ''\n  relative_file_paths:{names}\n"
    )
    if metadata != "missing":
        (folder / "metadata.yaml").write_text(usual if metadata is None else metadata)


@pytest.mark.parametrize("metadata", [None, "missing", "{", "- 1", "a: &a [*a]"])
def test_a_rosbag2_folder_is_one_log(tmp_path: Path, metadata: str | None) -> None:
    rosbag(tmp_path / "bag", metadata)
    log = RawLog(tmp_path / "bag")
    assert log.topics["/probe"].count == 11
    contents = [received.content for received in log.messages(["/probe"])]
    assert contents == [MarkerMessage(f"begin {step}") for step in range(11)]
    assert any("metadata.yaml" in remark for remark in log.warnings) == (metadata is not None)
    digests = "".join(file_digest(file) + "\n" for file in log.files)
    assert log.digest() == hashlib.blake2b(digests.encode(), digest_size=16).hexdigest()


@pytest.mark.parametrize("finished", [True, False])
def test_files_of_a_bag_that_hold_a_topic_each_are_read_in_order_of_time(
    tmp_path: Path, finished: bool
) -> None:
    sent = [(*one[:3], one[3] + n) for n, one in enumerate(ros2_sent(6))]
    whole, bag = tmp_path / "whole.mcap", tmp_path / "bag"
    write_ros2(whole, sent, chunk_size=300)
    bag.mkdir()
    for number, topic in enumerate(dict.fromkeys(one[0] for one in sent)):
        own = [one for one in sent if one[0] == topic]
        write_ros2(bag / f"bag_{number}.mcap", own, chunk_size=1, finished=finished)
    told: list[tuple[int, int]] = []
    log = RawLog(bag)
    both = [
        [(one.log_time, one.topic, repr(one.content)) for one in of.messages(of.topics, progress=p)]
        for of, p in ((log, lambda *done: told.append(done)), (RawLog(whole), lambda *done: None))
    ]
    assert len(both[0]) > 80
    assert both[0] == both[1]
    assert told[-1] == (log.size, log.size)
    assert all(done <= log.size for done, _ in told)


def test_a_missing_file_of_a_bag_is_said(tmp_path: Path) -> None:
    rosbag(tmp_path / "bag")
    (tmp_path / "bag" / "bag_4.mcap").unlink()
    log = RawLog(tmp_path / "bag")
    assert log.topics["/probe"].count == 10
    assert log.warnings == ["file bag_4.mcap, which metadata.yaml names, is missing"]


@pytest.mark.parametrize(
    ("name", "start"), [("a.bag", b"#ROSBAG V2.0\n"), ("a", b"#ROSBAG V2.0\n"), ("b.bag", b"")]
)
def test_a_ros_1_bag_is_an_error_that_names_the_converter(
    tmp_path: Path, name: str, start: bytes
) -> None:
    (tmp_path / name).write_bytes(start)
    with pytest.raises(SessionError, match=r"is a ROS 1 bag; accepted: .*`rosbags-convert --src"):
        RawLog(tmp_path / name)
    whole = write_ros2(tmp_path / "whole.mcap", ros2_sent(1))
    (tmp_path / name).write_bytes(whole)
    assert len(RawLog(tmp_path / name).topics) == 15


def test_bags_of_other_storage_are_errors(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    rosbag(folder)
    usual = (folder / "metadata.yaml").read_text()
    for text, reason in (
        (usual.replace("mcap\n  comp", "sqlite3\n  comp"), "sqlite3"),
        (usual.replace("''", "MESSAGE"), r"compressed by rosbag2 \(MESSAGE\)"),
        (usual.replace("bag_0.mcap", "bag_0.mcap.zstd"), "compressed as a whole"),
    ):
        (folder / "metadata.yaml").write_text(text)
        with pytest.raises(SessionError, match=reason):
            RawLog(folder)


def test_the_digest_is_that_of_the_file(tmp_path: Path) -> None:
    write_ros2(tmp_path / "log.mcap", ros2_sent(2))
    assert RawLog(tmp_path / "log.mcap").digest() == file_digest(tmp_path / "log.mcap")
    shutil.copy(tmp_path / "log.mcap", tmp_path / "copy.mcap")
    assert RawLog(tmp_path / "copy.mcap").digest() == file_digest(tmp_path / "log.mcap")
