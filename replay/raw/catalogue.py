"""Which topics and schemas a file of messages has, as the file describes them."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from mcap.opcode import Opcode

from replay.mcap.texts import one_line

_ROS_TEXTS = ("ros2msg", "ros1msg")
_SCHEMA, _CHANNEL, _LENGTH = struct.Struct("<H"), struct.Struct("<HH"), struct.Struct("<I")


@dataclass(frozen=True)
class Channel:
    """Messages of one topic and schema. definition: the schema's text, if it is one of ROS."""

    topic: str
    encoding: str
    schema: str
    definition: str | None = None


class Catalogue:
    """channels: by id, as far as they are described yet."""

    def __init__(self) -> None:
        self.channels: dict[int, Channel] = {}
        self._schemas: dict[int, tuple[str, str | None]] = {0: ("", None)}

    def describe(self, opcode: int, body: bytes) -> None:
        """Take note of a schema or channel; ValueError or struct.error if it is malformed."""
        if opcode == Opcode.SCHEMA:
            (number,) = _SCHEMA.unpack_from(body)
            name, place = _text(body, _SCHEMA.size)
            encoding, place = _text(body, place)
            definition = _text(body, place)[0] if encoding in _ROS_TEXTS else None
            self._schemas.setdefault(number, (name, definition))
            return
        number, schema = _CHANNEL.unpack_from(body)
        topic, place = _text(body, _CHANNEL.size)
        encoding, _ = _text(body, place)
        name, definition = self._schemas.get(schema, ("", None))
        channel = Channel(one_line(topic), one_line(encoding), one_line(name), definition)
        self.channels.setdefault(number, channel)


def _text(body: bytes, place: int) -> tuple[str, int]:
    """A text with its length ahead, and the place after it."""
    (length,) = _LENGTH.unpack_from(body, place)
    start = place + _LENGTH.size
    if start + length > len(body):
        raise ValueError("a text does not fit into its record")
    return body[start : start + length].decode("utf-8", "replace"), start + length
