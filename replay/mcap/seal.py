"""The chain of seals that ties every record of a recording to its session and to its place.

A seal ends the session's start, every step and every chunk. It has a digest for each topic with
messages since the seal before it, and a digest over these, the session's identity and the digest of
the seal before it. Whoever changes a record must therefore make all later seals again, and gets
another digest of the recording.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Mapping
from typing import Any

from mcap.records import Attachment, Channel, Message, Schema

from chsel.errors import ChselError
from replay.mcap.encoding import decode
from replay.mcap.schemas import BEFORE_ALL_STEPS, MESH, SDF_GRID, STEP_TIME
from replay.mcap.texts import one_line

SEAL, CONTENTS = "/seal", "/contents"
MIXED = "two recordings are mixed in this file"
_DIGEST_SIZE = 16  # bytes
_SCHEMAS = "a schema or channel"  # names of digests that no topic has
_HEADS = "the order or times of messages"
_HEAD = struct.Struct("<QQQ")  # sequence, log time, publish time
_LENGTH = struct.Struct("<Q")


class Chain:
    """Follows the records of one recording, as they are written or read.

    session: its identity, the digest of all before the first seal; "" until there is one.
    last: digest of the last seal, which at the end is the digest of the recording.
    lost: attachments that the first seal has a digest of, but that were not there or other ones.
    """

    def __init__(self, *, forgiving: bool = False) -> None:
        """forgiving: attachments may be lost; see `lost`."""
        self.session = ""
        self.last = ""
        self.lost: list[str] = []
        self._forgiving = forgiving
        self._states: dict[str, Any] = {}  # of digests since the last seal
        self._gap = False
        self._step = BEFORE_ALL_STEPS  # of the last seal

    @property
    def is_open(self) -> bool:
        """Whether there are records that no seal has closed yet."""
        return bool(self._states)

    def attach(self, record: Attachment) -> None:
        """An attachment is written or read."""
        head = _HEAD.pack(0, record.create_time, record.log_time)
        self._add(record.name, head, record.media_type.encode(), record.data)

    def describe(self, record: Schema | Channel) -> None:
        """A schema or channel is written or read."""
        if isinstance(record, Schema):
            texts = ["schema", str(record.id), record.name, record.encoding]
            self._add(_SCHEMAS, *(text.encode() for text in texts), record.data)
        else:
            texts = ["channel", str(record.id), str(record.schema_id), record.topic]
            texts += [record.message_encoding, repr(sorted(record.metadata.items()))]
            self._add(_SCHEMAS, *(text.encode() for text in texts))

    def write(self, topic: str, message: Message) -> None:
        """A message is written. That of the contents follows from those before it."""
        if topic not in (SEAL, CONTENTS):
            self._add(topic, message.data)
            self._add(_HEADS, topic.encode(), _head(message))

    def read(self, topic: str, message: Message) -> None:
        """A message is read. Raises ValueError if it is a seal that does not fit."""
        try:
            if topic == SEAL:
                self._follow(decode("Seal", message.data), message)
            elif topic == CONTENTS:
                self._compare_contents(decode("Contents", message.data), message)
        except ChselError as error:
            raise ValueError(one_line(str(error))) from None
        self.write(topic, message)

    def skip(self) -> None:
        """Records are missing here: the next seal cannot follow from the last one."""
        self._states.clear()
        self._gap = True

    def sealed(self, step: int, sequence: int, time: int) -> dict[str, Any]:
        """The values of the seal that closes the records so far, and is message `sequence`."""
        parts = self._parts()
        values = {
            "step": step,
            "session": self.session or _digest(*_texts(parts)),
            "previous": self.last,
            "parts": parts,
        }
        head = Message(0, time, b"", time, sequence)
        values["digest"] = _digest_of(values, head)
        self._go_on(values)
        return values

    def _follow(self, values: dict[str, Any], message: Message) -> None:
        """Compare a seal with the records before it, and go on behind it."""
        step = values["step"]
        if self.session and values["session"] != self.session:
            raise ValueError(f"step {step} belongs to another recording: {MIXED}")
        recorded = values["parts"]
        self._compare(recorded, "the session's start" if step < 0 else f"step {step}")
        if values["previous"] != self.last and not self._gap:
            raise ValueError(f"step {step} does not follow the step before it, which was changed")
        first = self.session or _digest(*_texts(recorded))
        if values["digest"] != _digest_of(values, message) or values["session"] != first:
            raise ValueError(f"the seal of step {step} was changed after it was written")
        self._go_on(values)

    def _compare(self, recorded: Mapping[str, str], where: str) -> None:
        """Raise ValueError unless the records since the last seal have the digests it lists."""
        found = self._parts()
        differing = {n for n in {*recorded, *found} if recorded.get(n) != found.get(n)}
        if self._forgiving and not self.session:
            self.lost = [name for name in (MESH, SDF_GRID) if name in differing & set(recorded)]
            differing -= set(self.lost)
        names = sorted(differing - {_HEADS}) or sorted(differing)
        if names:
            texts = []
            for name in names:
                changed = "is missing" if name not in found else "was added"
                changed = "was changed" if name in found and name in recorded else changed
                texts.append(f"{name} {changed}")
            raise ValueError(f"{', '.join(texts)} after it was written, in {where}")

    def _compare_contents(self, values: dict[str, Any], message: Message) -> None:
        """The contents name the session and the last seal; nothing else vouches for their time."""
        if values["session"] != self.session:
            raise ValueError(f"its contents belong to another recording: {MIXED}")
        if values["digest"] != self.last and not self._gap:
            raise ValueError("its contents have another digest than its last step")
        time = (self._step - BEFORE_ALL_STEPS) * STEP_TIME + message.sequence
        if self.session and not message.log_time == message.publish_time == time:
            raise ValueError("the time of its contents was changed after it was written")

    def _go_on(self, values: Mapping[str, Any]) -> None:
        self.session, self.last, self._step = values["session"], values["digest"], values["step"]
        self._states.clear()
        self._gap = False

    def _add(self, name: str, *parts: bytes) -> None:
        state = self._states.get(name)
        if state is None:
            state = self._states[name] = hashlib.blake2b(digest_size=_DIGEST_SIZE)
        _update(state, parts)

    def _parts(self) -> dict[str, str]:
        """Digests of the records since the last seal, by name."""
        return {name: self._states[name].hexdigest() for name in sorted(self._states)}


def _digest_of(values: Mapping[str, Any], message: Message) -> str:
    """The digest of a seal, from its other values and from the head of its message."""
    texts = [values["previous"], values["session"], str(values["step"])]
    return _digest(_head(message), *(text.encode() for text in texts), *_texts(values["parts"]))


def _texts(parts: Mapping[str, str]) -> list[bytes]:
    return [text.encode() for part in parts.items() for text in part]


def _head(message: Message) -> bytes:
    return _HEAD.pack(message.sequence, message.log_time, message.publish_time)


def _digest(*parts: bytes) -> str:
    state = hashlib.blake2b(digest_size=_DIGEST_SIZE)
    _update(state, parts)
    return state.hexdigest()


def _update(state: Any, parts: tuple[bytes, ...]) -> None:
    for part in parts:
        state.update(_LENGTH.pack(len(part)))
        state.update(part)
