"""How two recordings differ: message by message, each number to the bit."""

from __future__ import annotations

import filecmp
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TypeVar

from replay.comparing.differences import Difference, differences
from replay.comparing.message_content import Content, attachment_content, message_content
from replay.comparing.message_pairs import (
    BEFORE_ALL_STEPS,
    MALFORMED,
    ComparedRecording,
    Ignored,
    Key,
    MessagePair,
    message_pairs,
)
from replay.mcap.file import StoredMessage
from replay.mcap.schemas import RECORDS

BOTH, FIRST, SECOND = "both", "first", "second"
Stored = TypeVar("Stored", bytes, StoredMessage)


@dataclass(frozen=True, kw_only=True)
class MessageDifference(Difference):
    """A field that differs between two messages, or a message that one recording alone has."""

    key: Key
    having: str = BOTH  # which of the recordings have the message: "both", "first" or "second"

    def __str__(self) -> str:
        return f"{self.key}: {self.text}"


@dataclass
class TopicDiff:
    """What differs on one topic, or in one attachment."""

    count: int = 0  # of messages in either recording
    differing: int = 0  # of those in both
    only_first: int = 0  # without a counterpart
    only_second: int = 0
    steps: set[int] = field(default_factory=set)  # in which something differs
    fields: Counter[str] = field(default_factory=Counter)  # in how many messages each differs
    largest_ulps: int | None = None  # None without numbers

    @property
    def is_equal(self) -> bool:
        """Whether nothing differs."""
        return not (self.differing or self.only_first or self.only_second)


@dataclass
class RecordingDiff:
    """All that differs between two recordings."""

    same_bytes: bool  # whether the files are equal
    topics: dict[str, TopicDiff] = field(default_factory=dict)  # every topic and attachment met
    # In the order of the first recording, all or as many as were to be kept.
    differences: list[MessageDifference] = field(default_factory=list)

    @property
    def is_equal(self) -> bool:
        """Whether the recordings say the same."""
        return all(topic.is_equal for topic in self.topics.values())


def recording_diff(
    first: Path, second: Path, *, ignored: Ignored | None = None, keep: int | None = None
) -> RecordingDiff:
    """Compare two recordings, each read twice and never held as a whole.

    What is drawn for viewers alone (`SCENE`) is left out: it follows from the rest.

    keep: how many differences to keep beside those of the session's start; None: all. Raises
    RecordingError if a file cannot be read, or one of its checksums is wrong.
    """
    ignored = ignored or Ignored()
    one, other = ComparedRecording(first, ignored), ComparedRecording(second, ignored)
    found = RecordingDiff(filecmp.cmp(one.path, other.path, shallow=False))
    if found.same_bytes:
        return found
    for name in dict.fromkeys([*one.attachments, *other.attachments]):
        key = Key(name, BEFORE_ALL_STEPS, "", 0)
        pair = (one.attachments.get(name), other.attachments.get(name))
        _take(found, key, _compared(key, *pair, partial(attachment_content, name), ignored), keep)
    for paired in message_pairs(one, other):
        _take(found, paired.key, _compared_messages(paired, ignored), keep)
    return found


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


def _compared_messages(pair: MessagePair, ignored: Ignored) -> list[MessageDifference]:
    key, first, second, moved = pair
    order = "order: it stands later in the second recording"
    found = [MessageDifference(key=key, field="order", text=order)] if moved else []
    same = first is not None and second is not None and first.data == second.data
    if same and key.topic in RECORDS:  # else its time stamp may differ from its log time
        return found
    return found + _compared(key, first, second, message_content, ignored)


def _compared(
    key: Key,
    first: Stored | None,
    second: Stored | None,
    read: Callable[[Stored], Content],
    ignored: Ignored,
) -> list[MessageDifference]:
    """What differs between two messages or attachments, or which of them there is alone."""
    if first is None or second is None:
        having = FIRST if second is None else SECOND
        text = f"only in the {having} recording"
        return [MessageDifference(key=key, having=having, field="", text=text)]
    if first is second or first == second:
        return []
    return [
        MessageDifference(key=key, **vars(found))
        for found in differences(_content(read, first), _content(read, second))
        if not ignored.field(found.field)
    ]


def _content(read: Callable[[Stored], Content], stored: Stored) -> Content:
    """The content; of what is malformed, the mere bytes and why it is."""
    try:
        return read(stored)
    except MALFORMED as error:
        data = stored if isinstance(stored, bytes) else stored.data
        return {"malformed": str(error), "bytes": data}
