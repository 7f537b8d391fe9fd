"""One MCAP file of any writer: its index if it has one, and its messages as they stand there."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from chsel.errors import SessionError
from replay.raw.catalogue import Catalogue
from replay.raw.chunks import UNPACKING_ERRORS, records
from replay.raw.raw_reading import (
    MOST_HELD,
    RECORD_HEAD,
    ChunkPlace,
    Fault,
    RawMessage,
    RawReading,
    Wanted,
    chunk_length,
    reason,
)

ACCEPTED = "accepted: an .mcap file, or a rosbag2 folder with MCAP storage"
_FOOTER = struct.Struct("<BQQQI")  # opcode, length, summary start, offsets' start, checksum
_STATISTICS = struct.Struct("<QHIIIIQQI")
_COUNT, _PLACE = struct.Struct("<HQ"), struct.Struct("<HQ")
_CHUNK_INDEX = struct.Struct("<QQQQI")  # first and last time, start, length, size of the offsets
_CRC_SIZE = 4
_LARGEST_SUMMARY = 2**28
_COMPARED = 64  # chunks that are looked at before an index is believed


class RawFile:
    """Reads one file; no length in it is believed.

    catalogue: of its channels, complete where there is an index. counts: of messages by id, where
    the index tells. times: first and last log time, likewise. is_indexed: whether messages come in
    order of their log time; otherwise they come in the file's. index_fault: what is wrong with its
    index; "" also where it never had one. Raises SessionError if it is not MCAP.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.catalogue = Catalogue()
        self.counts: dict[int, int] | None = None
        self.times: tuple[int, int] | None = None
        self.is_indexed = False
        self.index_fault = ""
        self.remarks: list[str] = []
        self._chunks: list[ChunkPlace] = []
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
        self, wanted: Wanted, fault: Fault, progress: Callable[[int], None], *, at_once: int = 1
    ) -> Iterator[RawMessage]:
        """The messages that matter. fault: called with each damage. progress: with bytes done.

        at_once: how many files share the memory for messages that wait for their turn.
        """
        try:
            with self.path.open("rb") as file:
                reading = RawReading(file, self.catalogue, wanted, fault, self.remarks, progress)
                if self.is_indexed:
                    yield from reading.ordered(self._chunks, MOST_HELD // at_once)
                else:
                    yield from reading.as_written()
        except OSError as error:
            fault(f"{self.path.name}: it cannot be read on: {error.strerror or error}")

    def written(self, fault: Fault) -> Iterator[RawMessage]:
        """All messages in the order of the file, whether or not an index tells where they are."""
        with self.path.open("rb") as file:
            catalogue = Catalogue()
            yield from RawReading(
                file, catalogue, Wanted(), fault, self.remarks, _unwatched
            ).as_written()
            for number, channel in catalogue.channels.items():
                self.catalogue.channels.setdefault(number, channel)

    def samples(self, fault: Fault, most: int) -> Iterator[RawMessage]:
        """The messages of at most so many chunks, in which as many topics as possible are."""
        chosen: list[ChunkPlace] = []
        seen: set[int] = set()
        for chunk in sorted(self._chunks):
            if len(chosen) < most and (not chunk.channels or chunk.channels - seen):
                chosen.append(chunk)
                seen |= chunk.channels
        with self.path.open("rb") as file:
            reading = RawReading(file, self.catalogue, Wanted(), fault, self.remarks, _unwatched)
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
        try:
            summary = _summary(file, self.size)
            if not summary:
                self.remarks.append("it is read without its index: it has none")
                return
            self._take_summary(summary)
            self._compare_with_chunks(file)
        except UNPACKING_ERRORS as error:
            self.index_fault = reason(error)
            self.remarks.append(f"it is read without its index: {self.index_fault}")
            self.catalogue, self.counts, self.times = Catalogue(), None, None
            self._chunks = []
        else:
            self.is_indexed = True

    def _take_summary(self, summary: bytes) -> None:
        statistics = b""
        alike: dict[frozenset[int], frozenset[int]] = {}
        for opcode, start, end in records(summary):
            body = summary[start:end]
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.catalogue.describe(opcode, body)
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
        described = self.catalogue.channels
        if any(number not in described for number, count in self.counts.items() if count):
            raise ValueError("its index lacks channels")
        self.times = (first, last) if count else None

    def _compare_with_chunks(self, file: IO[bytes]) -> None:
        """ValueError if most of some chunks are not where they should be: an index of old."""
        every = max(len(self._chunks) // _COMPARED, 1)
        some = self._chunks[::every]
        missing = sum(chunk_length(file, chunk) is None for chunk in some)
        if 2 * missing > len(some):
            raise ValueError("its index is another file's")

    def _chunk_place(self, body: bytes, alike: dict[frozenset[int], frozenset[int]]) -> ChunkPlace:
        first, last, offset, length, size = _CHUNK_INDEX.unpack_from(body)
        if size > len(body) - _CHUNK_INDEX.size or offset + length > self.size:
            raise ValueError("a chunk in the index lies outside of the file")
        places = body[_CHUNK_INDEX.size : _CHUNK_INDEX.size + size]
        channels = frozenset(number for number, _ in _PLACE.iter_unpack(places))
        return ChunkPlace(first, offset, last, length, alike.setdefault(channels, channels))


def _unwatched(done: int) -> None:
    """Nobody is shown how far reading is."""


def _summary(file: IO[bytes], size: int) -> bytes:
    """The summary's bytes, its checksum compared; none if the file was written without one."""
    end = _FOOTER.size + len(MCAP0_MAGIC)
    file.seek(max(0, size - end))
    footer = file.read(end)
    if len(footer) != end or footer[_FOOTER.size :] != MCAP0_MAGIC:
        raise ValueError("it was never finished, or it is cut")
    opcode, length, start, _, checksum = _FOOTER.unpack_from(footer)
    if opcode != Opcode.FOOTER or length != _FOOTER.size - RECORD_HEAD.size:
        raise ValueError("its end is damaged")
    if start == 0:
        return b""
    if not 0 < size - end - start <= _LARGEST_SUMMARY:
        raise ValueError("its end is damaged")
    file.seek(start)
    summary = file.read(size - end - start)
    whole = zlib.crc32(footer[: _FOOTER.size - _CRC_SIZE], zlib.crc32(summary))
    if checksum and whole != checksum:
        raise ValueError("its checksum is wrong")
    return summary
