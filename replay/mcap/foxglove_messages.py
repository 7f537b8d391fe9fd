"""The messages of a recording that are Foxglove's, so that viewers show them as they are."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp

from chsel.errors import RecordingError
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import POINT_CLASSES
from replay.mcap.encoding import parsed
from replay.mcap.schemas import PACKAGE, RECORDS
from replay.mcap.texts import check_text

LEVELS = 4
"""Clouds of all points so far of each class, see `viewer_messages.CumulativePoints`."""

SCENE: Mapping[str, type[Message]] = {
    "/object_mesh": SceneUpdate,
    "/object_surface": PointCloud,
    "/hypothesis_meshes": SceneUpdate,
    "/hypothesis_surfaces": PointCloud,
    "/next_probe": SceneUpdate,
    "/modes": SceneUpdate,
    **{f"/all_points/{kind}/{n}": PointCloud for kind in POINT_CLASSES for n in range(LEVELS)},
}
"""Topics of `viewer_messages` that show the object and all points so far."""

VIEWS: Mapping[str, type[Message]] = {
    "/object_pose": FrameTransform,
    "/gripper_path": PosesInFrame,
    "/hypothesis_poses": PosesInFrame,
    **SCENE,
}
"""Topics for viewers alone: they repeat what other messages say, and our reader ignores them."""

FOXGLOVE: Mapping[str, type[Message]] = {
    "/points/free": PointCloud,
    "/points/occupied": PointCloud,
    "/points/known": PointCloud,
    "/log": Log,
    **VIEWS,
}
"""Topics that carry Foxglove's messages. Points and log are the only copy of what they say."""

CLOUDS: Mapping[str, int] = {"/points/free": 3, "/points/occupied": 3, "/points/known": 4}
"""Columns of the clouds that hold points: x, y, z, and the signed distance."""

TOPIC_SCHEMAS: Mapping[str, str] = {
    **{topic: f"{PACKAGE}.{name}" for topic, name in RECORDS.items()},
    **{topic: kind.DESCRIPTOR.full_name for topic, kind in FOXGLOVE.items()},
}
"""The full name of the message on every topic of a recording."""

WORLD = "world"
UNMOVED = Pose(orientation=Quaternion(w=1.0))
_LEVELS = {"info": Log.INFO, "warning": Log.WARNING}
_NAMES = ("x", "y", "z", "sdf")


def point_cloud(points: FloatArray, time: int) -> bytes:
    """Return points (N, 3), or (N, 4) with their signed distance, in the world; exact."""
    columns = points.shape[1]
    cloud = PointCloud(
        timestamp=stamp(time),
        frame_id=WORLD,
        pose=UNMOVED,
        point_stride=8 * columns,
        fields=_fields(columns),
        data=np.ascontiguousarray(points, "<f8").tobytes(),
    )
    return serialized(cloud)


def cloud_points(data: bytes, columns: int) -> FloatArray:
    """Return the points (N, columns) of `point_cloud`; raise RecordingError for any other cloud."""
    message = parsed(PointCloud, data)
    stride = 8 * columns
    if message.point_stride != stride or list(message.fields) != _fields(columns):
        names = ", ".join(_NAMES[:columns])
        raise RecordingError(f"a point cloud has other fields than {names} as float64")
    if len(message.data) % stride:
        raise RecordingError(
            f"a point cloud has {len(message.data)} bytes, no multiple of {stride}"
        )
    return np.frombuffer(message.data, "<f8").astype(np.float64, copy=False).reshape(-1, columns)


def log_line(level: str, text: str, time: int) -> bytes:  # noqa: PLR0917
    """Return a line of text of level "info" or "warning"."""
    if level not in _LEVELS:
        raise RecordingError(f"log level is {level!r}; accepted: {', '.join(_LEVELS)}")
    check_text("a log line", text)
    return serialized(Log(timestamp=stamp(time), level=_LEVELS[level], message=text))


def log_level_and_text(data: bytes) -> tuple[str, str]:
    """Return the level and the text that `log_line` wrote."""
    message = parsed(Log, data)
    for name, level in _LEVELS.items():
        if message.level == level:
            check_text("a log line", message.message)
            return name, message.message
    raise RecordingError(f"a log line is of level {message.level}; accepted: {', '.join(_LEVELS)}")


def _fields(columns: int) -> list[PackedElementField]:
    return [
        PackedElementField(name=name, offset=8 * index, type=PackedElementField.FLOAT64)
        for index, name in enumerate(_NAMES[:columns])
    ]


def stamp(time: int) -> Timestamp:
    """Return a log time, nanoseconds."""
    seconds, nanos = divmod(time, 10**9)
    return Timestamp(seconds=seconds, nanos=nanos)


def serialized(message: Message) -> bytes:
    """Return the bytes of a message, the same each time."""
    data: bytes = message.SerializeToString(deterministic=True)
    return data
