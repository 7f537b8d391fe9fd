"""The names of frames in messages of any kind, without a look at the rest of them."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any

from google.protobuf.message import DecodeError

from chsel.errors import RecordingError
from replay.mcap.texts import one_line
from replay.mcap.wire import check_wire
from replay.raw.channels import Channel

_MOST_TRANSFORMS = 1000  # in one message
_LONGEST_FRAME = 200  # bytes
_LARGEST_JSON = 2**16  # bytes
_FOXGLOVE = re.compile(r"foxglove\.([A-Za-z0-9]+)")
_ERRORS = (struct.error, ValueError, RecursionError, DecodeError, RecordingError)


def frames(channel: Channel, data: bytes) -> tuple[str, ...]:
    """The frames that a message names; of transforms "PARENT > CHILD".

    None where a message has none, is damaged, or is of a kind whose frames are not known: ROS
    messages that begin with a header, transforms, Foxglove's messages and JSON are.
    """
    found = _READERS.get(channel.encoding)
    try:
        names = found(channel, data) if found else ()
    except _ERRORS:
        return ()
    return tuple(one_line(name) for name in names if name and len(name) <= _LONGEST_FRAME)


class _Cdr:
    """Reads the fields of a CDR message, one after the other."""

    def __init__(self, data: bytes) -> None:
        self._data, self._place = data, 4  # behind the encapsulation
        self._order = "<" if data[1:2] == b"\x01" else ">"

    def number(self) -> int:
        """A 32-bit number."""
        self.align(4)
        (value,) = struct.unpack_from(f"{self._order}I", self._data, self._place)
        self._place += 4
        return int(value)

    def text(self) -> str:
        """A text; ValueError for one that is longer than any frame's name."""
        length = self.number()
        text, self._place = _text(self._data, self._place, length)
        return text.removesuffix("\0")

    def stamped_frame(self) -> str:
        """The frame of a std_msgs/Header."""
        self.number()
        self.number()
        return self.text()

    def align(self, size: int, skipped: int = 0) -> None:
        """Go to the next multiple of a size, and by so many bytes further."""
        self._place += -(self._place - 4) % size + skipped


def _ros2(channel: Channel, data: bytes) -> tuple[str, ...]:
    message, name = _Cdr(data), channel.schema.replace("/msg/", "/")
    if name == "tf2_msgs/TFMessage":
        return tuple(_transform(message) for _ in range(min(message.number(), _MOST_TRANSFORMS)))
    if name == "geometry_msgs/TransformStamped":
        return (_transform(message),)
    return (message.stamped_frame(),) if _has_header(channel.definition or "") else ()


def _transform(message: _Cdr) -> str:
    """Parent and child of a geometry_msgs/TransformStamped."""
    names = message.stamped_frame(), message.text()
    message.align(8, skipped=56)  # position and quaternion
    return " > ".join(names)


def _ros1(channel: Channel, data: bytes) -> tuple[str, ...]:
    if not _has_header(channel.definition or ""):
        return ()
    return (_text(data, 16, struct.unpack_from("<I", data, 12)[0])[0],)


def _text(data: bytes, place: int, length: int) -> tuple[str, int]:
    """A text of so many bytes, and the place after it."""
    if length > _LONGEST_FRAME or place + length > len(data):
        raise ValueError("too long for the name of a frame")
    return data[place : place + length].decode("utf-8", "replace"), place + length


@cache
def _has_header(definition: str) -> bool:
    """Whether the first field of a ROS message is a header."""
    for line in definition.splitlines():
        words = line.split("#")[0].split()
        if words and not any("=" in word for word in words):
            return words[0].split("/")[-1] == "Header"
    return False


def _foxglove(channel: Channel, data: bytes) -> tuple[str, ...]:
    kind = _kind(channel.schema)
    if kind is None:
        return ()
    check_wire(kind.DESCRIPTOR, data)
    message = kind.FromString(data)
    several = getattr(message, "transforms", [message])
    return tuple(_frame_of(part) for part in several[:_MOST_TRANSFORMS])


def _frame_of(message: Any) -> str:
    if hasattr(message, "child_frame_id"):
        return f"{message.parent_frame_id} > {message.child_frame_id}"
    return getattr(message, "frame_id", "")


@cache
def _kind(name: str) -> Any:
    """The installed class of a message of Foxglove's, never one that a file describes."""
    known = _FOXGLOVE.fullmatch(name)
    try:
        module = import_module(f"foxglove_schemas_protobuf.{known[1]}_pb2") if known else None
        return getattr(module, known[1], None) if known else None
    except ImportError:
        return None


def _json(channel: Channel, data: bytes) -> tuple[str, ...]:
    values = json.loads(data) if len(data) <= _LARGEST_JSON else None
    if not isinstance(values, dict):
        return ()
    header = values.get("header")
    name = values.get("frame_id", header.get("frame_id") if isinstance(header, dict) else None)
    return (name,) if isinstance(name, str) else ()


_READERS: dict[str, Callable[[Channel, bytes], tuple[str, ...]]] = {
    "cdr": _ros2,
    "ros1": _ros1,
    "protobuf": _foxglove,
    "json": _json,
}
