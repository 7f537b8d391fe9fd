"""Foxglove's messages, as protobuf: what they say."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module
from typing import Any

from google.protobuf.message import DecodeError

from chsel.errors import RecordingError
from chsel.problem.poses import apply
from replay.mcap.wire import check_wire
from runners.sensors.log.images import pixel_rows, png_pixels
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
    UnusableMessage,
)
from runners.sensors.log.messages import TransformMessage as Transform
from runners.sensors.log.quaternions import rigid

_MOST_TRANSFORMS = 10_000  # in one message
_MATRIX = 9  # entries of intrinsics


def foxglove_decoder(name: str) -> Callable[[bytes], Iterator[Said]] | None:
    """What a message of this name says; None for one that is not read.

    Its class is the installed package's, never one that a file describes.
    """
    made, kind = _CONTENTS.get(name), _kind(name)
    if made is None or kind is None:
        return None

    def said(data: bytes) -> Iterator[Said]:
        try:
            check_wire(kind.DESCRIPTOR, data)
            message = kind.FromString(data)
        except (DecodeError, RecordingError):
            raise UnusableMessage(f"a message is no valid {name}") from None
        return made(message)

    return said


@cache
def _kind(name: str) -> Any:
    """The class of a message; None where the package, of several versions, lacks it."""
    if name not in _CONTENTS:
        return None
    short = name.removeprefix("foxglove.")
    try:
        return getattr(import_module(f"foxglove_schemas_protobuf.{short}_pb2"), short)
    except ImportError:
        return None


def _stamp(message: Any) -> int | None:
    return stamp_of(message.timestamp.seconds, message.timestamp.nanos)


def _one(message: Any, content: Content) -> Iterator[Said]:
    yield _stamp(message), content


def _image(message: Any) -> Iterator[Said]:
    size = (message.width, message.height)
    values = pixel_rows(message.data, message.encoding, size, message.step)
    return _one(message, ImageMessage(frame_name(message.frame_id), values))


def _compressed_image(message: Any) -> Iterator[Said]:
    return _one(message, ImageMessage(frame_name(message.frame_id), png_pixels(message.data)))


def _calibration(message: Any) -> Iterator[Said]:
    require_length("entries", len(message.K), "of its intrinsics", _MATRIX)
    fx, _, cx, _, fy, cy, *_ = message.K
    frame, size = frame_name(message.frame_id), (message.width, message.height)
    return _one(message, intrinsics(frame, size, (fx, fy), (cx, cy), message.D))


def _transform(message: Any) -> Transform | UnusableMessage:
    """A transform, or what is wrong with it, as others of its message may be right."""
    t, q = message.translation, message.rotation
    try:
        return Transform(
            frame_name(message.parent_frame_id, needed=True),
            frame_name(message.child_frame_id, needed=True),
            rigid((t.x, t.y, t.z), (q.x, q.y, q.z, q.w)),
        )
    except UnusableMessage as error:
        return error


def _one_transform(message: Any) -> Iterator[Said]:
    yield _stamp(message), _transform(message)


def _transforms(message: Any) -> Iterator[Said]:
    if len(message.transforms) > _MOST_TRANSFORMS:
        raise UnusableMessage(f"it has {len(message.transforms)} transforms")
    for part in message.transforms:
        yield _stamp(part), _transform(part)


def _pose(message: Any) -> Iterator[Said]:
    return _one(message, PoseMessage(frame_name(message.frame_id), _rigid(message.pose)))


def _rigid(pose: Any) -> Any:
    p, q = pose.position, pose.orientation
    return rigid((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def _poses(message: Any) -> Iterator[Said]:
    positioned = [pose.position for pose in message.poses]
    return _one(message, positions(message.frame_id, positioned))


def _point(message: Any) -> Iterator[Said]:
    return _one(message, positions(message.frame_id, [message.point]))


def _cloud(message: Any) -> Iterator[Said]:
    fields = named_fields((field.name, field.offset, field.type) for field in message.fields)
    stride, data = message.point_stride, message.data
    if stride < 1 or len(data) % stride:
        raise UnusableMessage(f"a point cloud has {len(data)} bytes, of {stride} a point")
    points = packed_points(data, fields, stride, size=(len(data) // stride, 1), row=len(data))
    if message.HasField("pose"):
        points = apply(_rigid(message.pose), points)
    return _one(message, CloudMessage(frame_name(message.frame_id), points))


def _joints(message: Any) -> Iterator[Said]:
    known = [joint for joint in message.joints if joint.HasField("position")]
    return _one(message, joints((joint.name, joint.position) for joint in known))


def _log(message: Any) -> Iterator[Said]:
    return _one(message, marker(message.message))


def _pair(message: Any) -> Iterator[Said]:
    """A key "begin" with value "3" is the text "begin 3"."""
    yield None, marker(f"{message.key} {message.value}")


_CONTENTS: dict[str, Callable[[Any], Iterator[Said]]] = {
    "foxglove.RawImage": _image,
    "foxglove.CompressedImage": _compressed_image,
    "foxglove.CameraCalibration": _calibration,
    "foxglove.FrameTransform": _one_transform,
    "foxglove.FrameTransforms": _transforms,
    "foxglove.PoseInFrame": _pose,
    "foxglove.PosesInFrame": _poses,
    "foxglove.Point3InFrame": _point,
    "foxglove.PointCloud": _cloud,
    "foxglove.JointStates": _joints,
    "foxglove.Log": _log,
    "foxglove.KeyValuePair": _pair,
}
