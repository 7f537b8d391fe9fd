"""Raw logs: what whole ones say, and what is left of damaged ones."""

import dataclasses
import hashlib
import shutil
import struct
import tracemalloc
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from chsel.errors import SessionError
from replay.files import file_digest
from replay.raw import raw_file, raw_reading
from replay.raw.channels import Channel
from replay.raw.raw_reading import RawMessage
from runners.sensors.log.log_files import merged, most_at_once
from runners.sensors.log.messages import (
    CameraInfoMessage,
    CloudMessage,
    ImageMessage,
    JointsMessage,
    MarkerMessage,
    PoseMessage,
    Received,
    TransformMessage,
    WrenchMessage,
)
from runners.sensors.log.raw_log import RawLog
from tests.runners.sensors.small_logs import (
    BEGIN,
    SECOND,
    depth,
    foxglove_sent,
    png,
    ros2_image,
    ros2_sent,
    write_foxglove,
    write_ros2,
)

TURNED = np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])
MAGIC = 8  # bytes


def read(path: Path, *topics: str) -> list[Received]:
    log = RawLog(path)
    return list(log.messages(topics or log.topics))


def by_topic(path: Path) -> dict[str, Received]:
    """The last message of each topic."""
    return {received.topic: received for received in read(path)}


def test_a_ros2_log_is_read_as_it_was_written(tmp_path: Path) -> None:
    write_ros2(tmp_path / "log.mcap", ros2_sent(4))
    log = RawLog(tmp_path / "log.mcap")
    assert log.topics["/depth"].schema == "sensor_msgs/msg/Image"
    assert {topic.count for topic in log.topics.values()} == {4}
    assert (log.begin, log.end) == (BEGIN + 10**6, BEGIN + 3 * SECOND + 10**6)
    last = by_topic(tmp_path / "log.mcap")
    assert len(last) == 15
    wrench = last["/wrench"].content
    assert isinstance(wrench, WrenchMessage)
    assert (wrench.frame, wrench.force.tolist()) == ("hand", [1.0, 2.0, -3.0])
    assert wrench.torque.tolist() == [0.25, 0.0, 0.5]
    assert not log.faults
    assert not log.warnings
    stamp = BEGIN + 3 * SECOND
    assert (last["/depth"].stamp, last["/depth"].log_time) == (stamp, stamp + 10**6)
    for topic in ("/depth", "/compressed"):
        image = last[topic].content
        assert isinstance(image, ImageMessage)
        assert image.frame == "camera"
        assert image.values.dtype == np.uint16
        np.testing.assert_array_equal(image.values, depth(3))
    info = last["/info"].content
    assert info == CameraInfoMessage("camera", 5, 3, 400.0, 410.0, 2.0, 1.0)
    for topic, static in (("/tf", False), ("/tf_static", True)):
        transform = last[topic].content
        assert isinstance(transform, TransformMessage)
        assert transform.static == static
    transform = last["/tf"].content
    assert isinstance(transform, TransformMessage)
    assert (transform.parent, transform.child) == ("world", "base")
    np.testing.assert_array_equal(transform.parent_from_child[:, 3], [3.0, 0.0, 0.0, 1.0])
    pose = last["/pose"].content
    assert isinstance(pose, PoseMessage)
    np.testing.assert_allclose(pose.frame_from_body, TURNED, atol=1e-15)
    joints = last["/joints"].content
    assert joints == JointsMessage({"elbow": 0.5, "wrist": -0.25})
    for topic, points in (
        ("/cloud", [[0, 1, 2], [3, 4, 5]]),
        ("/poses", [[1, 2, 3], [1, 2, 3]]),
        ("/point", [[1, 0, 2]]),
    ):
        cloud = last[topic].content
        assert isinstance(cloud, CloudMessage)
        np.testing.assert_array_equal(cloud.points, points)
    for topic, text in (("/probe", "begin 3"), ("/touch", "false"), ("/count", "-3")):
        assert last[topic].content == MarkerMessage(text)
        assert last[topic].stamp is None


def test_inverse_depth_becomes_metres(tmp_path: Path) -> None:
    write_ros2(tmp_path / "log.mcap", ros2_sent(1))
    image = by_topic(tmp_path / "log.mcap")["/quantised"].content
    assert isinstance(image, ImageMessage)
    assert image.values.dtype == np.float32
    np.testing.assert_allclose(image.values, 100.0 / (depth(0).astype(float) + 20.0), rtol=1e-6)


def test_foxglove_messages_say_the_same(tmp_path: Path) -> None:
    write_foxglove(tmp_path / "log.mcap", foxglove_sent())
    found = by_topic(tmp_path / "log.mcap")
    assert found["/depth"].stamp == BEGIN + 5
    image, packed = found["/depth"].content, found["/compressed"].content
    assert isinstance(image, ImageMessage)
    assert isinstance(packed, ImageMessage)
    np.testing.assert_array_equal(image.values, np.float32([[0.5, np.nan], [0.25, 2.0]]))
    np.testing.assert_array_equal(packed.values, depth())
    assert found["/info"].content == CameraInfoMessage("camera", 2, 2, 400.0, 410.0, 1.0, 0.5)
    for topic in ("/tf", "/transforms"):
        transform = found[topic].content
        assert isinstance(transform, TransformMessage)
        expected = TURNED.copy()
        expected[:3, 3] = 1.0, 0.0, 0.0
        np.testing.assert_allclose(transform.parent_from_child, expected, atol=1e-15)
    pose, poses, cloud = (found[topic].content for topic in ("/pose", "/poses", "/cloud"))
    assert isinstance(pose, PoseMessage)
    assert isinstance(poses, CloudMessage)
    assert isinstance(cloud, CloudMessage)
    np.testing.assert_allclose(pose.frame_from_body, TURNED, atol=1e-15)
    np.testing.assert_array_equal(poses.points, [[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(cloud.points, [[1.0, 3.0, 3.0]])  # moved by the cloud's pose
    assert found["/log"].content == MarkerMessage("begin 1")
    assert found["/pair"].content == MarkerMessage("begin 2")


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("finished", [True, False])
def test_files_of_all_kinds_give_the_same(
    tmp_path: Path, compression: CompressionType, finished: bool
) -> None:
    write_ros2(tmp_path / "usual.mcap", ros2_sent(3))
    write_ros2(tmp_path / "log.mcap", ros2_sent(3), compression=compression)
    if not finished:  # as a recorder that was killed leaves it
        data = (tmp_path / "log.mcap").read_bytes()
        start = struct.unpack_from("<Q", data, len(data) - MAGIC - 20)[0]
        (tmp_path / "log.mcap").write_bytes(data[: start - 13])  # without summary and data end
    log = RawLog(tmp_path / "log.mcap")
    assert log.topics == RawLog(tmp_path / "usual.mcap").topics
    assert texts(log.messages(log.topics)) == texts(read(tmp_path / "usual.mcap"))
    assert bool(log.faults) == (not finished)


def texts(received: object) -> list[str]:
    """What messages say, as text that can be compared."""
    return [repr(one) for one in received]  # type: ignore[attr-defined]


def test_messages_come_in_order_of_log_time_across_chunks(tmp_path: Path) -> None:
    sent = ros2_sent(6)
    mixed = [sent[i] for i in np.random.default_rng(0).permutation(len(sent))]
    write_ros2(tmp_path / "log.mcap", mixed, chunk_size=300)
    times = [received.log_time for received in read(tmp_path / "log.mcap")]
    assert len(times) == len(sent)
    assert times == sorted(times)


def test_chunks_that_all_overlap_are_not_all_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = ros2_sent(6)
    mixed = [sent[i] for i in np.random.default_rng(0).permutation(len(sent))]
    write_ros2(tmp_path / "log.mcap", mixed, chunk_size=300)
    ordered = Counter(texts(read(tmp_path / "log.mcap")))
    monkeypatch.setattr(raw_file, "MOST_HELD", 1000)
    log = RawLog(tmp_path / "log.mcap")
    received = list(log.messages(log.topics))
    assert [one.log_time for one in received] != sorted(one.log_time for one in received)
    assert Counter(texts(received)) == ordered
    assert any("in another order" in remark for remark in log.warnings)


def test_a_damaged_index_is_not_believed(tmp_path: Path) -> None:
    data = bytearray(write_ros2(tmp_path / "log.mcap", ros2_sent(2)))
    topics = RawLog(tmp_path / "log.mcap").topics
    data[data.rindex(b"/probe") + 1] ^= 1
    (tmp_path / "log.mcap").write_bytes(data)
    log = RawLog(tmp_path / "log.mcap")
    assert log.topics == topics
    assert log.warnings == ["log.mcap: it is read without its index: its checksum is wrong"]


def test_a_stamp_of_zero_is_none(tmp_path: Path) -> None:
    write_ros2(tmp_path / "log.mcap", [("/depth", "sensor_msgs/Image", ros2_image(depth(), 0), 9)])
    (received,) = read(tmp_path / "log.mcap")
    assert (received.stamp, received.log_time) == (None, 9)


def test_times_that_do_not_fit_are_faults(tmp_path: Path) -> None:
    late = ("/probe", "std_msgs/String", {"data": "end"}, 2**63)
    write_ros2(tmp_path / "log.mcap", [*ros2_sent(1), late])
    log = RawLog(tmp_path / "log.mcap")
    assert len(list(log.messages(["/probe"]))) == 1
    assert log.faults == {"/probe: a message at a time beyond the end of time": 1}


def test_an_index_of_another_file_is_not_believed(tmp_path: Path) -> None:
    data = write_ros2(tmp_path / "log.mcap", ros2_sent(4))
    whole = texts(read(tmp_path / "log.mcap"))
    metadata = struct.pack("<BQIII", 0x0C, 12, 0, 0, 0)  # a record ahead of the first chunk
    place = data.index(b"\x04\0\0\0zstd") - 37
    moved = data[:place] + metadata + data[place:]
    start = struct.unpack_from("<Q", moved, len(moved) - MAGIC - 20)[0] + len(metadata)
    struct_at = len(moved) - MAGIC - 20
    moved = moved[:struct_at] + struct.pack("<QQI", start, 0, 0) + moved[-MAGIC:]
    (tmp_path / "log.mcap").write_bytes(moved)
    log = RawLog(tmp_path / "log.mcap")
    assert log.warnings == ["log.mcap: it is read without its index: its index is another file's"]
    assert texts(log.messages(log.topics)) == whole


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
    given = log.messages(
        ["/probe", "/nothing"],
        begin=BEGIN + SECOND,
        end=BEGIN + 4 * SECOND + 10**6,
        progress=lambda done, total: told.append((done, total)),
    )
    contents = [received.content for received in given]
    assert contents == [MarkerMessage(f"begin {step}") for step in (1, 2, 3)]
    assert told[-1] == (log.size, log.size)


def test_a_topic_that_is_not_there_is_an_error_that_lists_the_others(tmp_path: Path) -> None:
    write_ros2(tmp_path / "log.mcap", ros2_sent(1))
    with pytest.raises(SessionError, match=r"no topic /a; it has .*/depth \(sensor_msgs/msg/Ima"):
        RawLog(tmp_path / "log.mcap").messages(["/a"])


@pytest.mark.parametrize("content", [b"", b"SQLite format 3\0", b"\x89MCAP1\r\n"])
def test_what_is_no_log_is_an_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "log.mcap").write_bytes(content)
    with pytest.raises(SessionError, match=r"log\.mcap is no MCAP file"):
        RawLog(tmp_path / "log.mcap")
    with pytest.raises(SessionError, match=r"other\.mcap does not exist"):
        RawLog(tmp_path / "other.mcap")
    (tmp_path / "folder").mkdir()
    with pytest.raises(SessionError, match=r"without \.mcap files"):
        RawLog(tmp_path / "folder")


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_damaged_chunk_costs_its_own_messages_alone(
    tmp_path: Path, compression: CompressionType
) -> None:
    path = tmp_path / "log.mcap"
    data = bytearray(write_ros2(path, ros2_sent(8), chunk_size=1500, compression=compression))
    whole = Counter(texts(read(path)))
    name = compression.name.lower() if compression != CompressionType.NONE else "begin 5"
    data[data.index(name.encode(), len(data) // 3) + 6] ^= 1
    (tmp_path / "log.mcap").write_bytes(data)
    log = RawLog(tmp_path / "log.mcap")
    left = Counter(texts(log.messages(log.topics)))
    assert left < whole
    assert left.total() > 0.5 * whole.total()
    assert log.faults.total() == 1
    assert list(log.messages(log.topics))
    assert log.faults.total() == 1  # reading again does not count it again


@pytest.mark.parametrize("part", [0.1, 0.25, 0.4])
def test_a_cut_file_gives_what_is_before_the_cut(tmp_path: Path, part: float) -> None:
    data = write_ros2(tmp_path / "log.mcap", ros2_sent(8), chunk_size=1500)
    whole = texts(read(tmp_path / "log.mcap"))
    (tmp_path / "log.mcap").write_bytes(data[: int(part * len(data))])
    log = RawLog(tmp_path / "log.mcap")
    left = texts(log.messages(log.topics))
    assert 0 < len(left) < len(whole)
    assert left == whole[: len(left)]
    assert any("without its index" in remark for remark in log.warnings)
    assert log.faults


def test_behind_a_broken_length_the_next_chunk_is_found(tmp_path: Path) -> None:
    data = bytearray(write_ros2(tmp_path / "log.mcap", ros2_sent(8), chunk_size=1500))
    whole = Counter(texts(read(tmp_path / "log.mcap")))
    third = [i for i in range(len(data)) if data.startswith(b"\x04\0\0\0zstd", i)][2]
    data[third - 28 - 2] = 0xFF  # in the length of its record
    del data[-30:]  # and no index
    (tmp_path / "log.mcap").write_bytes(data)
    left = Counter(texts(read(tmp_path / "log.mcap")))
    assert left < whole
    assert left.total() > 0.5 * whole.total()


def test_a_file_of_false_chunks_is_not_searched_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = write_ros2(tmp_path / "log.mcap", ros2_sent(4), chunk_size=1500)
    data = data[: struct.unpack_from("<Q", data, len(data) - MAGIC - 20)[0] - 13]
    heads, count, each = [], 3000, 53
    for index in range(count):  # each of them seems to reach up to the end of the file
        rest = each * (count - index) - 9
        head = struct.pack("<BQQQQII", 6, rest, 0, 0, 10, 0, 4) + b"zstd"
        heads.append(head + struct.pack("<Q", rest - 44))
    (tmp_path / "log.mcap").write_bytes(data + b"\0" + b"".join(heads))
    few = dataclasses.replace(raw_reading.LIMITS, size=2**20)
    monkeypatch.setattr(raw_reading, "LIMITS", few)
    log = RawLog(tmp_path / "log.mcap")
    assert 10 < log.faults.total() < count / 2
    assert list(log.messages(log.topics))


def test_a_monstrous_chunk_is_passed_by(tmp_path: Path) -> None:
    data = bytearray(write_ros2(tmp_path / "log.mcap", ros2_sent(4), chunk_size=1500))
    mark = data.index(b"\x04\0\0\0zstd")
    struct.pack_into("<Q", data, mark - 12, 2**62)  # its size, unpacked
    (tmp_path / "log.mcap").write_bytes(data)
    log = RawLog(tmp_path / "log.mcap")
    assert list(log.messages(log.topics))
    assert any("claims 4611686018427387904 bytes" in fault for fault in log.faults)


def test_broken_messages_are_counted_with_their_topic(tmp_path: Path) -> None:
    good = ros2_sent(1)
    images = [
        {"encoding": "rgb8"},
        {"height": 2**31},
        {"step": 1},
        {"data": b""},
        {"header": {"stamp": {"sec": -1, "nanosec": 0}, "frame_id": "a\nb"}},
    ]
    changed = [("/depth", "sensor_msgs/Image", ros2_image(depth(), 5, **c), 9) for c in images]
    pictures = [
        {"header": {}, "format": "jpeg", "data": b"\xff\xd8\xff"},
        {"header": {}, "format": "png", "data": png(depth())[:60]},
        {"header": {}, "format": "png", "data": png(depth().astype(np.uint8))},
        {"header": {}, "format": "16UC1; compressedDepth", "data": b"short"},
    ]
    changed += [("/compressed", "sensor_msgs/CompressedImage", c, 9) for c in pictures]
    zero = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 0.0}
    lost = {"position": {"x": np.nan}, "orientation": {"w": 1.0}}
    for pose in ({"position": {}, "orientation": zero}, lost):
        changed.append(("/pose", "geometry_msgs/PoseStamped", {"header": {}, "pose": pose}, 9))
    write_ros2(tmp_path / "log.mcap", [*good, *changed])
    log = RawLog(tmp_path / "log.mcap")
    assert len(list(log.messages(log.topics))) == len(good)
    counts = Counter(fault.partition(":")[0] for fault in log.faults.elements())
    assert counts == {"/depth": len(images), "/compressed": len(pictures), "/pose": 2}
    said = " ".join(log.faults)
    for reason in ("'rgb8' is no depth", "JPEG", "16, grey", "quaternion is 0, 0, 0, 0", "nan"):
        assert reason in said


def test_unknown_schemas_and_fields_are_faults(tmp_path: Path) -> None:
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        for topic, name, encoding, text in (
            ("/own", "my_msgs/msg/Own", "cdr", b"float64[999999999] x"),
            ("/image", "sensor_msgs/msg/Image", "cdr", b"Image[] nested # of itself"),
            ("/json", "foxglove.RawImage", "json", b"{}"),
            ("/string", "std_msgs/msg/String", "cdr", b"string data # as usual"),
        ):
            schema = writer.register_schema(name, "ros2msg", text)
            channel = writer.register_channel(topic, encoding, schema)
            writer.add_message(channel, 1, b"\0\1\0\0\4\0\0\0end\0", 1)
        writer.finish()
    log = RawLog(tmp_path / "log.mcap")
    assert [received.content for received in log.messages(log.topics)] == [MarkerMessage("end")]
    assert set(log.faults) == {
        "/own: messages my_msgs/msg/Own as cdr are not read",
        "/image: messages sensor_msgs/msg/Image have other fields than those of ROS 2",
        "/json: messages foxglove.RawImage as json are not read",
    }


def test_a_hostile_message_costs_neither_time_nor_memory(tmp_path: Path) -> None:
    head = b"\0\1\0\0" + bytes(8) + b"\1\0\0\0\0" + bytes(3)
    many = struct.pack("<I", 2**32 - 1)
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        for name, data in (
            ("tf2_msgs/msg/TFMessage", b"\0\1\0\0" + many + bytes(1000)),
            ("sensor_msgs/msg/JointState", head + many + bytes(1000)),
            ("sensor_msgs/msg/JointState", bytes(2**21)),
            ("sensor_msgs/msg/PointCloud2", head + bytes(8) + many + bytes(2**21)),
            ("std_msgs/msg/String", b"\0\1\0\0" + many + b"cut"),
        ):
            schema = writer.register_schema(name, "", b"")
            channel = writer.register_channel(f"/{name}", "cdr", schema)
            writer.add_message(channel, 1, data, 1)
        writer.finish()
    log = RawLog(tmp_path / "log.mcap")
    assert list(log.messages(log.topics)) == []
    assert log.faults.total() == 5


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
        for of, p in ((log, lambda *done: told.append(done)), (RawLog(whole), None))
    ]
    assert len(both[0]) > 80
    assert both[0] == both[1]
    assert told[-1] == (log.size, log.size)
    assert all(done <= log.size for done, _ in told)


def test_of_successive_files_one_is_open_at_a_time() -> None:
    opened: list[int] = []

    def read(number: int) -> Iterator[RawMessage]:
        opened.append(number)
        for time in range(*spans[number]):
            yield RawMessage(Channel(str(number), "", ""), time, b"")

    spans = [(10, 20), (0, 8), (20, 30), (25, 40)]
    times, at_once = [], []
    for message in merged(spans, read):
        times.append(message.log_time)
        at_once.append(len(opened))
    assert times == sorted([*range(8), *range(10, 30), *range(25, 40)])
    assert opened == [1, 0, 2, 3]
    assert [at_once[times.index(time)] for time in (7, 19, 24, 26)] == [1, 2, 3, 4]
    assert [most_at_once(part) for part in (spans, spans[:2], [(0, 9)] * 5)] == [2, 1, 5]


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
