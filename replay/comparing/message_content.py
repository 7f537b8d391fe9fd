"""What a message or an attachment says, as a flat mapping from names to values."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError, Message

from chsel.errors import RecordingError
from replay.mcap.attachments import MESH, SDF_GRID, mesh_from_ply
from replay.mcap.encoding import decode
from replay.mcap.event_messages import image_from
from replay.mcap.file import StoredMessage
from replay.mcap.foxglove_messages import CLOUDS, FOXGLOVE, cloud_points
from replay.mcap.schemas import RECORDS, STEP_TIME

Content = dict[str, Any]
"""Arrays, numbers, texts and None by path, such as "config.method.cost.free_scale"."""

_POSES = ("/gripper_path", "/hypothesis_poses")


def step_of(message: StoredMessage) -> int:
    """The step of a message, -1 before all of them."""
    return message.log_time // STEP_TIME - 1


def printable(text: str) -> str:
    """A text for a terminal; quoted and escaped if it holds control characters."""
    return text if text.isprintable() else repr(text)


def message_content(message: StoredMessage) -> Content:
    """All that a message says; RecordingError if it is malformed.

    The time stamp of a viewer's message is left out where it repeats the log time, which counts
    messages: it would differ in all that follow a message too many.
    """
    if message.topic not in RECORDS:
        return _flat(_foxglove_values(message))
    values = decode(RECORDS[message.topic], message.data)
    if message.topic == "/session":
        values["config"] = _parsed_or_text(values["config"])
    elif message.topic == "/sensor_image":
        seen = image_from(values)
        values |= {"values": seen.values, "mask": seen.mask}
    return _flat(values)


def attachment_content(name: str, data: bytes) -> Content:
    """All that an attachment says; RecordingError if it is malformed."""
    if name == MESH:
        mesh = mesh_from_ply(data)
        return {"vertices": mesh.vertices.view(np.ndarray), "faces": mesh.faces.view(np.ndarray)}
    if name == SDF_GRID:
        return _flat(decode("SdfGrid", data))
    return {"bytes": data}


def _parsed_or_text(config: str) -> Any:
    try:
        return json.loads(config)
    except (ValueError, RecursionError):
        return config


def _flat(values: Mapping[str, Any]) -> Content:
    """Nested values by their paths, those of {"a.b": 0, "a": {"b": 1}} apart, too."""
    flat: Content = {}
    for path, value in _leaves("", values):
        path = printable(path)
        while path in flat:
            path += "'"
        flat[path] = value
    return flat


def _leaves(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    """The values at the ends of nested mappings and lists, with their paths."""
    if isinstance(value, Mapping) and value:
        for name, inner in value.items():
            yield from _leaves(f"{path}.{name}" if path else str(name), inner)
    elif isinstance(value, list | tuple) and value:
        for index, inner in enumerate(value):
            yield from _leaves(f"{path}[{index}]", inner)
    else:
        yield path, value


def _foxglove_values(message: StoredMessage) -> dict[str, Any]:
    kind = FOXGLOVE[message.topic]
    try:
        parsed: Any = kind.FromString(message.data)
    except DecodeError:
        raise RecordingError(f"a message is not a valid {kind.DESCRIPTOR.full_name}") from None
    values: dict[str, Any] = {}
    if not parsed.HasField("timestamp"):
        values["timestamp"] = None
    elif parsed.timestamp.seconds * 10**9 + parsed.timestamp.nanos == message.log_time:
        parsed.ClearField("timestamp")
    if message.topic in CLOUDS:
        values["points"] = cloud_points(message.data, CLOUDS[message.topic])
        for name in ("data", "fields", "point_stride"):
            parsed.ClearField(name)
    elif message.topic in _POSES:
        values["poses"] = np.array([_pose(pose) for pose in parsed.poses]).reshape(-1, 7)
        parsed.ClearField("poses")
    return values | _plain(parsed)


def _pose(pose: Any) -> list[float]:
    """Position and quaternion."""
    p, q = pose.position, pose.orientation
    return [p.x, p.y, p.z, q.x, q.y, q.z, q.w]


def _plain(message: Any) -> dict[str, Any]:
    """The fields of any protobuf message; those that are messages only where they are set."""
    values: dict[str, Any] = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        if isinstance(value, Message):
            if message.HasField(field.name):
                values[field.name] = _plain(value)
        elif isinstance(value, int | float | str | bytes):
            values[field.name] = value
        elif len(value):
            values[field.name] = [_plain(i) if isinstance(i, Message) else i for i in value]
    return values
