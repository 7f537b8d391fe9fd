"""From the bytes of messages, ROS 2's as CDR and Foxglove's as protobuf, to what they contain."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib import import_module
from typing import Any

import numpy as np
from mcap.records import Schema

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import apply
from chsel.sensing.depth_camera import PinholeCamera
from replay.mcap.texts import one_line
from runners.sensors.log.images import compressed_pixels, pixel_rows, png_pixels
from runners.sensors.log.messages import (
    CameraInfoMessage,
    CloudMessage,
    Content,
    Decode,
    Decoded,
    ImageMessage,
    JointsMessage,
    MarkerMessage,
    PoseMessage,
    TransformMessage,
    UnusableMessage,
    WrenchMessage,
)
from runners.sensors.log.ros2_definitions import DEFINITIONS, full_definition

_NANOSECONDS = 10**9
_END_OF_TIME = 2**63
_FURTHEST = 1e9  # metres: no robot works further from the origin of its frame
_LARGEST_FORCE = 1e6  # N, Nm
_FLOATS = {7: "f4", 8: "f8"}  # in sensor_msgs/PointField and foxglove.PackedElementField alike
_AXES = ("x", "y", "z")

Header = tuple[int, int, str]  # seconds, nanoseconds, frame


def decoder(name: str, encoding: str, definition: str | None = None) -> Decode:
    """Decodes messages of a schema; all to the same UnusableMessage if it is not read.

    definition: of a ROS 2 message in the file, by which it is decoded; by default that of ROS 2.
    """
    try:
        parse, header, content = _reader(name, encoding, definition)
    except UnusableMessage as error:
        unread: list[Decoded] = [(None, error)]
        return lambda data: iter(unread)

    def decoded(message: Any) -> Decoded:
        seconds, nanoseconds, frame = header(message)
        stamp = seconds * _NANOSECONDS + nanoseconds
        if not 0 <= stamp < _END_OF_TIME:
            raise UnusableMessage("its time stamp is no time")
        return stamp or None, content(message, _frame_name(frame))

    def decode(data: bytes) -> Iterator[Decoded]:
        message = _checked(name, parse, data)
        if isinstance(message, UnusableMessage):
            yield None, message
            return
        for part in getattr(message, "transforms", [message]):
            found = _checked(name, decoded, part)
            yield (None, found) if isinstance(found, UnusableMessage) else found

    return decode


def _checked(name: str, read: Callable[[Any], Any], given: Any) -> Any:
    """What `read` returns; as UnusableMessage what it raises, which libraries do as they like."""
    try:
        return read(given)
    except UnusableMessage as error:
        return error
    except Exception as error:
        reason = one_line(f"{type(error).__name__}: {error}")[:200]
        return UnusableMessage(f"a message is not a valid {name} ({reason})")


def _reader(
    name: str, encoding: str, definition: str | None
) -> tuple[Callable[[bytes], Any], Callable[[Any], Header], Callable[[Any, str], Content]]:
    """What parses messages of a schema, and reads their header and their content."""
    if encoding == "cdr" and (short := name.replace("/msg/", "/")) in _ROS2:
        header = _no_header if _ROS2[short] is _ros2_marker else _ros2_header
        return _ros2_parser(short, definition), header, _ROS2[short]
    if encoding == "protobuf" and name in _FOXGLOVE:
        short = name.removeprefix("foxglove.")
        # The installed package's class, whatever the file describes.
        try:
            kind = getattr(import_module(f"foxglove_schemas_protobuf.{short}_pb2"), short)
        except ImportError:
            raise UnusableMessage(f"foxglove-schemas-protobuf lacks {name}: update it") from None
        return kind.FromString, _foxglove_header, _FOXGLOVE[name]
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


def _no_header(message: Any) -> Header:
    return 0, 0, ""


def _ros2_header(message: Any) -> Header:
    header = message.header
    return header.stamp.sec, header.stamp.nanosec, header.frame_id


def _foxglove_header(message: Any) -> Header:
    if not hasattr(message, "timestamp"):
        return _no_header(message)
    time = message.timestamp
    return time.seconds, time.nanos, getattr(message, "frame_id", "")


def _frame_name(name: str) -> str:
    """The name of a frame without the slash that old programs put ahead."""
    return one_line(name.removeprefix("/"))


def _ros2_image(message: Any, frame: str) -> ImageMessage:
    values = pixel_rows(
        message.data,
        message.encoding,
        (message.width, message.height),
        message.step,
        big_endian=message.is_bigendian != 0,
    )
    return ImageMessage(frame, values)


def _foxglove_image(message: Any, frame: str) -> ImageMessage:
    size = (message.width, message.height)
    return ImageMessage(frame, pixel_rows(message.data, message.encoding, size, message.step))


def _ros2_compressed_image(message: Any, frame: str) -> ImageMessage:
    return ImageMessage(frame, compressed_pixels(message.data, message.format))


def _foxglove_compressed_image(message: Any, frame: str) -> ImageMessage:
    return ImageMessage(frame, png_pixels(message.data))


def _ros2_camera(message: Any, frame: str) -> CameraInfoMessage:
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


def _foxglove_camera(message: Any, frame: str) -> CameraInfoMessage:
    fx, _, cx, _, fy, cy, *_ = message.K
    camera = PinholeCamera(message.width, message.height, fx, fy, cx, cy)
    return CameraInfoMessage(frame, camera, distorted=any(message.D))


def _ros2_cloud(message: Any, frame: str) -> CloudMessage:
    points = packed_points(
        message.data,
        {part.name: (part.offset, part.datatype) for part in message.fields},
        message.point_step,
        size=(message.width, message.height),
        row=message.row_step,
        big_endian=message.is_bigendian,
    )
    return CloudMessage(frame, points)


def _foxglove_cloud(message: Any, frame: str) -> CloudMessage:
    named = {field.name: (field.offset, field.type) for field in message.fields}
    stride, data = message.point_stride, message.data
    if stride < 1 or len(data) % stride:
        raise UnusableMessage(f"a point cloud has {len(data)} bytes, of {stride} a point")
    size = (len(data) // stride, 1)
    points = packed_points(data, named, stride, size=size, row=len(data))
    if message.HasField("pose"):
        points = apply(rigid(message.pose.position, message.pose.orientation), points)
    return CloudMessage(frame, points)


def _ros2_transform(message: Any, frame: str) -> TransformMessage:
    moved = message.transform
    return _transform(frame, message.child_frame_id, moved.translation, moved.rotation)


def _foxglove_transform(message: Any, _: str) -> TransformMessage:
    parent, child = message.parent_frame_id, message.child_frame_id
    return _transform(_frame_name(parent), child, message.translation, message.rotation)


def _transform(parent: str, child: str, position: Any, quaternion: Any) -> TransformMessage:
    child = _frame_name(child)
    if not parent or not child:
        raise UnusableMessage("a transform lacks the name of a frame")
    return TransformMessage(parent, child, rigid(position, quaternion))


def _pose(message: Any, frame: str) -> PoseMessage:
    return PoseMessage(frame, rigid(message.pose.position, message.pose.orientation))


def _poses(message: Any, frame: str) -> CloudMessage:
    return CloudMessage(frame, _positions(one.position for one in message.poses))


def _point(message: Any, frame: str) -> CloudMessage:
    return CloudMessage(frame, _positions([message.point]))


def _wrench(message: Any, frame: str) -> WrenchMessage:
    force, torque = _positions([message.wrench.force, message.wrench.torque])
    if not (np.abs([force, torque]) <= _LARGEST_FORCE).all():  # NaN is not
        raise UnusableMessage(f"a force or torque is not finite, or above {_LARGEST_FORCE:g}")
    return WrenchMessage(frame, force, torque)


def _ros2_joints(message: Any, _: str) -> JointsMessage:
    return _joints(zip(message.name, message.position, strict=True))


def _foxglove_joints(message: Any, _: str) -> JointsMessage:
    known = [joint for joint in message.joints if joint.HasField("position")]
    return _joints((joint.name, joint.position) for joint in known)


def _joints(positions: Iterable[tuple[str, float]]) -> JointsMessage:
    found = {one_line(name): float(position) for name, position in positions}
    for name, position in found.items():
        if not math.isfinite(position):
            raise UnusableMessage(f"joint {name} is at {position}")
    return JointsMessage(found)


def _ros2_marker(message: Any, _: str) -> MarkerMessage:
    value = message.data
    return MarkerMessage(one_line(str(value).lower() if isinstance(value, bool) else str(value)))


def _log(message: Any, _: str) -> MarkerMessage:
    return MarkerMessage(one_line(message.message))


def _pair(message: Any, _: str) -> MarkerMessage:
    """A key "begin" with value "3" is the text "begin 3"."""
    return MarkerMessage(one_line(f"{message.key} {message.value}"))


def rigid(position: Any, quaternion: Any) -> FloatArray:
    """The transform (4, 4) of a position x, y, z, metres, and a quaternion of any length."""
    numbers = x, y, z, w = quaternion.x, quaternion.y, quaternion.z, quaternion.w
    place = position.x, position.y, position.z
    largest = max(map(abs, numbers))
    if not largest > 0.0 or not all(map(math.isfinite, numbers)):
        raise UnusableMessage(f"its quaternion is {_shown(numbers)}")
    if not all(abs(value) < _FURTHEST for value in place):
        raise UnusableMessage(f"its position is {_shown(place)}")
    x, y, z, w = x / largest, y / largest, z / largest, w / largest
    s = 2.0 / (x * x + y * y + z * z + w * w)
    return np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w), place[0]],
            [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w), place[1]],
            [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y), place[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _shown(numbers: tuple[float, ...]) -> str:
    return ", ".join(f"{number:.3g}" for number in numbers)


def _positions(points: Iterable[Any]) -> FloatArray:
    """Points (N, 3) of objects that have x, y and z."""
    return np.array([(p.x, p.y, p.z) for p in points]).reshape(-1, 3)


def packed_points(
    data: bytes,
    fields: Mapping[str, tuple[int, int]],
    stride: int,
    *,
    size: tuple[int, int],
    row: int,
    big_endian: bool = False,
) -> FloatArray:
    """Points (N, 3) of `stride` bytes each; size: points a row, and rows of `row` bytes.

    fields: offset in bytes and type by name.
    """
    (width, rows), order = size, ">" if big_endian else "<"
    for axis in _AXES:
        if axis not in fields or fields[axis][1] not in _FLOATS:
            raise UnusableMessage(f"a point cloud has no field {axis} of float32 or float64")
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


_ROS2: dict[str, Callable[[Any, str], Content]] = {
    "sensor_msgs/Image": _ros2_image,
    "sensor_msgs/CompressedImage": _ros2_compressed_image,
    "sensor_msgs/CameraInfo": _ros2_camera,
    "sensor_msgs/PointCloud2": _ros2_cloud,
    "sensor_msgs/JointState": _ros2_joints,
    "tf2_msgs/TFMessage": _ros2_transform,
    "geometry_msgs/TransformStamped": _ros2_transform,
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
_FOXGLOVE: dict[str, Callable[[Any, str], Content]] = {
    "foxglove.RawImage": _foxglove_image,
    "foxglove.CompressedImage": _foxglove_compressed_image,
    "foxglove.CameraCalibration": _foxglove_camera,
    "foxglove.FrameTransform": _foxglove_transform,
    "foxglove.FrameTransforms": _foxglove_transform,
    "foxglove.PoseInFrame": _pose,
    "foxglove.PosesInFrame": _poses,
    "foxglove.Point3InFrame": _point,
    "foxglove.PointCloud": _foxglove_cloud,
    "foxglove.JointStates": _foxglove_joints,
    "foxglove.Log": _log,
    "foxglove.KeyValuePair": _pair,
}
