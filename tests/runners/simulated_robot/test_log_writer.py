"""What the simulated robot writes is what other implementations of ROS 2's encoding read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from chsel.sensing.depth_camera import PinholeCamera
from runners.simulated_robot import log_writer
from runners.simulated_robot.log_writer import LogWriter

CAMERA = PinholeCamera(5, 3, 7.25, 7.25, 2.0, 1.0)
STAMP = 1_700_000_000_123_456_789
POSE = np.array([[0.0, -1, 0, 0.5], [1, 0, 0, -0.25], [0, 0, 1, 2], [0, 0, 0, 1]])
IMAGE = np.arange(15, dtype=np.uint16).reshape(3, 5)
MESSAGES: dict[str, dict[str, Any]] = {
    "std_msgs/String": {"data": "begin 3"},
    "tf2_msgs/TFMessage": {
        "transforms": [log_writer.transform("world", child, POSE, STAMP) for child in ("a", "bc")]
    },
    "sensor_msgs/Image": log_writer.image("camera", IMAGE, STAMP),
    "sensor_msgs/CompressedImage": log_writer.compressed_image("camera", IMAGE, STAMP),
    "sensor_msgs/CameraInfo": log_writer.camera_info("camera", CAMERA, STAMP),
    "sensor_msgs/JointState": log_writer.joint_state(["x", "why"], [0.5, -1.5], STAMP),
}


def test_messages_are_written_in_the_order_of_their_arrival(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log.mcap") as log:
        for index, (kind, message) in enumerate(MESSAGES.items()):
            log.add(f"/{kind}", kind, message, stamp=index, log_time=100 - index)
        log.flush(97)
    with (tmp_path / "log.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        found = list(reader.iter_decoded_messages(log_time_order=False))
    assert [message.log_time for _, _, message, _ in found] == [95, 96, 97, 98, 99, 100]
    for schema, _, message, decoded in found:
        kind = schema.name.replace("/msg/", "/")
        assert message.publish_time == 100 - message.log_time
        assert plain(decoded) == plain(MESSAGES[kind])


def plain(value: Any) -> Any:
    """Messages as mappings, and sequences of any kind as lists."""
    if hasattr(value, "__slots__") and hasattr(value, "_type"):
        value = {name: getattr(value, name) for name in value.__slots__}
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, str | int | float):
        return value
    return [plain(item) for item in value]
