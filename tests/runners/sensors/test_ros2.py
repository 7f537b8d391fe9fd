"""ROS 2 messages: their definitions, and what cameras say of their pixels."""

import struct
import tracemalloc
from pathlib import Path
from typing import Any

import pytest

from runners.sensors.log.messages import CameraInfoMessage, UnusableMessage
from runners.sensors.log.raw_log import RawLog
from runners.sensors.log.ros2 import ros2_decoder
from runners.sensors.log.ros2_definitions import has_known_fields
from tests.runners.sensors.small_logs import ros2_sent, write_ros2


def test_texts_may_differ_in_all_but_the_fields() -> None:
    text = """
    # A comment; with uint8 nothing in it
    int32 MOST=7   # a constant
    Header header
    string<=10[] Name
    float64[<=6] position 0.0
    float64[] velocity
    float64[] effort"""
    assert has_known_fields("sensor_msgs/JointState", text)
    assert not has_known_fields("sensor_msgs/JointState", f"uint8 more\n{text}")
    assert not has_known_fields(
        "sensor_msgs/JointState", text.replace("float64[] vel", "float32[] vel")
    )
    assert not has_known_fields("sensor_msgs/JointState", text.replace("[] effort", "[6] effort"))
    assert has_known_fields("sensor_msgs/JointState", "")
    assert not has_known_fields("sensor_msgs/JointState", " " * 10**6)


def test_a_cloud_of_more_fields_than_any_is_refused_before_they_are_made() -> None:
    decode = ros2_decoder("sensor_msgs/msg/PointCloud2")
    assert decode is not None
    head = b"\0\1\0\0" + bytes(8) + b"\1\0\0\0\0" + bytes(11)
    data = head + struct.pack("<I", 16_000) + bytes(2**19)
    tracemalloc.start()
    with pytest.raises(UnusableMessage):
        list(decode(data))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


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
