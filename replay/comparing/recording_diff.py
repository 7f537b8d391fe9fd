"""How two recordings differ: message by message, each number to the bit."""

from __future__ import annotations

import filecmp
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from chsel.errors import ChselError, RecordingError, SettingError
from replay.comparing.differences import Difference, differences
from replay.comparing.message_content import (
    Content,
    attachment_content,
    message_content,
    printable,
    step_of,
)
from replay.mcap.attachments import MESH, SDF_GRID
from replay.mcap.encoding import decode
from replay.mcap.file import McapFile, StoredMessage
from replay.mcap.foxglove_messages import FOXGLOVE, SCENE, TOPIC_SCHEMAS
from replay.mcap.schemas import MESSAGES, RECORDS
from replay.mcap.seal import CONTENTS, SEAL

BOTH, FIRST, SECOND = "both", "first", "second"
_BEFORE_ALL_STEPS = -1
_MALFORMED = (ChselError, ValueError, RecursionError)


class Key(NamedTuple):
    """What two messages have in common to be compared: `number` counts those with the same rest.

    about: stage and iteration of a trace or archive, sensor of an image, else empty.
    """

    topic: str
    step: int
    about: str
    number: int

    @property
    def kind(self) -> tuple[str, int, str]:
        """All but the number."""
        return self[:3]

    def __str__(self) -> str:
        parts = [printable(self.topic)]
        if self.topic.startswith("/"):
            parts.append("start" if self.step == _BEFORE_ALL_STEPS else f"step {self.step}")
        parts += [printable(self.about)] if self.about else []
        parts += [f"number {self.number + 1}"] if self.number else []
        return ", ".join(parts)


@dataclass(frozen=True, kw_only=True)
class MessageDifference(Difference):
    """A field that differs between two messages, or a message that one recording alone has."""

    key: Key
    having: str = BOTH  # which of the recordings have the message: "both", "first" or "second"

    def __str__(self) -> str:
        return f"{self.key}: {self.text}"


@dataclass
class TopicDiff:
    """What differs on one topic, or in one attachment.

    count: of messages in either. differing: of those in both. only_first, only_second: without a
    counterpart. fields: in how many messages each differs. largest_ulps: None without numbers.
    """

    count: int = 0
    differing: int = 0
    only_first: int = 0
    only_second: int = 0
    steps: set[int] = field(default_factory=set)
    fields: Counter[str] = field(default_factory=Counter)
    largest_ulps: int | None = None

    @property
    def is_equal(self) -> bool:
        """Whether nothing differs."""
        return not (self.differing or self.only_first or self.only_second)


@dataclass
class RecordingDiff:
    """All that differs between two recordings.

    same_bytes: whether the files are equal. topics: every topic and attachment met. differences:
    in the order of the first recording, all or as many as were to be kept.
    """

    same_bytes: bool
    topics: dict[str, TopicDiff] = field(default_factory=dict)
    differences: list[MessageDifference] = field(default_factory=list)

    @property
    def is_equal(self) -> bool:
        """Whether the recordings say the same."""
        return all(topic.is_equal for topic in self.topics.values())


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


def recording_diff(
    first: Path, second: Path, *, ignored: Ignored | None = None, keep: int | None = None
) -> RecordingDiff:
    """Compare two recordings, each read twice and never held as a whole.

    What is drawn for viewers alone (`SCENE`) is left out: it follows from the rest.

    keep: how many differences to keep beside those of the session's start; None: all. Raises
    RecordingError if a file cannot be read, or one of its checksums is wrong.
    """
    ignored = ignored or Ignored()
    one, other = _Survey(first, ignored), _Survey(second, ignored)
    found = RecordingDiff(filecmp.cmp(one.path, other.path, shallow=False))
    if not found.same_bytes:
        for name in dict.fromkeys([*one.attachments, *other.attachments]):
            pair = (one.attachments.get(name), other.attachments.get(name))
            key = Key(name, _BEFORE_ALL_STEPS, "", 0)
            _take(found, key, _compared_attachments(key, *pair, ignored), keep)
        for paired in _pairs(one, other):
            _take(found, paired.key, _compared_messages(paired, ignored), keep)
    return found


class _Survey:
    """What is in a recording: attachments, and how many messages of each kind."""

    def __init__(self, path: Path, ignored: Ignored) -> None:
        self.path = path.expanduser()
        self._ignored = ignored
        self.attachments: dict[str, bytes] = {}
        self.counts = Counter(key.kind for key, _ in self.messages())

    def messages(self) -> Iterator[tuple[Key, StoredMessage]]:
        """All messages that are not left out, in their order, as the file has them.

        Seals follow from the messages that they close, and what viewers draw from the rest.
        """
        file = McapFile(self.path, TOPIC_SCHEMAS, check_seals=False)  # to see what was changed
        numbers: Counter[tuple[str, int, str]] = Counter()
        for message in file.messages():
            derived = message.topic == SEAL or message.topic in SCENE
            if not derived and not self._ignored.topic(message.topic):
                kind = (message.topic, step_of(message), _about(message))
                yield Key(*kind, numbers[kind]), message
                numbers[kind] += 1
        self.attachments = {
            name: data for name, data in file.attachments.items() if not self._ignored.topic(name)
        }

    def has(self, key: Key) -> bool:
        """Whether there is such a message."""
        return key.number < self.counts[key.kind]


class _Pair(NamedTuple):
    """Messages that belong together; moved: whether others of the first stand between them."""

    key: Key
    first: StoredMessage | None
    second: StoredMessage | None
    moved: bool = False


def _pairs(first: _Survey, second: _Survey) -> Iterator[_Pair]:
    """Pairs in the order of the first recording.

    A message that the second alone has comes where it stands there. Messages wait only where the
    orders of the two recordings differ.
    """
    waiting: dict[Key, StoredMessage] = {}
    others = second.messages()
    for key, message in first.messages():
        if not second.has(key):
            yield _Pair(key, message, None)
            continue
        while key not in waiting:
            other_key, other = next(others, (None, None))
            if other_key is None or other is None:
                raise RecordingError(f"recording {second.path} has changed while it was read")
            if first.has(other_key):
                waiting[other_key] = other
            else:
                yield _Pair(other_key, None, other)
        found = waiting.pop(key)
        yield _Pair(key, message, found, moved=bool(waiting))
    for other_key, other in others:
        yield _Pair(other_key, None, other)


def _about(message: StoredMessage) -> str:
    """Stage and iteration of a trace or archive, sensor of an image.

    By these another number of them shifts nothing.
    """
    if message.topic in ("/trace", "/archive", "/sensor_image"):
        with suppress(*_MALFORMED):
            values = decode(RECORDS[message.topic], message.data)
            if "sensor" in values:
                return str(values["sensor"])
            stage = f"{values['stage']} " if "stage" in values else ""
            later = f" (pass {values['refinement'] + 1})" if values.get("refinement") else ""
            return f"{stage}iteration {values['iteration']}{later}"
    return ""


def _take(
    found: RecordingDiff, key: Key, differences: Sequence[MessageDifference], keep: int | None
) -> None:
    """Count a message or attachment and its differences."""
    topic = found.topics.setdefault(key.topic, TopicDiff())
    topic.count += 1
    if not differences:
        return
    having = differences[0].having
    topic.differing += having == BOTH
    topic.only_first += having == FIRST
    topic.only_second += having == SECOND
    topic.steps.add(key.step)
    topic.fields.update(item.field for item in differences if item.field)
    ulps = [item.ulps for item in differences if item.ulps is not None]
    topic.largest_ulps = max([*ulps, topic.largest_ulps or 0]) if ulps else topic.largest_ulps
    for item in differences:
        if keep is None or len(found.differences) < keep or key.topic == "/session":
            found.differences.append(item)


def _compared_messages(pair: _Pair, ignored: Ignored) -> list[MessageDifference]:
    key, first, second, moved = pair
    if first is None or second is None:
        return [_lonely(key, FIRST if second is None else SECOND)]
    order = "order: it stands later in the second recording"
    found = [MessageDifference(key=key, field="order", text=order)] if moved else []
    if first.data == second.data and key.topic in RECORDS:
        return found
    one, other = (dict(_read(message_content, message)) for message in (first, second))
    if key.topic == CONTENTS:
        for name in ("session", "digest"):  # these follow from the seals
            one.pop(name, None)
            other.pop(name, None)
    return found + _compared(key, one, other, ignored)


def _compared_attachments(
    key: Key, first: bytes | None, second: bytes | None, ignored: Ignored
) -> list[MessageDifference]:
    if first is None or second is None:
        return [_lonely(key, FIRST if second is None else SECOND)]
    if first == second:
        return []
    one = _read(attachment_content, key.topic, first)
    return _compared(key, one, _read(attachment_content, key.topic, second), ignored)


def _read(read: Callable[..., Content], *arguments: Any) -> Content:
    """The content; of what is malformed, the mere bytes and why it is."""
    try:
        return read(*arguments)
    except _MALFORMED as error:
        data = arguments[-1]
        data = data.data if isinstance(data, StoredMessage) else data
        return {"malformed": str(error), "bytes": data}


def _compared(
    key: Key, first: Content, second: Content, ignored: Ignored
) -> list[MessageDifference]:
    return [
        MessageDifference(key=key, **vars(found))
        for found in differences(first, second)
        if not ignored.field(found.field)
    ]


def _lonely(key: Key, having: str) -> MessageDifference:
    text = f"only in the {having} recording"
    return MessageDifference(key=key, having=having, field="", text=text)


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
