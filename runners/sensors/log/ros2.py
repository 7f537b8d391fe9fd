"""ROS 2 messages, as CDR: what they say."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from runners.sensors.log.images import compressed_pixels, pixel_rows
from runners.sensors.log.message_fields import (
    Said,
    frame_name,
    intrinsics,
    joints,
    marker,
    named_fields,
    packed_points,
    positions,
    require_length,
    stamp_of,
)
from runners.sensors.log.messages import (
    CloudMessage,
    Content,
    ImageMessage,
    PoseMessage,
    TransformMessage,
    UnusableMessage,
    WrenchMessage,
)
from runners.sensors.log.quaternions import rigid
from runners.sensors.log.ros2_definitions import DEFINITIONS, full_definition, short_name

_ERRORS = (ValueError, struct.error, IndexError, OverflowError, MemoryError)  # of the decoder
_SMALL = 2**20  # bytes; what has no pixels or points is smaller
_BULKY = ("sensor_msgs/Image", "sensor_msgs/CompressedImage", "sensor_msgs/PointCloud2")
_HEAD = 2**12  # bytes of a cloud that must hold all before its points
_LARGEST_FORCE = 1e6  # N, Nm
_TEXT_AT = 8  # bytes before the text of std_msgs/String


def ros2_decoder(name: str) -> Callable[[bytes], Iterator[Said]] | None:
    """What a message of this name says; None for one that is not read."""
    name = short_name(name)
    made = _CONTENTS.get(name)
    if made is None:
        return None

    def said(data: bytes) -> Iterator[Said]:
        return made(_message(name, data))

    return said


def _message(name: str, data: bytes) -> Any:
    if len(data) > _SMALL and name not in _BULKY:
        raise UnusableMessage(f"a {name} of {len(data)} bytes; accepted: up to {_SMALL}")
    try:
        if name == "sensor_msgs/PointCloud2":
            # A hostile one could otherwise claim more fields than fit into memory.
            _decoder(name, until="is_bigendian")(data[:_HEAD])
        message = _decoder(name)(data)
    except _ERRORS:
        raise UnusableMessage(f"a message is no whole {name}") from None
    if name == "std_msgs/String" and _TEXT_AT + len(message.data.encode()) + 1 > len(data):
        raise UnusableMessage("a text ends early")
    return message


@cache
def _decoder(name: str, *, until: str | None = None) -> Callable[[bytes], Any]:
    """The decoder by our definition, as one from a file could make it run for ever.

    until: its first field that is left out, with all that follow.
    """
    text = full_definition(name)
    if until is not None:
        own, line, parts = text.partition("=" * 80)
        kept = own.splitlines()
        first = next(i for i, field in enumerate(kept) if field.split()[1] == until)
        text = "\n".join([*kept[:first], line]) + parts
    schema = Schema(id=1, data=text.encode(), encoding="ros2msg", name=name)
    made = DecoderFactory().decoder_for("cdr", schema)
    assert made is not None
    return made


def _stamp(header: Any) -> int | None:
    return stamp_of(header.stamp.sec, header.stamp.nanosec)


def _one(message: Any, content: Content) -> Iterator[Said]:
    yield _stamp(message.header), content


def _image(message: Any) -> Iterator[Said]:
    values = pixel_rows(
        message.data,
        message.encoding,
        (message.width, message.height),
        message.step,
        big_endian=message.is_bigendian != 0,
    )
    return _one(message, ImageMessage(frame_name(message.header.frame_id), values))


def _compressed_image(message: Any) -> Iterator[Said]:
    values = compressed_pixels(message.data, message.format)
    return _one(message, ImageMessage(frame_name(message.header.frame_id), values))


def _camera_info(message: Any) -> Iterator[Said]:
    """Of the pixels that are sent: a region of the sensor, and several of its pixels as one."""
    region, across, down = message.roi, max(message.binning_x, 1), max(message.binning_y, 1)
    fx, _, cx, _, fy, cy, *_ = message.k
    info = intrinsics(
        frame_name(message.header.frame_id),
        ((region.width or message.width) // across, (region.height or message.height) // down),
        (fx / across, fy / down),
        ((cx - region.x_offset) / across, (cy - region.y_offset) / down),
        message.d,
    )
    return _one(message, info)


def _transform(message: Any) -> TransformMessage | UnusableMessage:
    """A transform, or what is wrong with it, as others of its message may be right."""
    t, q = message.transform.translation, message.transform.rotation
    try:
        return TransformMessage(
            frame_name(message.header.frame_id, needed=True),
            frame_name(message.child_frame_id, needed=True),
            rigid((t.x, t.y, t.z), (q.x, q.y, q.z, q.w)),
        )
    except UnusableMessage as error:
        return error


def _transform_stamped(message: Any) -> Iterator[Said]:
    yield _stamp(message.header), _transform(message)


def _transforms(message: Any) -> Iterator[Said]:
    for part in message.transforms:
        yield _stamp(part.header), _transform(part)


def _pose(message: Any) -> Iterator[Said]:
    p, q = message.pose.position, message.pose.orientation
    frame_from_body = rigid((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
    return _one(message, PoseMessage(frame_name(message.header.frame_id), frame_from_body))


def _poses(message: Any) -> Iterator[Said]:
    positioned = [pose.position for pose in message.poses]
    return _one(message, positions(message.header.frame_id, positioned))


def _point(message: Any) -> Iterator[Said]:
    return _one(message, positions(message.header.frame_id, [message.point]))


def _wrench(message: Any) -> Iterator[Said]:
    parts = [(part.x, part.y, part.z) for part in (message.wrench.force, message.wrench.torque)]
    force, torque = np.array(parts, dtype=np.float64)
    if not (np.abs(parts) <= _LARGEST_FORCE).all():  # NaN is not
        raise UnusableMessage(f"a force or torque is not finite, or above {_LARGEST_FORCE:g}")
    frame = frame_name(message.header.frame_id)
    return _one(message, WrenchMessage(frame, force, torque))


def _cloud(message: Any) -> Iterator[Said]:
    fields = named_fields((field.name, field.offset, field.datatype) for field in message.fields)
    points = packed_points(
        message.data,
        fields,
        message.point_step,
        size=(message.width, message.height),
        row=message.row_step,
        big_endian=message.is_bigendian,
    )
    return _one(message, CloudMessage(frame_name(message.header.frame_id), points))


def _joints(message: Any) -> Iterator[Said]:
    require_length("positions", len(message.position), "names", len(message.name))
    return _one(message, joints(zip(message.name, message.position, strict=True)))


def _marker(message: Any) -> Iterator[Said]:
    value = message.data
    yield None, marker(str(value).lower() if isinstance(value, bool) else str(value))


_CONTENTS: dict[str, Callable[[Any], Iterator[Said]]] = {
    "sensor_msgs/Image": _image,
    "sensor_msgs/CompressedImage": _compressed_image,
    "sensor_msgs/CameraInfo": _camera_info,
    "sensor_msgs/PointCloud2": _cloud,
    "sensor_msgs/JointState": _joints,
    "tf2_msgs/TFMessage": _transforms,
    "geometry_msgs/TransformStamped": _transform_stamped,
    "geometry_msgs/PoseStamped": _pose,
    "geometry_msgs/PoseArray": _poses,
    "geometry_msgs/PointStamped": _point,
    "geometry_msgs/WrenchStamped": _wrench,
    **{
        name: _marker
        for name in DEFINITIONS
        if name.startswith("std_msgs/") and name != "std_msgs/Header"
    },
}
