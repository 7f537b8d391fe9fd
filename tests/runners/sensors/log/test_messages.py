"""Messages of ROS 2 and Foxglove: what they contain, and which are refused."""

from __future__ import annotations

from collections import Counter
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from mcap_ros2.writer import Writer

from chsel.sensing.depth_camera import PinholeCamera
from runners.sensors.log.messages import (
    CameraInfoMessage,
    CloudMessage,
    Content,
    ImageMessage,
    JointsMessage,
    MarkerMessage,
    PoseMessage,
    Received,
    TransformMessage,
    WrenchMessage,
)
from runners.sensors.log.raw_log import RawLog
from runners.sensors.log.ros2_definitions import full_definition
from runners.simulated_robot.log_writer import joint_state
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


def moved(x: float, y: float, z: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def turned(x: float) -> np.ndarray:
    pose = TURNED.copy()
    pose[:3, 3] = x, 0.0, 0.0
    return pose


ROS2: dict[str, Content] = {  # of step 3
    "/tf_static": TransformMessage("base", "camera", moved(0, 0, 1), static=True),
    "/tf": TransformMessage("world", "base", moved(3, 0, 0)),
    "/depth": ImageMessage("camera", depth(3)),
    "/compressed": ImageMessage("camera", depth(3)),
    "/quantised": ImageMessage("camera", (100.0 / (depth(3) + 20.0)).astype(np.float32)),
    "/info": CameraInfoMessage("camera", PinholeCamera(5, 3, 400.0, 410.0, 2.0, 1.0)),
    "/pose": PoseMessage("base", TURNED),
    "/poses": CloudMessage("base", np.array([[1.0, 2, 3], [1, 2, 3]])),
    "/point": CloudMessage("base", np.array([[1.0, 0, 2]])),
    "/wrench": WrenchMessage("hand", np.array([1.0, 2, -3]), np.array([0.25, 0, 0.5])),
    "/joints": JointsMessage({"elbow": 0.5, "wrist": -0.25}),
    "/cloud": CloudMessage("lidar", np.array([[0.0, 1, 2], [3, 4, 5]])),
    "/probe": MarkerMessage("begin 3"),
    "/touch": MarkerMessage("false"),
    "/count": MarkerMessage("-3"),
}
FOXGLOVE: dict[str, Content] = {
    "/tf": TransformMessage("world", "base", turned(1)),
    "/transforms": TransformMessage("world", "base", turned(1)),
    "/depth": ImageMessage("camera", np.array([[0.5, np.nan], [0.25, 2.0]], np.float32)),
    "/compressed": ImageMessage("camera", depth()),
    "/info": CameraInfoMessage("camera", PinholeCamera(2, 2, 400.0, 410.0, 1.0, 0.5)),
    "/pose": PoseMessage("base", TURNED),
    "/poses": CloudMessage("base", np.array([[1.0, 2, 3]])),
    "/cloud": CloudMessage("lidar", np.array([[1.0, 3, 3]])),  # moved by the cloud's pose
    "/log": MarkerMessage("begin 1"),
    "/pair": MarkerMessage("begin 2"),
}


def by_topic(path: Path) -> dict[str, Received]:
    """The last message of each topic."""
    log = RawLog(path)
    received = {one.topic: one for one in log.messages(log.topics)}
    assert not log.faults
    assert not log.warnings
    return received


def assert_same(found: Content, expected: Content) -> None:
    assert type(found) is type(expected)
    for field in fields(expected):
        one, other = getattr(found, field.name), getattr(expected, field.name)
        if isinstance(other, np.ndarray):
            assert one.dtype == other.dtype
            np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-15)
        else:
            assert one == other


@pytest.mark.parametrize(("encoding", "expected"), [("ros2", ROS2), ("foxglove", FOXGLOVE)])
def test_messages_of_both_encodings_are_decoded(
    tmp_path: Path, encoding: str, expected: dict[str, Content]
) -> None:
    if encoding == "ros2":
        write_ros2(tmp_path / "log.mcap", ros2_sent(4))
    else:
        write_foxglove(tmp_path / "log.mcap", foxglove_sent())
    found = by_topic(tmp_path / "log.mcap")
    assert found.keys() == expected.keys()
    for topic, received in found.items():
        assert_same(received.content, expected[topic])
    stamp = BEGIN + 3 * SECOND if encoding == "ros2" else BEGIN + 5
    assert found["/depth"].stamp == stamp
    assert found["/probe" if encoding == "ros2" else "/pair"].stamp is None


def test_a_stamp_of_zero_is_none(tmp_path: Path) -> None:
    write_ros2(tmp_path / "log.mcap", [("/depth", "sensor_msgs/Image", ros2_image(depth(), 0), 9)])
    received = by_topic(tmp_path / "log.mcap")["/depth"]
    assert (received.stamp, received.log_time) == (None, 9)


def test_broken_messages_are_counted_with_their_topic(tmp_path: Path) -> None:
    good = ros2_sent(1)
    images = [
        {"encoding": "rgb8"},
        {"height": 2**31},
        {"step": 1},
        {"data": b""},
        {"header": {"stamp": {"sec": -1, "nanosec": 0}, "frame_id": "a"}},
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
    wrench = {"header": {}, "wrench": {"force": {"x": np.nan}, "torque": {}}}
    changed.append(("/wrench", "geometry_msgs/WrenchStamped", wrench, 9))
    write_ros2(tmp_path / "log.mcap", [*good, *changed])
    log = RawLog(tmp_path / "log.mcap")
    assert len(list(log.messages(log.topics))) == len(good)
    counts = Counter(fault.partition(":")[0] for fault in log.faults.elements())
    assert counts == {"/depth": len(images), "/compressed": len(pictures), "/pose": 2, "/wrench": 1}
    said = " ".join(log.faults)
    for reason in (
        "a force or torque is not finite",
        "'rgb8' is no depth",
        "JPEG",
        "accepted: 16 bit",
        "quaternion is 0, 0, 0, 0",
        "nan",
    ):
        assert reason in said


def write_raw(path: Path, sent: list[tuple[str, str, str, bytes, bytes]]) -> RawLog:
    """A log of messages as topic, schema, encoding, definition and bytes."""
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        for topic, name, encoding, definition, data in sent:
            schema = writer.register_schema(name, "ros2msg", definition)
            channel = writer.register_channel(topic, encoding, schema)
            writer.add_message(channel, 1, data, 1)
        writer.finish()
    return RawLog(path)


def test_unknown_schemas_and_fields_are_faults(tmp_path: Path) -> None:
    data = b"\0\1\0\0\4\0\0\0end\0"
    log = write_raw(
        tmp_path / "log.mcap",
        [
            ("/own", "my_msgs/msg/Own", "cdr", b"float64[999999999] x", data),
            ("/image", "sensor_msgs/msg/Image", "cdr", b"Image[] nested # of itself", data),
            ("/json", "foxglove.RawImage", "json", b"{}", data),
            ("/string", "std_msgs/msg/String", "cdr", b"string data # as usual", data),
        ],
    )
    assert [received.content for received in log.messages(log.topics)] == [MarkerMessage("end")]
    reasons = dict(text.split(": ", 1) for text in log.faults)
    assert reasons["/own"] == "messages my_msgs/msg/Own as cdr are not read"
    assert reasons["/json"] == "messages foxglove.RawImage as json are not read"
    assert "sensor_msgs/msg/Image" in reasons["/image"]
    assert len(reasons) == 3


def test_messages_with_further_fields_are_read(tmp_path: Path) -> None:
    text = full_definition("sensor_msgs/JointState")
    own, _, parts = text.partition("=")
    own = f"# A comment; with uint8 in it\nint32 MOST=7\nuint16 sequence\n{own}Own[] more\n"
    text = f"{own}={parts}{'=' * 80}\nMSG: sensor_msgs/Own\nstring source\n"
    message = {"sequence": 7, **joint_state(["elbow"], [0.5], BEGIN), "more": [{"source": "arm"}]}
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", text)
        writer.write_message("/joints", schema, message, BEGIN)
        writer.finish()
    assert by_topic(tmp_path / "log.mcap")["/joints"].content == JointsMessage({"elbow": 0.5})


def camera_info(path: Path, **changes: Any) -> tuple[object, str]:
    """What a changed sensor_msgs/CameraInfo says, and the fault if it says nothing."""
    topic, kind, message, log_time = next(one for one in ros2_sent(1) if one[0] == "/info")
    write_ros2(path / "log.mcap", [(topic, kind, {**message, **changes}, log_time)])
    log = RawLog(path / "log.mcap")
    received = list(log.messages(["/info"]))
    return (received[0].content if received else None), "".join(log.faults)


def test_intrinsics_are_those_of_the_pixels_that_are_sent(tmp_path: Path) -> None:
    region = {"x_offset": 100, "y_offset": 40, "width": 320, "height": 240, "do_rectify": False}
    content, _ = camera_info(
        tmp_path,
        width=640,
        height=480,
        k=[400.0, 0.0, 320.0, 0.0, 410.0, 240.0, 0.0, 0.0, 1.0],
        d=[0.0, 0.1],
        binning_x=2,
        binning_y=4,
        roi=region,
    )
    camera = PinholeCamera(160, 60, 200.0, 102.5, 110.0, 50.0)
    assert content == CameraInfoMessage("camera", camera, distorted=True)
