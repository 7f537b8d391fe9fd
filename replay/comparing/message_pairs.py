"""Which messages of two recordings are compared with each other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from chsel.errors import ChselError, RecordingError, SettingError
from replay.comparing.message_content import step_of
from replay.mcap.attachments import MESH, SDF_GRID
from replay.mcap.encoding import decode
from replay.mcap.file import McapFile, StoredMessage
from replay.mcap.foxglove_messages import FOXGLOVE, SCENE, TOPIC_SCHEMAS
from replay.mcap.schemas import MESSAGES, RECORDS

BEFORE_ALL_STEPS = -1
MALFORMED = (ChselError, ValueError, RecursionError)
"""What reading a message raises that says something else than it should."""


class Key(NamedTuple):
    """What two messages have in common to be compared."""

    topic: str
    step: int
    about: str  # stage and iteration of a trace or archive, sensor of an image, else empty
    number: int  # counts messages with the same rest

    @property
    def kind(self) -> tuple[str, int, str]:
        """All but the number."""
        return self[:3]

    def __str__(self) -> str:
        parts = [self.topic]
        if self.topic.startswith("/"):
            parts.append("start" if self.step == BEFORE_ALL_STEPS else f"step {self.step}")
        parts += [self.about] if self.about else []
        parts += [f"number {self.number + 1}"] if self.number else []
        return ", ".join(parts)


class Ignored:
    """What is left out: topics ("/timed", or "/points" for all below it), attachments, fields.

    A word without "/" is each of these that has the name, and what is nested in it.
    """

    def __init__(self, words: Sequence[str] = ()) -> None:
        """Raises SettingError for a word that names nothing."""
        for word in words:
            if not _is_known(word):
                accepted = ", ".join([*RECORDS, *FOXGLOVE, MESH, SDF_GRID])
                raise SettingError(
                    f"{word!r} names nothing in a recording; accepted: names of fields, {accepted}"
                )
        self._words = tuple(words)

    def topic(self, name: str) -> bool:
        """Whether a whole topic or attachment is left out."""
        return any(_is_topic(word, name) or word == name for word in self._words)

    def field(self, path: str) -> bool:
        """Whether a field is left out."""
        return any(
            path == word or path.startswith((f"{word}.", f"{word}[")) for word in self._words
        )


class ComparedRecording:
    """What is in a recording: attachments, and how many messages of each kind."""

    def __init__(self, path: Path, ignored: Ignored) -> None:
        self.path = path.expanduser()
        self._ignored = ignored
        self.attachments: dict[str, bytes] = {}
        self.counts = Counter(key.kind for key, _ in self.messages())

    def messages(self) -> Iterator[tuple[Key, StoredMessage]]:
        """All messages that are not left out, in their order, as the file has them.

        What viewers draw follows from the rest.
        """
        file = McapFile(self.path, TOPIC_SCHEMAS)
        numbers: Counter[tuple[str, int, str]] = Counter()
        for message in file.messages():
            if message.topic not in SCENE and not self._ignored.topic(message.topic):
                kind = (message.topic, step_of(message), _about(message))
                yield Key(*kind, numbers[kind]), message
                numbers[kind] += 1
        self.attachments = {
            name: data for name, data in file.attachments.items() if not self._ignored.topic(name)
        }

    def has(self, key: Key) -> bool:
        """Whether there is such a message."""
        return key.number < self.counts[key.kind]


class MessagePair(NamedTuple):
    """Messages that belong together."""

    key: Key
    first: StoredMessage | None
    second: StoredMessage | None
    moved: bool = False  # whether others of the first stand between them


def message_pairs(first: ComparedRecording, second: ComparedRecording) -> Iterator[MessagePair]:
    """Pairs in the order of the first recording.

    A message that the second alone has comes where it stands there. Messages wait only where the
    orders of the two recordings differ.
    """
    waiting: dict[Key, StoredMessage] = {}
    others = second.messages()
    for key, message in first.messages():
        if not second.has(key):
            yield MessagePair(key, message, None)
            continue
        while key not in waiting:
            other_key, other = next(others, (None, None))
            if other_key is None or other is None:
                raise RecordingError(f"recording {second.path} has changed while it was read")
            if first.has(other_key):
                waiting[other_key] = other
            else:
                yield MessagePair(other_key, None, other)
        found = waiting.pop(key)
        yield MessagePair(key, message, found, moved=bool(waiting))
    for other_key, other in others:
        yield MessagePair(other_key, None, other)


def _about(message: StoredMessage) -> str:
    """Stage and iteration of a trace or archive, sensor of an image.

    By these another number of them shifts nothing.
    """
    if message.topic in ("/trace", "/archive", "/sensor_image"):
        with suppress(*MALFORMED):
            values = decode(RECORDS[message.topic], message.data)
            if "sensor" in values:
                return str(values["sensor"])
            stage = f"{values['stage']} " if "stage" in values else ""
            later = f" (pass {values['refinement'] + 1})" if values.get("refinement") else ""
            return f"{stage}iteration {values['iteration']}{later}"
    return ""


def _is_topic(word: str, name: str) -> bool:
    """Whether a word is a topic, or a part of the topics that a topic belongs to."""
    topic = "/" + word.strip("/")
    return name == topic or name.startswith(f"{topic}/")


def _is_known(word: str) -> bool:
    """Whether a word names topics, attachments or fields."""
    fields = {name for message in MESSAGES.values() for name in message}
    fields |= {field.name for kind in FOXGLOVE.values() for field in kind.DESCRIPTOR.fields}
    fields |= {MESH, SDF_GRID, "points", "poses", "vertices", "faces"}
    topic = any(_is_topic(word, name) for name in (*RECORDS, *FOXGLOVE))
    return topic or word in fields or word.split(".")[0].split("[")[0] in fields
