"""One way through an MCAP file of any writer: its messages as they stand there."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from mcap.opcode import Opcode

from replay.mcap.record_bytes import HEAD, MALFORMED, MESSAGE_HEAD, parsed, parts, reason_of
from replay.mcap.records import Damage, Head, Limits, Records
from replay.raw.channels import Channel, Channels

Fault = Callable[[str], None]

_DESCRIPTIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
LIMITS = Limits(
    size=2**26,
    ratio=1000,
    largest=2**29,  # writers make chunks of some megabytes, or of one large message
    checked=False,  # writers in a hurry leave checksums out
    passed_by=frozenset(map(int, Opcode)) - {*_DESCRIPTIONS, Opcode.CHUNK, Opcode.MESSAGE},
)
_OVERLAP = "its chunks overlap so far in time that messages come in another order"
_END_OF_TIME = 2**63


@dataclass(frozen=True)
class RawMessage:
    """A message as it stands in the file; log_time in nanoseconds."""

    channel: Channel
    log_time: int
    data: bytes


@dataclass(frozen=True, order=True)
class ChunkPlace:
    """Where a chunk is, and the times and channels of its messages."""

    first: int  # log time, nanoseconds
    offset: int  # in the file, bytes
    last: int = field(compare=False)
    length: int = field(compare=False)
    channels: frozenset[int] = field(compare=False)  # by id; none if they are not known

    def head(self, records: Records) -> Head | None:
        """The chunk's head, if a chunk is there."""
        try:
            head = records.head(self.offset)
        except MALFORMED:
            return None
        is_chunk = head.opcode == Opcode.CHUNK and head.end == self.offset + self.length
        return head if is_chunk else None


@dataclass(frozen=True)
class Wanted:
    """Which messages of a file matter: those on topics, at begin <= log time < end."""

    topics: frozenset[str] | None = None  # None: all
    begin: int = 0
    end: int = _END_OF_TIME

    def has(self, topic: str) -> bool:
        """Whether a topic matters."""
        return self.topics is None or topic in self.topics


class RawReading:
    """One way through a file."""

    def __init__(
        self,
        records: Records,
        channels: Channels,
        wanted: Wanted,
        fault: Fault,
        remarks: list[str],
        progress: Callable[[int], None],
    ) -> None:
        """fault: called with each damage. remarks: are added to. progress: with bytes done."""
        self._records, self._name = records, records.name
        self._channels, self._wanted = channels, wanted
        self._fault, self._remarks, self._progress = fault, remarks, progress

    def ordered(self, chunks: list[ChunkPlace], most: int) -> Iterator[RawMessage]:
        """In order of log time: a chunk is read once no message before it can be missing.

        most: bytes of messages that wait for their turn.
        """
        waiting: list[tuple[int, int, int, RawMessage]] = []
        held = done = 0
        for chunk in sorted(chunks):
            if held > most and _OVERLAP not in self._remarks:
                self._remarks.append(_OVERLAP)
            while waiting and (waiting[0][0] < chunk.first or held > most):
                message = heapq.heappop(waiting)[3]
                held -= len(message.data)
                yield message
            if self._matters(chunk):
                for number, message in enumerate(self._chunk_at(chunk)):
                    heapq.heappush(waiting, (message.log_time, chunk.offset, number, message))
                    held += len(message.data)
            done += chunk.length
            self._progress(done)
        while waiting:
            yield heapq.heappop(waiting)[3]

    def as_written(self) -> Iterator[RawMessage]:
        """All whole messages, in the order of the file."""
        has_chunks = False
        for record in self._records.whole():
            self._progress(record.start)
            if isinstance(record, Damage):
                self._fault(f"{self._name}: {record.reason}")
            elif record.opcode == Opcode.DATA_END:
                return
            elif record.opcode == Opcode.CHUNK:
                has_chunks = True
                yield from self._messages(record.content)
            elif record.opcode == Opcode.MESSAGE and has_chunks:
                # No checksum vouches for it, and no writer does both.
                self._fault(f"{self._name}: a message outside of chunks, in a file that has them")
            elif record.opcode in (Opcode.MESSAGE, *_DESCRIPTIONS):
                head = HEAD.pack(record.opcode, len(record.content))
                yield from self._messages(head + record.content)

    def _matters(self, chunk: ChunkPlace) -> bool:
        """Whether a chunk can hold messages that matter; one without an index of them can."""
        if chunk.last < self._wanted.begin or chunk.first >= self._wanted.end:
            return False
        channels = self._channels.by_id
        return not chunk.channels or any(
            number not in channels or self._wanted.has(channels[number].topic)
            for number in chunk.channels
        )

    def _chunk_at(self, chunk: ChunkPlace) -> Iterator[RawMessage]:
        head = chunk.head(self._records)
        if head is None:
            self._fault(f"{self._name}: a chunk is not where the index says")
            return
        try:
            data = self._records.read(head).content
        except MALFORMED as error:
            self._fault(f"{self._name}: {reason_of(error)}")
        else:
            yield from self._messages(data)

    def _messages(self, chunk: bytes) -> Iterator[RawMessage]:
        """The messages in a chunk that matter, up to a record that does not fit into it."""
        try:
            for opcode, start, end in parts(chunk):
                if opcode in _DESCRIPTIONS:
                    self._describe(opcode, chunk[start:end])
                elif opcode == Opcode.MESSAGE and (message := self._message(chunk, start, end)):
                    yield message
        except MALFORMED as error:
            self._fault(f"{self._name}: {reason_of(error)}")

    def _describe(self, opcode: int, body: bytes) -> None:
        """Take note of a schema or channel."""
        try:
            self._channels.describe(parsed(opcode, body))
        except MALFORMED as error:
            self._fault(f"{self._name}: {reason_of(error)}")

    def _message(self, data: bytes, start: int, end: int) -> RawMessage | None:
        """The message in a record, if it matters."""
        if end - start < MESSAGE_HEAD.size:
            self._fault(f"{self._name}: a message of {end - start} bytes")
            return None
        number, _, log_time, _ = MESSAGE_HEAD.unpack_from(data, start)
        channel = self._channels.by_id.get(number)
        if channel is None:
            self._fault(f"{self._name}: a message of a channel that is not described")
        elif log_time >= _END_OF_TIME:
            self._fault(f"{channel.topic}: a message at a time beyond the end of time")
        elif self._wanted.begin <= log_time < self._wanted.end and self._wanted.has(channel.topic):
            return RawMessage(channel, log_time, data[start + MESSAGE_HEAD.size : end])
        return None
