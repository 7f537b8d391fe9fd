"""One way through an MCAP file of any writer: its messages as they stand there."""

from __future__ import annotations

import heapq
import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from os import SEEK_END
from pathlib import Path
from typing import IO

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from replay.mcap.texts import one_line
from replay.raw.catalogue import Catalogue, Channel
from replay.raw.chunks import LARGEST_CHUNK, UNPACKING_ERRORS, records, unpacked

Fault = Callable[[str], None]

RECORD_HEAD = struct.Struct("<BQ")  # of every record: opcode, length
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_SIZE = struct.Struct("<Q")
_LAST_RECORDS = {int(Opcode.DATA_END): 4, int(Opcode.FOOTER): 20}  # with their lengths
# How chunks are found: by the name of their compression, which stands in each at a fixed place.
_CHUNK_MARK = re.compile(rb"\x04\0\0\0zstd|\x03\0\0\0lz4")
_MARK_AT, _LONGEST_MARK = RECORD_HEAD.size + 28, 8
_WINDOW = 2**20
MOST_HELD = 2**28  # bytes of messages that wait for their turn
_OVERLAP = "its chunks overlap so far in time that messages come in another order"
_END_OF_TIME = 2**63
_READ_RATIO = 8  # how often a file is read at most, in search of what is whole
_PLAUSIBLE_SIZE, _PLAUSIBLE_RATIO = 2**26, 1000  # of what all chunks hold, to the file's size


@dataclass(frozen=True)
class RawMessage:
    """A message as it stands in the file; log_time in nanoseconds."""

    channel: Channel
    log_time: int
    data: bytes


@dataclass(frozen=True, order=True)
class ChunkPlace:
    """Where a chunk is, and the times and channels of its messages."""

    first: int
    offset: int
    last: int = field(compare=False)
    length: int = field(compare=False)
    channels: frozenset[int] = field(compare=False)


@dataclass(frozen=True)
class Wanted:
    """Which messages of a file matter: those on topics, at begin <= log time < end."""

    topics: frozenset[str] | None = None
    begin: int = 0
    end: int = _END_OF_TIME

    def has(self, topic: str) -> bool:
        """Whether a topic matters; all do where none is named."""
        return self.topics is None or topic in self.topics


class RawReading:
    """One way through a file."""

    def __init__(
        self,
        file: IO[bytes],
        catalogue: Catalogue,
        wanted: Wanted,
        fault: Fault,
        remarks: list[str],
        progress: Callable[[int], None],
    ) -> None:
        """fault: called with each damage. remarks: are added to. progress: with bytes done."""
        self._file, self._catalogue, self._wanted = file, catalogue, wanted
        self._fault, self._remarks, self._progress = fault, remarks, progress
        self._name = Path(file.name).name
        self._size = file.seek(0, SEEK_END)
        self._allowance = _PLAUSIBLE_SIZE + _PLAUSIBLE_RATIO * self._size
        self._readable = _PLAUSIBLE_SIZE + _READ_RATIO * self._size  # bytes
        self._tried = 0  # where the last chunk was, or seemed to be

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
        """In the order of the file. Where it cannot be followed, the next chunk is searched for."""
        place: int | None = len(MCAP0_MAGIC)
        while place is not None:
            self._progress(place)
            self._file.seek(place)
            head = self._file.read(RECORD_HEAD.size)
            opcode, length = RECORD_HEAD.unpack(head) if len(head) == RECORD_HEAD.size else (0, 0)
            if length == _LAST_RECORDS.get(opcode, -1):
                return
            end = place + RECORD_HEAD.size + length
            if opcode == 0 or opcode in _LAST_RECORDS or end > self._size:
                reason = "is cut or damaged" if head else "ends early, as if never finished"
                self._fault(f"{self._name} {reason}")
                place = self._next_chunk()
                continue
            if opcode == Opcode.CHUNK:
                self._tried = place
            yield from self._taken(opcode, length)
            place = end

    def _taken(self, opcode: int, length: int) -> Iterator[RawMessage]:
        """The messages in a record whose head has just been read."""
        try:
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._catalogue.describe(opcode, self._body(length))
            elif opcode == Opcode.CHUNK:
                yield from self._chunk(self._body(length))
            elif opcode == Opcode.MESSAGE and self._tried:
                # No checksum tells of it, and no writer does both.
                self._fault(f"{self._name}: a message outside of chunks, in a file that has them")
            elif opcode == Opcode.MESSAGE:
                head = self._file.read(min(length, _MESSAGE.size))
                channel = self._channel(head)
                if channel is not None:
                    data = self._body(length - _MESSAGE.size)
                    yield RawMessage(channel, _MESSAGE.unpack_from(head)[2], data)
        except UNPACKING_ERRORS as error:
            self._fault(f"{self._name}: {reason(error)}")

    def _next_chunk(self) -> int | None:
        """Where the next compressed chunk seems to begin, behind all that were tried."""
        place = self._tried + 1
        while place < self._size and self._readable > 0:
            self._file.seek(place)
            window = self._file.read(_WINDOW)
            self._readable -= len(window)
            for mark in _CHUNK_MARK.finditer(window):
                start = place + mark.start() - _MARK_AT
                if start > self._tried and self._may_be_chunk(start, len(mark[0])):
                    return start
            if len(window) < _WINDOW:
                break
            place += _WINDOW - _LONGEST_MARK
        return None

    def _may_be_chunk(self, start: int, mark: int) -> bool:
        """Whether the lengths of a chunk agree with one another and with the file's."""
        self._file.seek(start)
        head = self._file.read(_MARK_AT + mark + _SIZE.size)
        if len(head) < _MARK_AT + mark + _SIZE.size or head[0] != Opcode.CHUNK:
            return False
        _, length = RECORD_HEAD.unpack_from(head)
        (packed,) = _SIZE.unpack_from(head, _MARK_AT + mark)
        fits = length == len(head) - RECORD_HEAD.size + packed
        return fits and start + RECORD_HEAD.size + length <= self._size

    def _body(self, length: int) -> bytes:
        if length > LARGEST_CHUNK:
            raise ValueError(f"a record has {length} bytes; accepted: up to {LARGEST_CHUNK}")
        if length > self._readable:
            raise ValueError("there is more damage than can be searched")
        self._readable -= length
        return self._file.read(length)

    def _matters(self, chunk: ChunkPlace) -> bool:
        """Whether a chunk can hold messages that matter; one without an index of them can."""
        if chunk.last < self._wanted.begin or chunk.first >= self._wanted.end:
            return False
        channels = self._catalogue.channels
        return not chunk.channels or any(
            number not in channels or self._wanted.has(channels[number].topic)
            for number in chunk.channels
        )

    def _chunk_at(self, chunk: ChunkPlace) -> Iterator[RawMessage]:
        length = chunk_length(self._file, chunk)
        if length is None:
            self._fault(f"{self._name}: a chunk is not where the index says")
            return
        yield from self._taken(Opcode.CHUNK, length)

    def _chunk(self, body: bytes) -> Iterator[RawMessage]:
        data = unpacked(body, self._allowance)
        self._allowance -= len(data)
        for opcode, start, end in records(data):
            if opcode == Opcode.MESSAGE:
                head = data[start : min(end, start + _MESSAGE.size)]
                channel = self._channel(head)
                if channel is not None:
                    content = data[start + _MESSAGE.size : end]
                    yield RawMessage(channel, _MESSAGE.unpack_from(head)[2], content)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._catalogue.describe(opcode, data[start:end])

    def _channel(self, head: bytes) -> Channel | None:
        """The channel of a message, if the message matters."""
        number, _, log_time, _ = _MESSAGE.unpack_from(head)
        channel = self._catalogue.channels.get(number)
        if channel is None:
            self._fault(f"{self._name}: a message of a channel that is not described")
        elif log_time >= _END_OF_TIME:
            self._fault(f"{channel.topic}: a message at a time beyond the end of time")
        elif self._wanted.begin <= log_time < self._wanted.end and self._wanted.has(channel.topic):
            return channel
        return None


def chunk_length(file: IO[bytes], chunk: ChunkPlace) -> int | None:
    """The length of the body of a chunk, at which the file stands then; None if none is there."""
    file.seek(chunk.offset)
    head = file.read(RECORD_HEAD.size)
    opcode, length = RECORD_HEAD.unpack(head) if len(head) == RECORD_HEAD.size else (0, 0)
    return length if opcode == Opcode.CHUNK and length + RECORD_HEAD.size == chunk.length else None


def reason(error: BaseException) -> str:
    """What an error says of a file; struct's speaks of our program instead."""
    if isinstance(error, struct.error):
        return "a record is cut short"
    return one_line(str(error)) or f"a record is broken ({type(error).__name__})"
