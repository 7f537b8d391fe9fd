"""One MCAP file of any writer: its index if it has one, and its messages as they stand there."""

from __future__ import annotations

import heapq
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from chsel.errors import SessionError
from replay.mcap.texts import one_line
from runners.sensors.chunks import LARGEST_CHUNK, UNPACKING_ERRORS, records, unpacked
from runners.sensors.log_files import ACCEPTED

Fault = Callable[[str], None]

_HEAD = struct.Struct("<BQ")  # of every record: opcode, length
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_SCHEMA, _CHANNEL, _LENGTH = struct.Struct("<H"), struct.Struct("<HH"), struct.Struct("<I")
_FOOTER = struct.Struct("<BQQQI")  # opcode, length, summary start, offsets' start, checksum
_STATISTICS = struct.Struct("<QHIIIIQQI")
_COUNT, _PLACE = struct.Struct("<HQ"), struct.Struct("<HQ")
_CHUNK_INDEX = struct.Struct("<QQQQI")  # first and last time, start, length, size of the offsets
_SIZE = struct.Struct("<Q")
_CRC_SIZE = 4
_LAST_RECORDS = {int(Opcode.DATA_END): 4, int(Opcode.FOOTER): 20}  # with their lengths
# How chunks are found: by the name of their compression, which stands in each at a fixed place.
_CHUNK_MARK = re.compile(rb"\x04\0\0\0zstd|\x03\0\0\0lz4")
_MARK_AT, _LONGEST_MARK = _HEAD.size + 28, 8
_WINDOW = 2**20
_LARGEST_SUMMARY = 2**28
_COMPARED = 64  # chunks that are looked at before an index is believed
_MOST_HELD = 2**28  # bytes of messages that wait for their turn
_OVERLAP = "its chunks overlap so far in time that messages come in another order"
_END_OF_TIME = 2**63
_READ_RATIO = 8  # how often a file is read at most, in search of what is whole
_PLAUSIBLE_SIZE, _PLAUSIBLE_RATIO = 2**26, 1000  # of what all chunks hold, to the file's size


@dataclass(frozen=True)
class Channel:
    """Messages of one topic and schema. definition: the schema's text, where it has one."""

    topic: str
    encoding: str
    schema: str
    definition: str | None = None


@dataclass(frozen=True)
class RawMessage:
    """A message as it stands in the file; log_time in nanoseconds."""

    channel: Channel
    log_time: int
    data: bytes


@dataclass(frozen=True, order=True)
class _ChunkPlace:
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


class RawFile:
    """Reads one file; no length in it is believed.

    channels: by id, complete where there is an index. counts: of messages by id, where the index
    tells. times: first and last log time, likewise. is_indexed: whether messages come in order of
    their log time; otherwise they come in the file's. Raises SessionError for what is no MCAP.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.counts: dict[int, int] | None = None
        self.times: tuple[int, int] | None = None
        self.is_indexed = False
        self.remarks: list[str] = []
        self._schemas: dict[int, tuple[str, str | None]] = {0: ("", None)}
        self._chunks: list[_ChunkPlace] = []
        try:
            with path.open("rb") as file:
                self.size = file.seek(0, 2)
                file.seek(0)
                if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                    raise SessionError(f"log {path} is no MCAP file; {ACCEPTED}")
                self._read_index(file)
        except OSError as error:
            raise SessionError(f"log {path} cannot be read: {error.strerror or error}") from None

    def messages(
        self, wanted: Wanted, fault: Fault, progress: Callable[[int], None]
    ) -> Iterator[RawMessage]:
        """The messages that matter. fault: called with each damage. progress: with bytes done."""
        try:
            with self.path.open("rb") as file:
                reading = _Reading(self, file, wanted, fault, progress)
                if self.is_indexed:
                    yield from reading.ordered(self._chunks)
                else:
                    yield from reading.as_written()
        except OSError as error:
            fault(f"{self.path.name}: it cannot be read on: {error.strerror or error}")

    def describe(self, opcode: int, body: bytes) -> None:
        """Take note of a schema or channel; ValueError or struct.error if it is malformed."""
        if opcode == Opcode.SCHEMA:
            (number,) = _SCHEMA.unpack_from(body)
            name, place = _text(body, _SCHEMA.size)
            encoding, place = _text(body, place)
            definition = _text(body, place)[0] if encoding == "ros2msg" else None
            self._schemas.setdefault(number, (name, definition))
            return
        number, schema = _CHANNEL.unpack_from(body)
        topic, place = _text(body, _CHANNEL.size)
        encoding, _ = _text(body, place)
        name, definition = self._schemas.get(schema, ("", None))
        channel = Channel(one_line(topic), one_line(encoding), one_line(name), definition)
        self.channels.setdefault(number, channel)

    def _read_index(self, file: IO[bytes]) -> None:
        """Look at the end of the file; without a whole index there, it is as if there was none."""
        try:
            summary = _summary(file, self.size)
            self._take_summary(summary)
            self._compare_with_chunks(file)
        except UNPACKING_ERRORS as error:
            self.remarks.append(f"it is read without its index: {_reason(error)}")
            self.channels, self.counts, self.times = {}, None, None
            self._schemas, self._chunks = {0: ("", None)}, []
        else:
            self.is_indexed = True

    def _take_summary(self, summary: bytes) -> None:
        statistics = b""
        alike: dict[frozenset[int], frozenset[int]] = {}
        for opcode, start, end in records(summary):
            body = summary[start:end]
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.describe(opcode, body)
            elif opcode == Opcode.STATISTICS:
                statistics = body
            elif opcode == Opcode.CHUNK_INDEX:
                self._chunks.append(self._chunk_place(body, alike))
        count, _, _, _, _, chunks, first, last, size = _STATISTICS.unpack_from(statistics)
        counts = statistics[_STATISTICS.size : _STATISTICS.size + size]
        self.counts = dict(_COUNT.iter_unpack(counts))
        if chunks != len(self._chunks) or (count and not chunks):
            raise ValueError("its chunks are not all in the index")
        if len({chunk.offset for chunk in self._chunks}) < chunks or count != sum(
            self.counts.values()
        ):
            raise ValueError("its index contradicts itself")
        if any(number not in self.channels for number, count in self.counts.items() if count):
            raise ValueError("its index lacks channels")
        self.times = (first, last) if count else None

    def _compare_with_chunks(self, file: IO[bytes]) -> None:
        """ValueError if most of some chunks are not where they should be: an index of old."""
        every = max(len(self._chunks) // _COMPARED, 1)
        some = self._chunks[::every]
        missing = sum(_chunk_length(file, chunk) is None for chunk in some)
        if 2 * missing > len(some):
            raise ValueError("its index is another file's")

    def _chunk_place(self, body: bytes, alike: dict[frozenset[int], frozenset[int]]) -> _ChunkPlace:
        first, last, offset, length, size = _CHUNK_INDEX.unpack_from(body)
        if size > len(body) - _CHUNK_INDEX.size or offset + length > self.size:
            raise ValueError("a chunk in the index lies outside of the file")
        places = body[_CHUNK_INDEX.size : _CHUNK_INDEX.size + size]
        channels = frozenset(number for number, _ in _PLACE.iter_unpack(places))
        return _ChunkPlace(first, offset, last, length, alike.setdefault(channels, channels))


class _Reading:
    """One way through a file."""

    def __init__(
        self,
        raw: RawFile,
        file: IO[bytes],
        wanted: Wanted,
        fault: Fault,
        progress: Callable[[int], None],
    ) -> None:
        self._raw, self._file, self._wanted = raw, file, wanted
        self._fault, self._progress = fault, progress
        self._allowance = _PLAUSIBLE_SIZE + _PLAUSIBLE_RATIO * raw.size
        self._readable = _PLAUSIBLE_SIZE + _READ_RATIO * raw.size  # bytes
        self._tried = 0  # where the last chunk was, or seemed to be

    def ordered(self, chunks: list[_ChunkPlace]) -> Iterator[RawMessage]:
        """In order of log time: a chunk is read once no message before it can be missing."""
        waiting: list[tuple[int, int, int, RawMessage]] = []
        held = done = 0
        for chunk in sorted(chunks):
            if held > _MOST_HELD and _OVERLAP not in self._raw.remarks:
                self._raw.remarks.append(_OVERLAP)
            while waiting and (waiting[0][0] < chunk.first or held > _MOST_HELD):
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
            head = self._file.read(_HEAD.size)
            opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
            if length == _LAST_RECORDS.get(opcode, -1):
                return
            end = place + _HEAD.size + length
            if opcode == 0 or opcode in _LAST_RECORDS or end > self._raw.size:
                reason = "is cut or damaged" if head else "ends early, as if never finished"
                self._fault(f"{self._name} {reason}")
                place = self._next_chunk()
                continue
            if opcode == Opcode.CHUNK:
                self._tried = place
            yield from self._taken(opcode, length)
            place = end

    @property
    def _name(self) -> str:
        return self._raw.path.name

    def _taken(self, opcode: int, length: int) -> Iterator[RawMessage]:
        """The messages in a record whose head has just been read."""
        try:
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._raw.describe(opcode, self._body(length))
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
            self._fault(f"{self._name}: {_reason(error)}")

    def _next_chunk(self) -> int | None:
        """Where the next compressed chunk seems to begin, behind all that were tried."""
        place = self._tried + 1
        while place < self._raw.size and self._readable > 0:
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
        _, length = _HEAD.unpack_from(head)
        (packed,) = _SIZE.unpack_from(head, _MARK_AT + mark)
        fits = length == len(head) - _HEAD.size + packed
        return fits and start + _HEAD.size + length <= self._raw.size

    def _body(self, length: int) -> bytes:
        if length > LARGEST_CHUNK:
            raise ValueError(f"a record has {length} bytes; accepted: up to {LARGEST_CHUNK}")
        if length > self._readable:
            raise ValueError("there is more damage than can be searched")
        self._readable -= length
        return self._file.read(length)

    def _matters(self, chunk: _ChunkPlace) -> bool:
        """Whether a chunk can hold messages that matter; one without an index of them can."""
        if chunk.last < self._wanted.begin or chunk.first >= self._wanted.end:
            return False
        channels = self._raw.channels
        return not chunk.channels or any(
            number not in channels or self._wanted.has(channels[number].topic)
            for number in chunk.channels
        )

    def _chunk_at(self, chunk: _ChunkPlace) -> Iterator[RawMessage]:
        length = _chunk_length(self._file, chunk)
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
                self._raw.describe(opcode, data[start:end])

    def _channel(self, head: bytes) -> Channel | None:
        """The channel of a message, if the message matters."""
        number, _, log_time, _ = _MESSAGE.unpack_from(head)
        channel = self._raw.channels.get(number)
        if channel is None:
            self._fault(f"{self._name}: a message of a channel that is not described")
        elif log_time >= _END_OF_TIME:
            self._fault(f"{channel.topic}: a message at a time beyond the end of time")
        elif self._wanted.begin <= log_time < self._wanted.end and self._wanted.has(channel.topic):
            return channel
        return None


def _chunk_length(file: IO[bytes], chunk: _ChunkPlace) -> int | None:
    """The length of the body of a chunk, at which the file stands then; None if none is there."""
    file.seek(chunk.offset)
    head = file.read(_HEAD.size)
    opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
    return length if opcode == Opcode.CHUNK and length + _HEAD.size == chunk.length else None


def _summary(file: IO[bytes], size: int) -> bytes:
    """The summary's bytes, its checksum compared; ValueError if there is none."""
    end = _FOOTER.size + len(MCAP0_MAGIC)
    file.seek(max(0, size - end))
    footer = file.read(end)
    if len(footer) != end or footer[_FOOTER.size :] != MCAP0_MAGIC:
        raise ValueError("it was never finished, or it is cut")
    opcode, length, start, _, checksum = _FOOTER.unpack_from(footer)
    if opcode != Opcode.FOOTER or length != _FOOTER.size - _HEAD.size:
        raise ValueError("its end is damaged")
    if start == 0:
        raise ValueError("it has none")
    if not 0 < size - end - start <= _LARGEST_SUMMARY:
        raise ValueError("its end is damaged")
    file.seek(start)
    summary = file.read(size - end - start)
    whole = zlib.crc32(footer[: _FOOTER.size - _CRC_SIZE], zlib.crc32(summary))
    if checksum and whole != checksum:
        raise ValueError("its checksum is wrong")
    return summary


def _reason(error: BaseException) -> str:
    """What an error says of a file; struct's speaks of our program instead."""
    if isinstance(error, struct.error):
        return "a record is cut short"
    return one_line(str(error)) or f"a record is broken ({type(error).__name__})"


def _text(body: bytes, place: int) -> tuple[str, int]:
    """A text with its length ahead, and the place after it."""
    (length,) = _LENGTH.unpack_from(body, place)
    start = place + _LENGTH.size
    if start + length > len(body):
        raise ValueError("a text does not fit into its record")
    return body[start : start + length].decode("utf-8", "replace"), start + length
