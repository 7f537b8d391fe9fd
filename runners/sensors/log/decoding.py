"""From the bytes of a message to what it says, by the name of its schema and its encoding."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

from runners.sensors.log.foxglove import foxglove_decoder
from runners.sensors.log.message_fields import Said
from runners.sensors.log.messages import Content, TransformMessage, UnusableMessage
from runners.sensors.log.ros2 import ros2_decoder
from runners.sensors.log.ros2_definitions import is_laid_out, short_name

Decode = Callable[[bytes], Iterator[Said]]

_STATIC = "tf_static"


def decoder(topic: str, schema: str, encoding: str, definition: str | None = None) -> Decode:
    """What the messages of a topic say, or UnusableMessage for topics that are not read.

    definition: the ROS 2 text of the schema in the file, where there is one; a message that is
    made up of other fields than by ROS 2 itself cannot be read in its place.
    """
    found = {"cdr": ros2_decoder, "protobuf": foxglove_decoder}.get(encoding, _none)(schema)
    if found is None:
        raise UnusableMessage(f"messages {schema} as {encoding or 'unknown bytes'} are not read")
    if encoding == "cdr" and definition and not is_laid_out(short_name(schema), definition):
        raise UnusableMessage(f"messages {schema} have other fields than those of ROS 2")
    if not topic.endswith(_STATIC):
        return found

    def static(data: bytes) -> Iterator[Said]:
        for stamp, content in found(data):
            yield stamp, _held(content)

    return static


def _held(content: Content | UnusableMessage) -> Content | UnusableMessage:
    """A transform that holds for all times."""
    if isinstance(content, TransformMessage):
        return dataclasses.replace(content, static=True)
    return content


def _none(schema: str) -> None:
    """No message of another encoding is read."""
