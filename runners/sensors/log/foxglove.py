"""Foxglove's messages, as protobuf, decoded."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

from chsel.problem.poses import apply
from chsel.sensing.depth_camera import PinholeCamera
from runners.sensors.log import message_fields as fields
from runners.sensors.log.images import pixel_rows, png_pixels
from runners.sensors.log.messages import (
    CameraInfoMessage,
    CloudMessage,
    Content,
    Decode,
    Decoded,
    ImageMessage,
    JointsMessage,
    MarkerMessage,
    UnusableMessage,
)


def foxglove_decoder(name: str) -> Decode | None:
    """Decodes messages of this name; None for one that is not read.

    Its class is the installed package's, whatever a file describes.
    """
    contents, short = _CONTENTS.get(name), name.removeprefix("foxglove.")
    if contents is None:
        return None
    try:
        kind = getattr(import_module(f"foxglove_schemas_protobuf.{short}_pb2"), short)
    except ImportError:  # the package, of several versions, lacks it
        return None
    return fields.decoder(name, kind.FromString, contents)


def _stamp(message: Any) -> int | None:
    return fields.stamp_of(message.timestamp.seconds, message.timestamp.nanos)


def _image(message: Any, frame: str) -> ImageMessage:
    size = (message.width, message.height)
    return ImageMessage(frame, pixel_rows(message.data, message.encoding, size, message.step))


def _compressed_image(message: Any, frame: str) -> ImageMessage:
    return ImageMessage(frame, png_pixels(message.data))


def _calibration(message: Any, frame: str) -> CameraInfoMessage:
    fx, _, cx, _, fy, cy, *_ = message.K
    camera = PinholeCamera(message.width, message.height, fx, fy, cx, cy)
    return CameraInfoMessage(frame, camera, distorted=any(message.D))


def _cloud(message: Any, frame: str) -> CloudMessage:
    named = {field.name: (field.offset, field.type) for field in message.fields}
    stride, data = message.point_stride, message.data
    if stride < 1 or len(data) % stride:
        raise UnusableMessage(f"a point cloud has {len(data)} bytes, of {stride} a point")
    size = (len(data) // stride, 1)
    points = fields.packed_points(data, named, stride, size=size, row=len(data))
    if message.HasField("pose"):
        points = apply(fields.rigid(message.pose.position, message.pose.orientation), points)
    return CloudMessage(frame, points)


def _joints(message: Any, _: str) -> JointsMessage:
    known = [joint for joint in message.joints if joint.HasField("position")]
    return fields.joints((joint.name, joint.position) for joint in known)


def _log(message: Any, _: str) -> MarkerMessage:
    return fields.marker(message.message)


def _transform(message: Any) -> Iterator[Decoded]:
    parent, child = message.parent_frame_id, message.child_frame_id
    yield _stamp(message), fields.transform(parent, child, message.translation, message.rotation)


def _transforms(message: Any) -> Iterator[Decoded]:
    for part in message.transforms:
        yield from _transform(part)


def _pair(message: Any) -> Iterator[Decoded]:
    """A key "begin" with value "3" is the text "begin 3"."""
    yield None, fields.marker(f"{message.key} {message.value}")


def _stamped(content: Callable[[Any, str], Content]) -> Callable[[Any], Iterator[Decoded]]:
    """One content of a message with a time stamp, and perhaps a frame."""

    def contents(message: Any) -> Iterator[Decoded]:
        frame = fields.frame_name(getattr(message, "frame_id", ""))
        yield _stamp(message), content(message, frame)

    return contents


_CONTENTS: dict[str, Callable[[Any], Iterator[Decoded]]] = {
    "foxglove.RawImage": _stamped(_image),
    "foxglove.CompressedImage": _stamped(_compressed_image),
    "foxglove.CameraCalibration": _stamped(_calibration),
    "foxglove.FrameTransform": _transform,
    "foxglove.FrameTransforms": _transforms,
    "foxglove.PoseInFrame": _stamped(fields.pose),
    "foxglove.PosesInFrame": _stamped(fields.poses),
    "foxglove.Point3InFrame": _stamped(fields.point),
    "foxglove.PointCloud": _stamped(_cloud),
    "foxglove.JointStates": _stamped(_joints),
    "foxglove.Log": _stamped(_log),
    "foxglove.KeyValuePair": _pair,
}
