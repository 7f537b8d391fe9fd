"""From the bytes of messages, ROS 2's as CDR and Foxglove's as protobuf, to what they contain."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np
from mcap.records import Schema

from chsel.errors import SettingError
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import apply, rotated
from chsel.sensing.depth_camera import PinholeCamera, matrix_numbers
from replay.mcap.texts import one_line
from runners.sensors.log.images import compressed_pixels, pixel_rows
from runners.sensors.log.messages import (
    CameraInfoMessage,
    CloudMessage,
    Content,
    Decode,
    Decoded,
    ImageMessage,
    Joints,
    TransformMessage,
    UnusableMessage,
    WrenchMessage,
)
from runners.sensors.log.ros2_definitions import DEFINITIONS, full_definition

_NANOSECONDS = 10**9
_END_OF_TIME = 2**63
_FURTHEST = 1e9  # metres: no robot works further from the origin of its frame
_FLOATS = {7: "f4", 8: "f8"}  # in sensor_msgs/PointField and foxglove.PackedElementField alike
_MOST_SKEW = 0.001  # of a focal length: less does not matter
_AXES = ("x", "y", "z")
_ZSTD = b"\x28\xb5\x2f\xfd"  # begin of a frame of zstd; messages of CDR begin with 0
_COMPRESSED = UnusableMessage(
    "its messages are compressed one by one by rosbag2 (compression mode message); accepted: what "
    "`ros2 bag convert` writes without that, or compressed chunks (`ros2 bag record "
    "--storage-preset-profile zstd_fast`)"
)

Read = Callable[[Any, str], Content]
"""From a parsed message and its frame to its content."""


def decoder(name: str, encoding: str, *, definition: str | None = None) -> Decode:
    """Decodes messages of a schema; all to the same UnusableMessage if it is not read.

    definition: of a ROS 2 message in the file, by which it is decoded; by default that of ROS 2.
    """
    try:
        parse, read = _reader(name, encoding, definition=definition)
    except UnusableMessage as error:
        unread: list[Decoded] = [(None, error)]
        return lambda data: iter(unread)

    def decoded(message: Any) -> Decoded:
        stamp, frame = _header(message)
        return stamp, read(message, frame)

    def decode(data: bytes) -> Iterator[Decoded]:
        if encoding == "cdr" and data.startswith(_ZSTD):
            yield None, _COMPRESSED
            return
        message = _checked(name, parse, given=data)
        if isinstance(message, UnusableMessage):
            yield None, message
            return
        for part in getattr(message, "transforms", [message]):
            found = _checked(name, decoded, given=part)
            yield (None, found) if isinstance(found, UnusableMessage) else found

    return decode


def _checked(name: str, read: Callable[[Any], Any], *, given: Any) -> Any:
    """Return what `read` returns, or its exception as UnusableMessage; libraries raise anything."""
    try:
        return read(given)
    except UnusableMessage as error:
        return error
    except Exception as error:
        reason = one_line(f"{type(error).__name__}: {error}")[:200]
        return UnusableMessage(f"a message is not a valid {name} ({reason})")


def _reader(
    name: str, encoding: str, *, definition: str | None
) -> tuple[Callable[[bytes], Any], Read]:
    """Return what parses messages of a schema, and what reads their content."""
    short = name.replace("/msg/", "/")
    if encoding == "cdr" and short in _ROS2:
        return _ros2_parser(short, definition), _ROS2[short]
    if encoding == "protobuf" and name in _FOXGLOVE:
        short = name.removeprefix("foxglove.")
        # The installed package's class, whatever the file describes.
        try:
            kind = getattr(import_module(f"foxglove_schemas_protobuf.{short}_pb2"), short)
        except ImportError:
            raise UnusableMessage(f"foxglove-schemas-protobuf lacks {name}: update it") from None
        return kind.FromString, _FOXGLOVE[name]
    raise UnusableMessage(f"messages {name} as {encoding or 'unknown bytes'} are not read")


def _ros2_parser(name: str, definition: str | None) -> Callable[[bytes], Any]:
    from mcap_ros2.decoder import DecoderFactory  # of the extra "sensors"

    text = definition if definition and definition.strip() else full_definition(name)
    schema = Schema(id=1, data=text.encode(), encoding="ros2msg", name=name)
    try:
        parse = DecoderFactory().decoder_for("cdr", schema)
    except Exception as error:  # the parser raises whatever it stumbles over
        raise UnusableMessage(f"the definition of {name} is not read: {error}") from None
    assert parse is not None
    return parse


def _header(message: Any) -> tuple[int | None, str]:
    """Return the stamp, nanoseconds, None where there is none, and the frame of a message."""
    if hasattr(message, "header"):  # of ROS 2
        time, frame = message.header.stamp, message.header.frame_id
        stamp = time.sec * _NANOSECONDS + time.nanosec
    elif hasattr(message, "timestamp"):  # of Foxglove
        stamp = message.timestamp.ToNanoseconds()
        frame = getattr(message, "frame_id", "")
    else:
        return None, ""
    if stamp not in range(_END_OF_TIME):
        raise UnusableMessage("its time stamp is no time")
    return stamp or None, _frame_name(frame)


def _frame_name(name: str) -> str:
    """Return the name of a frame without the slash that old programs put ahead."""
    return one_line(name.removeprefix("/"))


def _image(message: Any, frame: str) -> ImageMessage:
    values = pixel_rows(
        message.data,
        message.encoding,
        size=(message.width, message.height),
        step=message.step,
        big_endian=bool(getattr(message, "is_bigendian", 0)),
    )
    return ImageMessage(frame, values)


def _compressed_image(message: Any, frame: str) -> ImageMessage:
    return ImageMessage(frame, compressed_pixels(message.data, message.format))


def _ros2_camera(message: Any, _: str) -> CameraInfoMessage:
    """Return intrinsics of the pixels that are sent: a region of the sensor, binned."""
    info = _camera(message, k=message.k, p=message.p, d=message.d)
    region = message.roi
    across = max(message.binning_x, 1)
    down = max(message.binning_y, 1)

    def sent(camera: PinholeCamera) -> PinholeCamera:
        return PinholeCamera(
            width=(region.width or camera.width) // across,
            height=(region.height or camera.height) // down,
            fx=camera.fx / across,
            fy=camera.fy / down,
            cx=(camera.cx - region.x_offset) / across,
            cy=(camera.cy - region.y_offset) / down,
        )

    rectified = None if info.rectified is None else sent(info.rectified)
    return replace(info, camera=sent(info.camera), rectified=rectified)


def _foxglove_camera(message: Any, _: str) -> CameraInfoMessage:
    return _camera(message, k=message.K, p=message.P, d=message.D)


def _camera(message: Any, *, k: Any, p: Any, d: Any) -> CameraInfoMessage:
    """Return intrinsics of all pixels of a sensor.

    k: matrix (9) of images as they are. p: matrix (12, or none) of rectified ones. d: distortion.
    """
    width, height = message.width, message.height
    rectified = None
    if len(p) == 12 and p[0] != 0.0:
        with suppress(UnusableMessage):  # who rectifies no images may leave anything there
            rectified = _pinhole("P", [*p[:3], *p[4:7], *p[8:11]], width=width, height=height)
    camera = _pinhole("K", k, width=width, height=height)
    if not any(d):
        return CameraInfoMessage(camera, rectified=rectified)
    return CameraInfoMessage(
        camera,
        tuple(float(number) for number in d),
        distortion_model=one_line(message.distortion_model),
        rectified=rectified,
    )


def _pinhole(name: str, numbers: Any, *, width: int, height: int) -> PinholeCamera:
    """Return the camera of a matrix (9), row by row."""
    try:
        fx, fy, cx, cy = matrix_numbers(np.reshape(numbers, (3, 3)), skew=_MOST_SKEW)
    except SettingError:
        listed = ", ".join(f"{value:g}" for value in numbers)
        text = f"{name} is [{listed}]; accepted: fx, 0, cx, 0, fy, cy, 0, 0, 1"
        raise UnusableMessage(text) from None
    return PinholeCamera(width, height, fx=fx, fy=fy, cx=cx, cy=cy)


def _ros2_cloud(message: Any, frame: str) -> CloudMessage:
    fields = {part.name: (part.offset, part.datatype) for part in message.fields}
    unpacked = partial(
        packed_points,
        message.data,
        stride=message.point_step,
        size=(message.width, message.height),
        row=message.row_step,
        big_endian=message.is_bigendian,
    )
    points = unpacked(fields)
    normals = _normal_fields(fields)
    return CloudMessage(frame, points, normals=unpacked(normals) if normals else None)


def _foxglove_cloud(message: Any, frame: str) -> CloudMessage:
    named = {field.name: (field.offset, field.type) for field in message.fields}
    stride, data = message.point_stride, message.data
    count = len(data) // stride
    unpacked = partial(packed_points, data, stride=stride, size=(count, 1), row=count * stride)
    points = unpacked(named)
    of_normals = _normal_fields(named)
    normals = unpacked(of_normals) if of_normals else None
    if message.HasField("pose"):
        pose = rigid(message.pose.position, message.pose.orientation)
        points = apply(pose, points)
        normals = None if normals is None else rotated(pose[:3, :3], normals)
    return CloudMessage(frame, points, normals=normals)


def _normal_fields(fields: Mapping[str, tuple[int, int]]) -> dict[str, tuple[int, int]]:
    """Return those of a cloud's fields that are its normals, by axis; none unless all are there."""
    named = {axis: fields.get(f"normal_{axis}", (0, 0)) for axis in _AXES}
    return named if all(kind in _FLOATS for _, kind in named.values()) else {}


def _transform(message: Any, frame: str) -> TransformMessage:
    moved = getattr(message, "transform", message)  # of Foxglove's, it is the message itself
    parent = _frame_name(getattr(message, "parent_frame_id", frame))
    child = _frame_name(message.child_frame_id)
    if not parent or not child:
        raise UnusableMessage("a transform lacks the name of a frame")
    return TransformMessage(
        parent, child, parent_from_child=rigid(moved.translation, moved.rotation)
    )


def _pose(message: Any, frame: str) -> TransformMessage:
    return TransformMessage(
        frame, "", parent_from_child=rigid(message.pose.position, message.pose.orientation)
    )


def _poses(message: Any, frame: str) -> CloudMessage:
    return CloudMessage(frame, _positions(one.position for one in message.poses))


def _point(message: Any, frame: str) -> CloudMessage:
    return CloudMessage(frame, _positions([message.point]))


def _wrench(message: Any, frame: str) -> WrenchMessage:
    force, torque = _positions([message.wrench.force, message.wrench.torque])
    if not np.isfinite([force, torque]).all():
        raise UnusableMessage("a force or torque is not finite")
    return WrenchMessage(frame, force, torque=torque)


def _joints(message: Any, _: str) -> Joints:
    if hasattr(message, "joints"):  # of Foxglove
        known = [joint for joint in message.joints if joint.HasField("position")]
        positions = [(joint.name, joint.position) for joint in known]
    else:
        positions = list(zip(message.name, message.position, strict=True))
    return {one_line(name): float(position) for name, position in positions}


def _ros2_marker(message: Any, _: str) -> str:
    return one_line(str(message.data))


def _log(message: Any, _: str) -> str:
    return one_line(message.message)


def _pair(message: Any, _: str) -> str:
    """Return key and value as a text, such as "begin 3" of "begin" and "3"."""
    return one_line(f"{message.key} {message.value}")


def rigid(position: Any, quaternion: Any) -> FloatArray:
    """Return the transform (4, 4) of x, y, z, metres, and a quaternion of any length."""
    numbers = quaternion.x, quaternion.y, quaternion.z, quaternion.w
    place = position.x, position.y, position.z
    largest = max(map(abs, numbers))
    if not largest > 0.0 or not all(map(math.isfinite, numbers)):
        raise UnusableMessage("its quaternion is 0 or not finite")
    if not all(abs(value) < _FURTHEST for value in place):
        raise UnusableMessage(f"its position is not finite, or beyond {_FURTHEST:g} m")
    x, y, z, w = (value / largest for value in numbers)
    s = 2.0 / (x * x + y * y + z * z + w * w)
    return np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w), place[0]],
            [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w), place[1]],
            [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y), place[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _positions(points: Iterable[Any]) -> FloatArray:
    """Return points (N, 3) of objects that have x, y and z."""
    return np.array([(p.x, p.y, p.z) for p in points]).reshape(-1, 3)


def packed_points(
    data: bytes,
    fields: Mapping[str, tuple[int, int]],
    *,
    stride: int,
    size: tuple[int, int],
    row: int,
    big_endian: bool = False,
) -> FloatArray:
    """Return points (N, 3) of `stride` bytes each, in rows.

    size: points a row, and rows of `row` bytes.

    fields: offset in bytes and type by name.
    """
    (width, rows), order = size, ">" if big_endian else "<"
    for axis in _AXES:
        if axis not in fields or fields[axis][1] not in _FLOATS:
            raise UnusableMessage(f"a point cloud has no field {axis} of float32 or float64")
    if width * stride * rows == len(data):
        row = width * stride  # drivers leave it at 0, or at that of an unfiltered cloud
    if row * rows != len(data) or width * stride > row:
        raise UnusableMessage(
            f"a point cloud of {width} x {rows} points of {stride} bytes in rows of {row} bytes "
            f"cannot have {len(data)} bytes"
        )
    if not data:
        return np.zeros((0, 3))
    layout = np.dtype(
        {
            "names": list(_AXES),
            "formats": [order + _FLOATS[fields[axis][1]] for axis in _AXES],
            "offsets": [fields[axis][0] for axis in _AXES],
            "itemsize": stride,
        }
    )
    lines = np.frombuffer(data, np.uint8).reshape(rows, row)[:, : width * stride]
    points = np.ascontiguousarray(lines).reshape(-1).view(layout)
    return np.stack([points[axis].astype(np.float64) for axis in _AXES], axis=1)


_ROS2: dict[str, Read] = {
    "sensor_msgs/Image": _image,
    "sensor_msgs/CompressedImage": _compressed_image,
    "sensor_msgs/CameraInfo": _ros2_camera,
    "sensor_msgs/PointCloud2": _ros2_cloud,
    "sensor_msgs/JointState": _joints,
    "tf2_msgs/TFMessage": _transform,
    "geometry_msgs/TransformStamped": _transform,
    "geometry_msgs/PoseStamped": _pose,
    "geometry_msgs/PoseArray": _poses,
    "geometry_msgs/PointStamped": _point,
    "geometry_msgs/WrenchStamped": _wrench,
    **{
        name: _ros2_marker
        for name in DEFINITIONS
        if name.startswith("std_msgs/") and name != "std_msgs/Header"
    },
}
_FOXGLOVE: dict[str, Read] = {
    "foxglove.RawImage": _image,
    "foxglove.CompressedImage": _compressed_image,
    "foxglove.CameraCalibration": _foxglove_camera,
    "foxglove.FrameTransform": _transform,
    "foxglove.FrameTransforms": _transform,
    "foxglove.PoseInFrame": _pose,
    "foxglove.PosesInFrame": _poses,
    "foxglove.Point3InFrame": _point,
    "foxglove.PointCloud": _foxglove_cloud,
    "foxglove.JointStates": _joints,
    "foxglove.Log": _log,
    "foxglove.KeyValuePair": _pair,
}
