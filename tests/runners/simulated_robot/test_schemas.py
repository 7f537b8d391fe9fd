"""Messages as other implementations of ROS 2's encoding write and read them."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer

from chsel.sensing.depth_camera import PinholeCamera
from runners.simulated_robot import ros_messages
from runners.simulated_robot.schemas import TYPES, encode, schema_name, schema_text

CAMERA = PinholeCamera(5, 3, 7.25, 7.25, 2.0, 1.0)
STAMP = 1_700_000_000_123_456_789
POSE = np.array([[0.0, -1, 0, 0.5], [1, 0, 0, -0.25], [0, 0, 1, 2], [0, 0, 0, 1]])
IMAGE = np.arange(15, dtype=np.uint16).reshape(3, 5)
MESSAGES: dict[str, dict[str, Any]] = {
    "std_msgs/String": {"data": "begin 3"},
    "tf2_msgs/TFMessage": {
        "transforms": [ros_messages.transform("world", child, POSE, STAMP) for child in ("a", "bc")]
    },
    "sensor_msgs/Image": ros_messages.image("camera", IMAGE, STAMP),
    "sensor_msgs/CompressedImage": ros_messages.compressed_image("camera", IMAGE, STAMP),
    "sensor_msgs/CameraInfo": ros_messages.camera_info("camera", CAMERA, STAMP),
    "sensor_msgs/JointState": ros_messages.joint_state(("x", "why"), (0.5, -1.5), STAMP),
}


@pytest.mark.parametrize("kind", MESSAGES)
def test_bytes_are_those_of_the_ros_2_writer(kind: str) -> None:
    file = io.BytesIO()
    writer = Writer(file)
    schema = writer.register_msgdef(schema_name(kind), schema_text(kind))
    writer.write_message("/topic", schema, MESSAGES[kind], 1, 1)
    writer.finish()
    file.seek(0)
    ((_, _, message),) = make_reader(file).iter_messages()
    assert encode(kind, MESSAGES[kind]) == message.data


@pytest.mark.parametrize("kind", MESSAGES)
def test_what_is_written_is_read_again(kind: str) -> None:
    file = io.BytesIO()
    writer = Writer(file)
    schema = writer.register_msgdef(schema_name(kind), schema_text(kind))
    decode = DecoderFactory().decoder_for("cdr", schema)
    assert decode is not None
    assert _as_fields(kind, decode(encode(kind, MESSAGES[kind]))) == _plain(MESSAGES[kind])


def test_a_schema_defines_every_type_that_it_uses_once() -> None:
    text = schema_text("tf2_msgs/TFMessage")
    defined = [line.removeprefix("MSG: ") for line in text.splitlines() if line.startswith("MSG: ")]
    assert sorted(defined) == sorted(
        [
            "geometry_msgs/TransformStamped",
            "geometry_msgs/Transform",
            "geometry_msgs/Vector3",
            "geometry_msgs/Quaternion",
            "std_msgs/Header",
            "builtin_interfaces/Time",
        ]
    )


def test_a_fixed_array_of_another_length_is_refused() -> None:
    info = MESSAGES["sensor_msgs/CameraInfo"] | {"k": [1.0, 2.0]}
    with pytest.raises(ValueError, match="2 entries"):
        encode("sensor_msgs/CameraInfo", info)


def _as_fields(kind: str, message: Any) -> Any:
    fields = {}
    for field in TYPES[kind]:
        part, name = field.split()
        value, element = getattr(message, name), part.partition("[")[0]
        if element in TYPES:
            many = "[" in part
            value = (
                [_as_fields(element, item) for item in value]
                if many
                else _as_fields(element, value)
            )
        fields[name] = _plain(value)
    return fields


def _plain(value: Any) -> Any:
    """Sequences of any kind as lists."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, str | int | float):
        return value
    return [_plain(item) for item in value]
