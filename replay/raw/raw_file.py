"""One MCAP file of any writer: its index if it has one, and its messages as they stand there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

from mcap.records import AttachmentIndex, Channel, Schema, Statistics
from mcap.writer import MCAP0_MAGIC

from chsel.errors import SessionError
from replay.mcap.record_bytes import MALFORMED, ChunkIndex, reason_of
from replay.mcap.records import Limits, Records
from replay.mcap.summary import summary
from replay.raw.channels import Channels
from replay.raw.raw_reading import LIMITS, ChunkPlace, Fault, RawMessage, RawReading, Wanted

ACCEPTED = "accepted: an .mcap file, or a rosbag2 folder with MCAP storage"
ROS1_BAG = b"#ROSBAG "  # as long as MCAP0_MAGIC
_CONVERT = (
    "convert it with `pip install rosbags`, `rosbags-convert --src LOG.bag --dst LOG "
    "--dst-storage mcap`, and pass the folder LOG"
)
MOST_HELD = 2**28  # bytes of messages that wait for their turn
_COMPARED = 64  # chunks that are looked at before an index is believed


class RawFile:
    """Reads one file; no length in it is believed. Raises SessionError if it is not MCAP."""

    def __init__(self, path: Path, limits: Limits = LIMITS) -> None:
        self.path = path
        self._limits = limits
        self.channels = Channels()  # complete where there is an index
        self.counts: dict[int, int] | None = None  # of messages by channel, as the index says
        self.times: tuple[int, int] | None = None  # first and last log time, likewise
        self.attachments: dict[str, int] = {}  # bytes of each by name, likewise
        self.is_indexed = False  # if so, messages come in order of log time, else in the file's
        self.index_fault = ""  # what is wrong with the index; "" also where there is none
        self.remarks: list[str] = []
        self._chunks: list[ChunkPlace] = []
        try:
            with path.open("rb") as file:
                start = file.read(len(MCAP0_MAGIC))
                if start == ROS1_BAG or (path.suffix == ".bag" and start != MCAP0_MAGIC):
                    raise SessionError(f"log {path} is a ROS 1 bag; {ACCEPTED}: {_CONVERT}")
                if start != MCAP0_MAGIC:
                    raise SessionError(f"log {path} is no MCAP file; {ACCEPTED}")
                self.size = file.seek(0, 2)
                self._read_index(file)
        except OSError as error:
            raise SessionError(f"log {path} cannot be read: {error.strerror or error}") from None

    def messages(
        self, wanted: Wanted, fault: Fault, progress: Callable[[int], None], *, at_once: int = 1
    ) -> Iterator[RawMessage]:
        """The messages that matter. fault: called with each damage. progress: with bytes done.

        at_once: how many files share the memory for messages that wait for their turn.
        """
        try:
            with self.path.open("rb") as file:
                records = Records(file, self._limits)
                reading = RawReading(records, self.channels, wanted, fault, self.remarks, progress)
                if self.is_indexed:
                    yield from reading.ordered(self._chunks, MOST_HELD // at_once)
                else:
                    yield from reading.as_written()
        except OSError as error:
            fault(f"{self.path.name}: it cannot be read on: {error.strerror or error}")

    def written(self, fault: Fault) -> Iterator[RawMessage]:
        """All messages in the order of the file, whether or not an index says where they are."""
        channels = Channels()
        with self.path.open("rb") as file:
            records = Records(file, self._limits)
            reading = RawReading(records, channels, Wanted(), fault, self.remarks, unwatched)
            yield from reading.as_written()
        for number, channel in channels.by_id.items():
            self.channels.by_id.setdefault(number, channel)

    def samples(self, fault: Fault, most: int) -> Iterator[RawMessage]:
        """The messages of at most so many chunks, in which as many topics as possible are."""
        chosen: list[ChunkPlace] = []
        seen: set[int] = set()
        for chunk in sorted(self._chunks):
            if len(chosen) < most and (not chunk.channels or chunk.channels - seen):
                chosen.append(chunk)
                seen |= chunk.channels
        with self.path.open("rb") as file:
            records = Records(file, self._limits)
            reading = RawReading(records, self.channels, Wanted(), fault, self.remarks, unwatched)
            yield from reading.ordered(chosen, MOST_HELD)

    def spans(self) -> dict[int, tuple[int, int]]:
        """By channel, first and last log time of the chunks that have its messages, nanoseconds."""
        found: dict[int, tuple[int, int]] = {}
        for chunk in self._chunks:
            for number in chunk.channels:
                first, last = found.get(number, (chunk.first, chunk.last))
                found[number] = min(first, chunk.first), max(last, chunk.last)
        return found

    def _read_index(self, file: IO[bytes]) -> None:
        """Look at the end of the file; without a whole index there, it is as if there was none."""
        channels, chunks = Channels(), list[ChunkPlace]()
        try:
            statistics = self._summarized(file, channels, chunks)
        except MALFORMED as error:
            self.index_fault = reason_of(error)
            self.remarks.append(f"it is read without its index: {self.index_fault}")
            return
        if statistics is None:
            self.remarks.append("it is read without its index: it has none")
            return
        self.is_indexed, self.channels, self._chunks = True, channels, chunks
        self.counts = statistics.channel_message_counts
        if statistics.message_count:
            self.times = statistics.message_start_time, statistics.message_end_time

    def _summarized(
        self, file: IO[bytes], channels: Channels, chunks: list[ChunkPlace]
    ) -> Statistics | None:
        """What the summary says, None if there is none; any of MALFORMED if it contradicts."""
        statistics, is_empty = None, True
        alike: dict[frozenset[int], frozenset[int]] = {}
        for part in summary(file, checked=self._limits.checked):
            is_empty = False
            if isinstance(part, Schema | Channel):
                channels.describe(part)
            elif isinstance(part, Statistics):
                statistics = part
            elif isinstance(part, AttachmentIndex):
                self.attachments[part.name] = part.data_size
            elif isinstance(part, ChunkIndex):
                chunks.append(self._chunk_place(part, alike))
        if is_empty:
            return None
        if statistics is None:
            raise ValueError("its statistics are missing")
        counts = statistics.channel_message_counts
        if statistics.chunk_count != len(chunks) or (statistics.message_count and not chunks):
            raise ValueError("its chunks are not all in the index")
        if len({chunk.offset for chunk in chunks}) < len(chunks) or (
            statistics.message_count != sum(counts.values())
        ):
            raise ValueError("its index contradicts itself")
        if any(number not in channels.by_id for number, count in counts.items() if count):
            raise ValueError("its index lacks channels")
        some, records = chunks[:: max(len(chunks) // _COMPARED, 1)], Records(file, self._limits)
        missing = sum(chunk.head(records) is None for chunk in some)
        if 2 * missing > len(some):  # an index of old
            raise ValueError("its index is another file's")
        return statistics

    def _chunk_place(
        self, index: ChunkIndex, alike: dict[frozenset[int], frozenset[int]]
    ) -> ChunkPlace:
        """alike: sets of channels that were met, so that many equal ones take little memory."""
        if index.start + index.length > self.size:
            raise ValueError("a chunk in the index lies outside of the file")
        channels = alike.setdefault(index.channels, index.channels)
        return ChunkPlace(index.first, index.start, index.last, index.length, channels)


def unwatched(done: int) -> None:
    """Nobody is shown how far reading is."""
