"""Bags of rosbag2 in sqlite3 and of ROS 1, as the package rosbags writes them, beside MCAP."""

import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from rosbags import rosbag1

from chsel.errors import SessionError
from chsel.sensing.depth_camera import PinholeCamera
from replay.files import file_digest
from replay.verbs.info import log_info
from runners.sensors.log.messages import CameraInfoMessage, TransformMessage
from runners.sensors.log.raw_log import RawLog
from tests.runners.sensors.bags import ROS1, write_ros1, write_rosbag2
from tests.runners.sensors.small_logs import SECOND, read, ros2_sent, write_ros2
from tests.runners.sensors.sphere_log import RIG, SphereLog

KINDS = (".db3", ".bag")


def bag_of(mcap, kind):
    """An MCAP file as a bag of a kind."""
    if kind == ".bag":
        return write_ros1(mcap, mcap.with_suffix(".bag"))
    return write_rosbag2(mcap, mcap.with_suffix(""))


def texts(path):
    log = RawLog(path)
    found = [repr(one) for one in log.messages(log.topics)]
    assert not log.faults
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_gives_the_messages_of_the_same_log_in_mcap(tmp_path, kind):
    mcap = tmp_path / "log.mcap"
    write_ros2(mcap, ros2_sent(3))
    bag = bag_of(mcap, kind)
    log, usual = RawLog(bag), RawLog(mcap)
    assert log.topics == usual.topics
    assert (log.begin, log.end) == (usual.begin, usual.end)
    assert texts(bag) == texts(mcap)
    assert log.digest() == file_digest(bag)
    told: list[tuple[int, int]] = []
    list(log.messages(["/probe"], progress=lambda *done: told.append(done)))
    assert told[-1] == (bag.stat().st_size,) * 2
    assert {row["topic"]: row["count"] for row in log_info(bag)["topics"]} == {
        row["topic"]: row["count"] for row in log_info(mcap)["topics"]
    }


@pytest.mark.parametrize("kind", KINDS)
def test_a_session_has_the_same_known_points_to_the_bit(tmp_path, kind):
    mcap = SphereLog().write(tmp_path / "log.mcap")
    _, usual, _ = read(mcap, RIG)
    _, probes, _ = read(bag_of(mcap, kind), RIG)
    assert len(probes) == len(usual) > 0
    for probe, other in zip(probes, usual, strict=True):
        for name in ("free", "occupied", "known", "sdf"):
            points = getattr(probe.new_points, name), getattr(other.new_points, name)
            np.testing.assert_array_equal(*points)


def test_a_folder_of_splits_is_one_log_and_what_it_lacks_is_told(tmp_path):
    sent = ros2_sent(6)
    write_ros2(tmp_path / "whole.mcap", sent)
    for number in range(2):
        part = tmp_path / f"part{number}.mcap"
        write_ros2(part, sent[45 * number : 45 * (number + 1)])
        file = write_rosbag2(part, tmp_path / f"bag{number}")
        (tmp_path / "bag").mkdir(exist_ok=True)
        shutil.move(file, tmp_path / "bag" / f"bag_{number}.db3")
    metadata = "rosbag2_bagfile_information: {relative_file_paths: [bag_0.db3, bag_1.db3%s]}"
    (tmp_path / "bag" / "metadata.yaml").write_text(metadata % "")
    assert texts(tmp_path / "bag") == texts(tmp_path / "whole.mcap")
    assert not RawLog(tmp_path / "bag").warnings
    (tmp_path / "bag" / "metadata.yaml").write_text(metadata % ", bag_2.db3")
    (warning,) = RawLog(tmp_path / "bag").warnings
    assert warning == "bag_2.db3: it is not there, though metadata.yaml lists it"


def test_a_file_without_metadata_or_definitions_is_read_by_those_of_ros2(tmp_path):
    """As bags before Iron are, which hold no definitions."""
    mcap = tmp_path / "log.mcap"
    write_ros2(mcap, ros2_sent(2))
    bag = write_rosbag2(mcap, tmp_path / "log")
    (bag.parent / "metadata.yaml").unlink()
    with sqlite3.connect(bag) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute("UPDATE schema SET schema_version = 3")
    database.close()
    assert texts(bag) == texts(mcap)


def test_camera_infos_and_transforms_of_ros1_have_their_names(tmp_path):
    """K and P of ROS 1 are k and p of ROS 2; tf/tfMessage is what tf2_msgs/TFMessage was."""
    time = ROS1.types["builtin_interfaces/msg/Time"](sec=7, nanosec=5)
    header = ROS1.types["std_msgs/msg/Header"](seq=3, stamp=time, frame_id="/cam")
    k, p = np.array([4.0, 0, 2, 0, 4, 1, 0, 0, 1]), np.array([3.0, 0, 2, 0, 0, 3, 1, 0, 0, 0, 1, 0])
    region = ROS1.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    info = ROS1.types["sensor_msgs/msg/CameraInfo"](
        header, 3, 5, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), p, 0, 0, region
    )
    vector, turn = (
        ROS1.types["geometry_msgs/msg/Vector3"],
        ROS1.types["geometry_msgs/msg/Quaternion"],
    )
    moved = ROS1.types["geometry_msgs/msg/Transform"](
        vector(1.0, 2.0, 3.0), turn(0.0, 0.0, 0.0, 1.0)
    )
    placed = ROS1.types["geometry_msgs/msg/TransformStamped"](header, "hand", moved)
    old = ROS1.types["tf/msg/tfMessage"]([placed])
    with rosbag1.Writer(tmp_path / "LOG.bag") as writer:
        for topic, message in (("/info", info), ("/tf", old)):
            kind = message.__msgtype__
            number = writer.add_connection(topic, kind, typestore=ROS1)
            writer.write(number, 7 * SECOND, ROS1.serialize_ros1(message, kind))
    log = RawLog(tmp_path / "LOG.bag")
    received = {one.topic: one for one in log.messages(log.topics)}
    assert not log.faults
    one, other = (PinholeCamera(5, 3, fx=f, fy=f, cx=2.0, cy=1.0) for f in (4.0, 3.0))
    assert received["/info"].content == CameraInfoMessage(one, rectified=other)
    assert received["/info"].stamp == 7 * SECOND + 5
    content = received["/tf"].content
    assert isinstance(content, TransformMessage)
    assert (content.parent, content.child) == ("cam", "hand")
    np.testing.assert_array_equal(content.parent_from_child[:3, 3], [1.0, 2.0, 3.0])


def test_a_bag_of_ros1s_own_recorder_is_read():
    """By rosbag 1.15.15 of Debian, compressed by bz2: five steps of an image and more."""
    log = RawLog(Path(__file__).parent / "rosbag_1_15.bag")
    received = list(log.messages(log.topics))
    assert not log.faults
    assert len(received) == 25
    assert (log.begin, log.end) == (1_700_000_000_123456789, 1_700_000_004_123456789)
    images = [one for one in received if one.topic == "/depth"]
    for step, one in enumerate(images):
        values = np.arange(500 + step, 512 + step).reshape(3, 4)
        np.testing.assert_array_equal(one.content.values, values)
        assert one.stamp == one.log_time == (1_700_000_000 + step) * SECOND + 123456789
    assert [one.content for one in received if one.topic == "/probe"][-1] == "begin 4"
    (wrench, *_) = [one.content for one in received if one.topic == "/wrench"]
    np.testing.assert_array_equal(wrench.force, [0.0, 0.0, -3.5])


def test_bags_that_were_not_finished_are_refused(tmp_path):
    """sqlite3 keeps the last messages beside the file; a bag of ROS 1 has its index at the end."""
    write_ros2(tmp_path / "log.mcap", ros2_sent(3))
    bag = write_ros1(tmp_path / "log.mcap", tmp_path / "log.bag")
    data = bag.read_bytes()
    bag.write_bytes(data[: len(data) // 2])
    with pytest.raises(
        SessionError, match=r"log\.bag cannot be read as a ROS 1 bag: .*`rosbag rei"
    ):
        RawLog(bag)
    bag.rename(tmp_path / "log.bag.active")
    with pytest.raises(SessionError, match=r"cannot be read as a ROS 1 bag"):
        RawLog(tmp_path / "log.bag.active")
    with pytest.raises(SessionError, match=r"has log\.bag\.active, which was not finished"):
        RawLog(tmp_path)
    file = write_rosbag2(tmp_path / "log.mcap", tmp_path / "log")
    file.with_name(f"{file.name}-wal").write_bytes(b"messages")
    with pytest.raises(SessionError, match=r"db3 is not finished: .*db3-wal holds a part of it"):
        RawLog(file)


def test_what_is_no_bag_is_one_line(tmp_path):
    (tmp_path / "log.db3").write_bytes(b"SQLite format 3\0")
    with pytest.raises(SessionError, match=r"log\.db3 cannot be read as a rosbag2 file in sqlite3"):
        RawLog(tmp_path / "log.db3")
    with sqlite3.connect(tmp_path / "other.db3") as database:
        database.execute("CREATE TABLE messages (id)")
    database.close()
    with pytest.raises(SessionError, match=r"other\.db3 cannot be read as a rosbag2 file"):
        RawLog(tmp_path / "other.db3")
    (tmp_path / "log.bag").write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(SessionError, match=r"is a folder with \.db3 and \.bag files; accepted: an"):
        RawLog(tmp_path)
