"""ROS 2 messages, as CDR, decoded."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from mcap.records import Schema

from chsel.sensing.depth_camera import PinholeCamera
from runners.sensors.log import message_fields as fields
from runners.sensors.log.images import compressed_pixels, pixel_rows
from runners.sensors.log.messages import (
    CameraInfoMessage,
    CloudMessage,
    Content,
    Decode,
    Decoded,
    ImageMessage,
    JointsMessage,
    UnusableMessage,
    WrenchMessage,
)
from runners.sensors.log.ros2_definitions import DEFINITIONS, full_definition, short_name

_LARGEST_FORCE = 1e6  # N, Nm


def ros2_decoder(name: str, definition: str | None = None) -> Decode | None:
    """Decodes messages of this name; None for one that is not read.

    definition: of the schema in the file, by which messages are decoded; by default that of ROS 2.
    Raises UnusableMessage for one that is not understood.
    """
    from mcap_ros2.decoder import DecoderFactory  # of the extra "sensors"

    short = short_name(name)
    contents = _CONTENTS.get(short)
    if contents is None:
        return None
    text = definition if definition and definition.strip() else full_definition(short)
    schema = Schema(id=1, data=text.encode(), encoding="ros2msg", name=short)
    try:
        parse = DecoderFactory().decoder_for("cdr", schema)
    except Exception as error:  # the parser raises whatever it stumbles over
        raise UnusableMessage(f"the definition of {name} is not read: {error}") from None
    assert parse is not None
    return fields.decoder(name, parse, contents)


def _stamp(header: Any) -> int | None:
    return fields.stamp_of(header.stamp.sec, header.stamp.nanosec)


def _image(message: Any, frame: str) -> ImageMessage:
    values = pixel_rows(
        message.data,
        message.encoding,
        (message.width, message.height),
        message.step,
        big_endian=message.is_bigendian != 0,
    )
    return ImageMessage(frame, values)


def _compressed_image(message: Any, frame: str) -> ImageMessage:
    return ImageMessage(frame, compressed_pixels(message.data, message.format))


def _camera_info(message: Any, frame: str) -> CameraInfoMessage:
    """Of the pixels that are sent: a region of the sensor, and several of its pixels as one."""
    region, across, down = message.roi, max(message.binning_x, 1), max(message.binning_y, 1)
    fx, _, cx, _, fy, cy, *_ = message.k
    camera = PinholeCamera(
        (region.width or message.width) // across,
        (region.height or message.height) // down,
        fx / across,
        fy / down,
        (cx - region.x_offset) / across,
        (cy - region.y_offset) / down,
    )
    return CameraInfoMessage(frame, camera, distorted=any(message.d))


def _cloud(message: Any, frame: str) -> CloudMessage:
    points = fields.packed_points(
        message.data,
        {part.name: (part.offset, part.datatype) for part in message.fields},
        message.point_step,
        size=(message.width, message.height),
        row=message.row_step,
        big_endian=message.is_bigendian,
    )
    return CloudMessage(frame, points)


def _wrench(message: Any, frame: str) -> WrenchMessage:
    force, torque = fields.positions([message.wrench.force, message.wrench.torque])
    if not (np.abs([force, torque]) <= _LARGEST_FORCE).all():  # NaN is not
        raise UnusableMessage(f"a force or torque is not finite, or above {_LARGEST_FORCE:g}")
    return WrenchMessage(frame, force, torque)


def _joints(message: Any, _: str) -> JointsMessage:
    return fields.joints(zip(message.name, message.position, strict=True))


def _transform(message: Any) -> Iterator[Decoded]:
    parent, child, moved = message.header.frame_id, message.child_frame_id, message.transform
    content = fields.transform(parent, child, moved.translation, moved.rotation)
    yield _stamp(message.header), content


def _transforms(message: Any) -> Iterator[Decoded]:
    for part in message.transforms:
        yield from _transform(part)


def _marker(message: Any) -> Iterator[Decoded]:
    value = message.data
    yield None, fields.marker(str(value).lower() if isinstance(value, bool) else str(value))


def _stamped(content: Callable[[Any, str], Content]) -> Callable[[Any], Iterator[Decoded]]:
    """One content of a message with a header."""

    def contents(message: Any) -> Iterator[Decoded]:
        frame = fields.frame_name(message.header.frame_id)
        yield _stamp(message.header), content(message, frame)

    return contents


_CONTENTS: dict[str, Callable[[Any], Iterator[Decoded]]] = {
    "sensor_msgs/Image": _stamped(_image),
    "sensor_msgs/CompressedImage": _stamped(_compressed_image),
    "sensor_msgs/CameraInfo": _stamped(_camera_info),
    "sensor_msgs/PointCloud2": _stamped(_cloud),
    "sensor_msgs/JointState": _stamped(_joints),
    "tf2_msgs/TFMessage": _transforms,
    "geometry_msgs/TransformStamped": _transform,
    "geometry_msgs/PoseStamped": _stamped(fields.pose),
    "geometry_msgs/PoseArray": _stamped(fields.poses),
    "geometry_msgs/PointStamped": _stamped(fields.point),
    "geometry_msgs/WrenchStamped": _stamped(_wrench),
    **{
        name: _marker
        for name in DEFINITIONS
        if name.startswith("std_msgs/") and name != "std_msgs/Header"
    },
}
