"""The messages of a damaged recording, with the gaps between them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode

from replay.mcap.file import LIMITS, StoredMessage, Topics, opened
from replay.mcap.record_bytes import MALFORMED, MESSAGE_HEAD, parsed, parts, reason_of
from replay.mcap.records import Damage, Record, Records
from replay.mcap.seal import MIXED, Chain


@dataclass(frozen=True)
class Gap:
    """So many messages are missing between the one before and the one that follows."""

    messages: int


class Salvage:
    """Reads all messages of one file that are in whole chunks, and that its seals tie together."""

    def __init__(self, path: Path, names: Mapping[str, str]) -> None:
        """names: the full name of the message on every topic that matters."""
        self.path = path
        self.attachments: dict[str, bytes] = {}  # by name, those met so far
        self.damages: list[Damage] = []  # those met so far
        self._topics = Topics(names)
        self._chain = Chain(forgiving=True)
        self._count = 0  # messages met or missed so far
        self._whole_until = 0  # the end of the last chunk with messages

    @property
    def rest(self) -> Damage | None:
        """The damage behind the last whole message, if there is any."""
        return next((d for d in self.damages if d.start >= self._whole_until), None)

    def messages(self) -> Iterator[StoredMessage | Gap]:
        """All whole messages in the order of writing, and where others are missing.

        Raises RecordingError if the file cannot be read.
        """
        with opened(self.path) as file:
            records = Records(file, LIMITS)
            for record in records.whole():
                if isinstance(record, Damage):
                    self._damaged(record.start, record.end, record.reason)
                elif record.opcode in (Opcode.ATTACHMENT, Opcode.CHUNK):
                    try:
                        if self._is_of_another(record):
                            reason = "another recording goes on here"
                            return self._damaged(record.start, records.size, reason)
                        found = self._take(record)
                    except MALFORMED as error:
                        self._damaged(record.start, record.end, reason_of(error))
                    else:
                        yield from found

    def _damaged(self, start: int, end: int, reason: str) -> None:
        if start < end:
            self.damages.append(Damage(start, end, reason))

    def _is_of_another(self, record: Record) -> bool:
        """Whether a record is one that a recording has once, at its beginning."""
        if record.opcode == Opcode.ATTACHMENT:
            name = parsed(record.opcode, record.content).name
            return self._count > 0 or name in self.attachments
        return self._count > 0 and _numbers(record.content)[:1] == [0]

    def _take(self, record: Record) -> list[StoredMessage | Gap]:
        """The messages of a chunk; an attachment has none. Any of MALFORMED if it is damaged."""
        if record.opcode == Opcode.ATTACHMENT:
            attachment = parsed(record.opcode, record.content)
            self.attachments[attachment.name] = attachment.data
            self._chain.attach(attachment)
            return []
        messages = self._messages(record.content)
        for name in self._chain.lost:
            self.attachments.pop(name, None)
        self._whole_until = record.end
        return messages

    def _messages(self, chunk: bytes) -> list[StoredMessage | Gap]:
        """The messages of a chunk; any of MALFORMED if they cannot be where they are.

        Every chunk ends with a seal, but in files of older formats, which have none.
        """
        numbers = _numbers(chunk)
        first = numbers[0] if numbers else self._count
        if numbers != list(range(first, first + len(numbers))):
            raise ValueError("the messages of a chunk are not in order")
        if first < self._count:
            raise ValueError("the messages of a chunk were there before")
        if first > self._count:
            self._chain.skip()
        stored = []
        for message, one in self._topics.messages(chunk, self._chain):
            self._chain.read(one.topic, message)
            stored.append(one)
        if self._chain.session and self._chain.is_open:
            raise ValueError(f"the chunk has no seal of this recording: {MIXED}")
        gap = [Gap(first - self._count)] if first > self._count else []
        self._count = first + len(numbers)
        return [*gap, *(one for one in stored if self._topics.matters(one))]


def _numbers(chunk: bytes) -> list[int]:
    """The numbers of the messages in a chunk."""
    starts = (start for opcode, start, _ in parts(chunk) if opcode == Opcode.MESSAGE)
    return [MESSAGE_HEAD.unpack_from(chunk, start)[1] for start in starts]
