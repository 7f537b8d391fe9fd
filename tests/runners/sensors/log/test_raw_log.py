"""Logs as files and folders: in order, within bounds, and what is left of damaged ones."""

import hashlib

import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as PlainWriter
from mcap_ros2.writer import Writer

from chsel.errors import SessionError
from replay.files import file_digest
from runners.sensors.log.raw_log import RawLog
from runners.sensors.log.ros2_definitions import full_definition
from tests.runners.sensors.small_logs import ros2_sent, write_ros2


def texts(path):
    """Messages as text that can be compared."""
    log = RawLog(path)
    return [repr(one) for one in log.messages(log.topics)]


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("finished", [True, False])
def test_files_of_all_kinds_give_the_same(tmp_path, compression, finished):
    """finished: else as a recorder that was killed leaves it."""
    usual, path = tmp_path / "usual.mcap", tmp_path / "log.mcap"
    write_ros2(usual, ros2_sent(3))
    write_ros2(path, ros2_sent(3), chunk_size=1, compression=compression, finished=finished)
    log = RawLog(path)
    assert log.topics == RawLog(usual).topics
    assert (log.begin, log.end) == (RawLog(usual).begin, RawLog(usual).end)
    assert texts(path) == texts(usual)
    assert len(texts(path)) == 45
    assert bool(log.warnings) == (not finished)


def test_messages_come_in_order_of_log_time(tmp_path):
    sent = ros2_sent(6)
    mixed = [sent[i] for i in np.random.default_rng(0).permutation(len(sent))]
    write_ros2(tmp_path / "log.mcap", mixed, chunk_size=300)
    log = RawLog(tmp_path / "log.mcap")
    told: list[tuple[int, int]] = []
    given = log.messages(["/probe", "/nothing"], progress=lambda *done: told.append(done))
    assert [received.content for received in given] == [f"begin {step}" for step in range(6)]
    assert told[-1] == (log.size, log.size)
    assert len(texts(tmp_path / "log.mcap")) == len(sent)
    with pytest.raises(SessionError, match=r"no topic /a; it has .*/depth \(sensor_msgs/msg/Ima"):
        log.messages(["/a"])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("log.mcap", b"", r"log\.mcap is of no kind that is read; accepted: an \.mcap, \.db3"),
        ("log.mcap.zst", b"\x28\xb5\x2f\xfd\0\0\0\0", r"compressed by zstd; .*: .*`zstd -d FILE`"),
        ("log.bag", b"version https://git-lfs", r"log\.bag is of no kind that is read"),
        ("none.mcap", None, r"none\.mcap does not exist"),
        ("", None, r"is a folder with none of these files; accepted: an \.mcap, \.db3 or \.bag"),
    ],
)
def test_what_is_no_log_is_an_error(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(SessionError, match=message):
        RawLog(tmp_path / name)


def test_a_folder_with_packed_files_is_not_read_in_part(tmp_path):
    write_ros2(tmp_path / "bag_1.mcap", ros2_sent(1))
    (tmp_path / "bag_0.mcap.zstd").write_bytes(b"")
    with pytest.raises(SessionError, match=r"has 1 files that are compressed, such as bag_0\.mcap"):
        RawLog(tmp_path)
    write_ros2(tmp_path / "bag_0.mcap", ros2_sent(1))
    assert len(RawLog(tmp_path).files) == 2


@pytest.mark.parametrize("finished", [True, False])
@pytest.mark.parametrize("checked", [True, False])
def test_an_unknown_compression_is_named(tmp_path, finished, checked):
    """checked: whether chunks have checksums."""
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        options = {"chunk_size": 500, "compression": CompressionType.ZSTD, "enable_crcs": checked}
        writer = Writer(file, **options)
        text = writer.register_msgdef("std_msgs/msg/String", full_definition("std_msgs/String"))
        for number in range(100):
            writer.write_message("/probe", text, {"data": f"begin {number}"}, number)
        if finished:
            writer.finish()
    path.write_bytes(path.read_bytes().replace(b"\x04\0\0\0zstd", b"\x04\0\0\0snap"))
    said = "a chunk is compressed by 'snap'; accepted: zstd, lz4, or none"
    with pytest.raises(SessionError, match=said):
        RawLog(path).messages(["/probe"])


def test_messages_that_rosbag2_compressed_are_named(tmp_path):
    path, packed = tmp_path / "plain.mcap", tmp_path / "bag_0.mcap"
    write_ros2(path, ros2_sent(2))
    with path.open("rb") as file, packed.open("wb") as out:
        writer = PlainWriter(out)
        writer.start()
        for schema, channel, message in make_reader(file).iter_messages(["/tf"]):
            number = writer.register_schema(schema.name, schema.encoding, schema.data)
            number = writer.register_channel(channel.topic, channel.message_encoding, number)
            data = zstandard.ZstdCompressor().compress(message.data)
            writer.add_message(number, message.log_time, data, message.publish_time)
        writer.finish()
    log = RawLog(packed)
    assert not list(log.messages(["/tf"]))
    ((fault, count),) = log.faults.items()
    assert count == 2
    assert "/tf: its messages are compressed one by one by rosbag2" in fault


def test_a_cut_file_gives_what_is_before_the_cut(tmp_path):
    data = write_ros2(tmp_path / "log.mcap", ros2_sent(8), chunk_size=1500)
    whole = texts(tmp_path / "log.mcap")
    (tmp_path / "log.mcap").write_bytes(data[: len(data) // 4])
    log = RawLog(tmp_path / "log.mcap")
    left = texts(tmp_path / "log.mcap")
    assert 0 < len(left) < len(whole)
    assert left == whole[: len(left)]
    assert any("without its index" in text for text in log.warnings)
    total = log.faults.total()
    assert total > 0
    assert list(log.messages(log.topics))
    assert log.faults.total() == total  # reading again does not count it again


@pytest.mark.parametrize("by_topic", [False, True])
@pytest.mark.parametrize("finished", [True, False])
def test_a_folder_is_one_log_in_order_of_time(tmp_path, by_topic, finished):
    """by_topic: a file holds one; else the log is split by time, into eleven files."""
    sent = [(*one[:3], one[3] + n) for n, one in enumerate(ros2_sent(11))]
    topics = list(dict.fromkeys(one[0] for one in sent))
    bag = tmp_path / "bag"
    bag.mkdir()
    write_ros2(tmp_path / "whole.mcap", sent)
    for number in range(len(topics) if by_topic else 11):
        own = [one for one in sent if one[0] == topics[number]] if by_topic else None
        own = own or sent[15 * number : 15 * (number + 1)]
        write_ros2(bag / f"bag_{number}.mcap", own, chunk_size=1, finished=finished)
    log = RawLog(bag)
    told: list[tuple[int, int]] = []
    given = list(log.messages(log.topics, progress=lambda *done: told.append(done)))
    whole = list(RawLog(tmp_path / "whole.mcap").messages(log.topics))
    assert list(map(repr, given)) == list(map(repr, whole))
    assert len(given) == 165
    assert told[-1] == (log.size, log.size)
    assert [file.name for file in log.files[1:3]] == ["bag_1.mcap", "bag_2.mcap"]
    digests = "".join(file_digest(file) + "\n" for file in log.files)
    assert log.digest() == hashlib.blake2b(digests.encode(), digest_size=16).hexdigest()
    assert RawLog(tmp_path / "whole.mcap").digest() == file_digest(tmp_path / "whole.mcap")
