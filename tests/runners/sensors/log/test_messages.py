"""Messages of ROS 2 and Foxglove: what they contain, and which are refused."""

from __future__ import annotations

import struct
import tracemalloc
from collections import Counter
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from mcap_ros2.writer import Writer

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
    UnusableMessage,
    WrenchMessage,
)
from runners.sensors.log.raw_log import RawLog
from runners.sensors.log.ros2 import ros2_decoder
from runners.sensors.log.ros2_definitions import defined_fields, full_definition
from runners.simulated_robot.ros_messages import joint_state
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
    "/info": CameraInfoMessage("camera", 5, 3, 400.0, 410.0, 2.0, 1.0),
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
    "/info": CameraInfoMessage("camera", 2, 2, 400.0, 410.0, 1.0, 0.5),
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
    assert set(log.faults) == {
        "/own: messages my_msgs/msg/Own as cdr are not read",
        "/image: messages sensor_msgs/msg/Image have other fields than those of ROS 2",
        "/json: messages foxglove.RawImage as json are not read",
    }


def test_a_hostile_message_costs_neither_time_nor_memory(tmp_path: Path) -> None:
    head = b"\0\1\0\0" + bytes(8) + b"\1\0\0\0\0" + bytes(3)
    many = struct.pack("<I", 2**32 - 1)
    hostile = [
        ("tf2_msgs/msg/TFMessage", b"\0\1\0\0" + many + bytes(1000)),
        ("sensor_msgs/msg/JointState", head + many + bytes(1000)),
        ("sensor_msgs/msg/JointState", bytes(2**21)),
        ("sensor_msgs/msg/PointCloud2", head + bytes(8) + many + bytes(2**21)),
        ("sensor_msgs/msg/PointCloud2", head + bytes(8) + struct.pack("<I", 16_000) + bytes(2**19)),
        ("std_msgs/msg/String", b"\0\1\0\0" + many + b"cut"),
    ]
    log = write_raw(
        tmp_path / "log.mcap",
        [(f"/{name}", name, "cdr", b"", data) for name, data in hostile],
    )
    assert list(log.messages(log.topics)) == []
    assert log.faults.total() == len(hostile)
    decode = ros2_decoder(hostile[4][0])
    assert decode is not None
    tracemalloc.start()
    with pytest.raises(UnusableMessage):
        list(decode(hostile[4][1]))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


JOINT_STATE = """
    # A comment; with uint8 nothing in it
    int32 MOST=7   # a constant
    Header header
    string<=10[] Name
    float64[<=6] position 0.0
    float64[] velocity
    float64[] effort"""


@pytest.mark.parametrize(
    ("text", "further"),
    [
        (JOINT_STATE, []),
        ("", []),
        (f"char more\n{JOINT_STATE}\nstring source", ["more", "source"]),
        (f'{JOINT_STATE}\nstring source "a=b"\nuint8 MOST = 7\nuint8 LEAST =1', ["source"]),
        (f"uint8[] more\n{JOINT_STATE}", None),
        (f"uint8 a__b\n{JOINT_STATE}", None),
        (f"{JOINT_STATE}\nOwn more", None),
        (f"{JOINT_STATE}\nuint8 name", None),
        (f"{JOINT_STATE}\nuint8 __class__", None),
        (JOINT_STATE.replace("float64[] vel", "float32[] vel"), None),
        (JOINT_STATE.replace("[] effort", "[6] effort"), None),
        (JOINT_STATE.replace("float64[] effort", ""), None),
        (" " * 10**6, None),
    ],
)
def test_definitions_may_add_numbers_and_texts(text: str, further: list[str] | None) -> None:
    fields = defined_fields("sensor_msgs/JointState", text)
    known = [field for _, field in defined_fields("sensor_msgs/JointState", "") or ()]
    if further is None:
        assert fields is None
    else:
        assert sorted(field for _, field in fields or ()) == sorted(known + further)


def test_messages_with_further_fields_are_read(tmp_path: Path) -> None:
    text = full_definition("sensor_msgs/JointState")
    own, _, parts = text.partition("=")
    text = f"uint16 sequence\n{own}string source\n={parts}"
    message = {"sequence": 7, **joint_state(["elbow"], [0.5], BEGIN), "source": "arm"}
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
    assert content == CameraInfoMessage(
        "camera", 160, 60, 200.0, 102.5, 110.0, 50.0, distorted=True
    )


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"k": [0.0] * 9}, "focal lengths are 0 and 0"),
        ({"d": [float("nan")]}, "accepted: finite"),
        ({"width": 0}, "0 x 3 pixels"),
        ({"height": 2**32 - 1}, "5 x 4294967295 pixels"),
    ],
)
def test_cameras_without_calibration_are_faults(
    tmp_path: Path, changes: dict[str, Any], reason: str
) -> None:
    content, fault = camera_info(tmp_path, **changes)
    assert content is None
    assert reason in fault
