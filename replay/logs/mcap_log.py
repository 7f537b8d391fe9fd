"""MCAP files of other programs, such as robots' logs: their messages, in order of time."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from mcap import records
from mcap.records import Chunk, ChunkIndex, DataEnd, McapRecord, Message
from mcap.writer import MCAP0_MAGIC

from chsel.errors import SessionError
from chsel.numerics.arrays import refuse_special_file
from replay.mcap.file import (
    COMPRESSIONS,
    MALFORMED,
    chunk_at,
    file_records,
    file_summary,
    reason_of,
    unknown_compression,
    unpacked,
)
from replay.mcap.texts import one_line

ACCEPTED = (
    "accepted: an .mcap, .db3 or .bag file of MCAP, rosbag2 or ROS 1, or a folder of one kind"
)
ZSTD = b"\x28\xb5\x2f\xfd"  # what a compressed file begins with
_END_OF_TIME = 2**63
_ROS_TEXTS = ("ros2msg", "ros1msg")

Fault = Callable[[str], None]


@dataclass(frozen=True)
class Channel:
    """Messages of one topic and schema."""

    topic: str
    encoding: str
    schema: str  # its name
    definition: str | None = None  # the schema's text, if it is one of ROS


@dataclass(frozen=True)
class RawMessage:
    """A message as it stands in the file; log_time in nanoseconds."""

    channel: Channel
    log_time: int
    data: bytes


class RawFile:
    """One file, which can be read several times. Raises SessionError if it is not MCAP."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.remarks: list[str] = []  # how it is read
        self.channels: dict[int, Channel] = {}  # by id, empty without an index
        self.counts: dict[int, int] = {}  # messages by channel, empty without an index
        self.times: tuple[int, int] | None = None  # first and last log time, nanoseconds
        self._schemas: dict[int, records.Schema] = {}
        self._chunks: list[ChunkIndex] = []
        refuse_special_file(f"log {path}", path, error=SessionError)
        try:
            with path.open("rb") as file:
                start = file.read(len(MCAP0_MAGIC))
                if start.startswith(ZSTD):
                    raise SessionError(
                        f"log {path} is compressed by zstd; {ACCEPTED}: unpack it with "
                        "`zstd -d FILE`"
                    )
                if start != MCAP0_MAGIC:
                    raise SessionError(f"log {path} is of no kind that is read; {ACCEPTED}")
                self.size = file.seek(0, 2)
                # Whether messages come in order of log time, else in that of the file.
                self.is_indexed = self._read_index(file)
        except OSError as error:
            raise SessionError(f"log {path} cannot be read: {error.strerror or error}") from None
        if not self.is_indexed:
            self.remarks.append("it is read without its index: it has none that can be used")

    def messages(
        self,
        topics: frozenset[str] | None,
        fault: Fault,
        *,
        progress: Callable[[int], None] = lambda done: None,
    ) -> Iterator[RawMessage]:
        """Yield the messages on topics (None: all). fault and progress: called with damage, bytes.

        Without an index, nothing is read behind the first damage.
        """
        try:
            with self.path.open("rb") as file:
                if self.is_indexed:
                    yield from self._by_time(file, topics, fault=fault, progress=progress)
                    return
                try:
                    for record in file_records(file, self.size):
                        if isinstance(record, DataEnd):
                            return
                        progress(file.tell())
                        inside = unpacked(record) if isinstance(record, Chunk) else [record]
                        yield from self._messages(inside, topics, fault=fault)
                except MALFORMED as error:
                    fault(f"{self.path.name}: {reason_of(error)}")
        except OSError as error:
            fault(f"{self.path.name}: it cannot be read on: {error.strerror or error}")

    def _by_time(
        self,
        file: IO[bytes],
        topics: frozenset[str] | None,
        *,
        fault: Fault,
        progress: Callable[[int], None],
    ) -> Iterator[RawMessage]:
        """Yield messages by time: a chunk is read once no message before it can be missing."""
        waiting: list[tuple[int, int, int, RawMessage]] = []
        done = 0
        for chunk in self._chunks:
            while waiting and waiting[0][0] < chunk.message_start_time:
                yield heapq.heappop(waiting)[3]
            channels = [self.channels.get(number) for number in chunk.message_index_offsets]
            if not channels or any(_is_wanted(channel, topics) for channel in channels):
                try:
                    inside = unpacked(chunk_at(file, self.size, place=chunk.chunk_start_offset))
                except MALFORMED as error:
                    fault(f"{self.path.name}: {reason_of(error)}")
                    inside = []
                for number, message in enumerate(self._messages(inside, topics, fault=fault)):
                    place = (message.log_time, chunk.chunk_start_offset, number)
                    heapq.heappush(waiting, (*place, message))
            done += chunk.chunk_length
            progress(done)
        while waiting:
            yield heapq.heappop(waiting)[3]

    def _messages(
        self, inside: list[McapRecord], topics: frozenset[str] | None, *, fault: Fault
    ) -> Iterator[RawMessage]:
        for record in inside:
            self._describe(record)
            if not isinstance(record, Message):
                continue
            channel = self.channels.get(record.channel_id)
            if channel is None:
                fault(f"{self.path.name}: a message of a channel that is not described")
            elif record.log_time >= _END_OF_TIME:
                fault(f"{channel.topic}: a message at a time beyond the end of time")
            elif _is_wanted(channel, topics):
                yield RawMessage(channel, record.log_time, data=record.data)

    def _read_index(self, file: IO[bytes]) -> bool:
        """Look at the end of the file; whether there is an index of all chunks."""
        summary = file_summary(file, self.size)
        if summary is None or summary.statistics is None:
            return False
        statistics = summary.statistics
        if statistics.chunk_count != len(summary.chunk_indexes) or (
            statistics.message_count and not summary.chunk_indexes
        ):
            return False
        for chunk in summary.chunk_indexes:
            if chunk.compression not in COMPRESSIONS:
                raise SessionError(f"log {self.path}: {unknown_compression(chunk.compression)}")
        for described in (*summary.schemas.values(), *summary.channels.values()):
            self._describe(described)
        self.counts = statistics.channel_message_counts
        if statistics.message_count:
            self.times = statistics.message_start_time, statistics.message_end_time
        self._chunks = sorted(
            summary.chunk_indexes,
            key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset),
        )
        return True

    def _describe(self, record: McapRecord) -> None:
        """Take note of a schema or channel; of two with one number the first stays."""
        if isinstance(record, records.Schema):
            self._schemas.setdefault(record.id, record)
        elif isinstance(record, records.Channel) and record.id not in self.channels:
            schema = self._schemas.get(record.schema_id)
            text = None
            if schema is not None and schema.encoding in _ROS_TEXTS:
                text = schema.data.decode("utf-8", "replace")
            name = "" if schema is None else one_line(schema.name)
            topic, encoding = one_line(record.topic), one_line(record.message_encoding)
            self.channels[record.id] = Channel(topic, encoding, schema=name, definition=text)


def _is_wanted(channel: Channel | None, topics: frozenset[str] | None) -> bool:
    """Return whether a channel is on one of the topics, or may be; None: every topic is wanted."""
    return topics is None or channel is None or channel.topic in topics
