"""Which topics and schemas a file of messages has, as the file describes them."""

from __future__ import annotations

from dataclasses import dataclass

from mcap import records

from replay.mcap.texts import one_line

_ROS_TEXTS = ("ros2msg", "ros1msg")


@dataclass(frozen=True)
class Channel:
    """Messages of one topic and schema."""

    topic: str
    encoding: str
    schema: str  # its name
    definition: str | None = None  # the schema's text, if it is one of ROS


class Channels:
    """The channels that were described so far."""

    def __init__(self) -> None:
        self.by_id: dict[int, Channel] = {}
        self._schemas: dict[int, tuple[str, str | None]] = {0: ("", None)}

    def describe(self, part: records.Schema | records.Channel) -> None:
        """Take note of a schema or channel; of two with one number the first stays.

        Raises ValueError for a channel whose schema was lost, as its messages may be anything.
        """
        if isinstance(part, records.Schema):
            is_ros = part.encoding in _ROS_TEXTS
            definition = part.data.decode("utf-8", "replace") if is_ros else None
            self._schemas.setdefault(part.id, (part.name, definition))
            return
        if part.schema_id not in self._schemas:
            raise ValueError(f"{part.topic}: a channel of a schema that is not described")
        name, definition = self._schemas[part.schema_id]
        topic, encoding = one_line(part.topic), one_line(part.message_encoding)
        self.by_id.setdefault(part.id, Channel(topic, encoding, one_line(name), definition))
