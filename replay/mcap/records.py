"""Finds the records of MCAP files of any writer: whole, unfinished, damaged, or made to do harm.

The types of the `mcap` package (1.6) read what is in a record. Its readers cannot find the records
for us, as `tests/replay/mcap/test_records.py` shows:

| needed | mcap's `StreamReader` | mcap's `SeekingReader` |
|---|---|---|
| checksums of chunks, data, attachments, summary | chunks, data | chunks |
| a length that exceeds its record | reads on in the next record | the same |
| a chunk that claims, or unpacks to, gigabytes | makes room for them | the same |
| messages by log time in bounded memory | all are held | chunks that overlap are held |
| an unfinished file | up to its end, which is an error | nothing |
| a damaged file | up to the damage | nothing behind the damage |
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, NamedTuple

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from replay.mcap.record_bytes import HEAD, MALFORMED, parsed, reason_of, unpacked

ENDS_EARLY = "it ends early, as if never finished"
NO_RECORD = "there is no whole record here"
TOO_MUCH_DAMAGE = "there is more damage than can be searched"
_INDEX_HEAD = struct.Struct("<HI")  # of a message index: channel, size of the entries
_INDEX_ENTRY = 16  # bytes
_NUMBER = struct.Struct("<I")  # a checksum, or the length of a text
_LENGTHS = {int(Opcode.DATA_END): _NUMBER.size, int(Opcode.FOOTER): 20}
# How chunks and attachments are found behind damage: by a text at a fixed place in each.
_TEXT_AT = {int(Opcode.CHUNK): HEAD.size + 28, int(Opcode.ATTACHMENT): HEAD.size + 16}
_LONGEST_PATTERN = 32  # bytes
_FIRST_WINDOW, _WINDOW = 2**12, 2**20  # bytes that a search looks at in one go
_READ_RATIO = 8  # how often a file is read at most, in search of what is whole
_BEGINNING = re.compile(re.escape(MCAP0_MAGIC + bytes([Opcode.HEADER])))


class Head(NamedTuple):
    """Where a record is: at bytes from start to before end."""

    opcode: int
    start: int
    end: int


class Record(NamedTuple):
    """A record whose checksum is right, if it has one."""

    opcode: int
    start: int  # in the file, bytes
    end: int
    content: bytes  # what is behind its head; of a chunk what is in it, unpacked


@dataclass(frozen=True)
class Damage:
    """Bytes of a file from start to before end that cannot be believed, and why."""

    start: int
    end: int
    reason: str


@dataclass(frozen=True)
class Limits:
    """How much is read of a file, and how strictly."""

    size: int  # bytes that all of its chunks may hold, unpacked,
    ratio: int  # and so many more for each byte of the file
    largest: int  # bytes of a record, and of a chunk, unpacked
    checked: bool  # whether chunks have to have a checksum
    attachments: tuple[str, ...] = ()  # names of those that are searched for behind damage
    passed_by: frozenset[int] = frozenset()  # opcodes of records whose content is left out


class Records:
    """The records of one file, found in time and memory that are bounded by its size."""

    def __init__(self, file: IO[bytes], limits: Limits) -> None:
        self.size = file.seek(0, 2)
        self.name = Path(getattr(file, "name", "")).name
        self._file, self._limits = file, limits
        self._header = len(MCAP0_MAGIC)  # where it is
        self._unpackable = limits.size + limits.ratio * self.size  # bytes that are left
        self._readable = limits.size + _READ_RATIO * self.size  # bytes that are left
        names = {b"zstd": Opcode.CHUNK, b"lz4": Opcode.CHUNK}
        names |= {name.encode(): Opcode.ATTACHMENT for name in limits.attachments}
        self._marks = {_NUMBER.pack(len(name)) + name: int(kind) for name, kind in names.items()}
        self._any_mark = re.compile(b"|".join(map(re.escape, self._marks)))

    def up_to_damage(self) -> Iterator[Record | Damage]:
        """All records in their order, the checksum of the data compared; then what is wrong."""
        place, checksum = len(MCAP0_MAGIC), zlib.crc32(MCAP0_MAGIC)
        while place < self.size:
            head = None
            try:
                head = self.head(place)
                stored = self._bytes(place, head.end - place)
                if head.opcode == Opcode.DATA_END:
                    (expected,) = _NUMBER.unpack(stored[HEAD.size :])
                    if expected not in (0, checksum):
                        raise ValueError("the checksum of its data is wrong")
                checksum = zlib.crc32(stored, checksum)
                record = Record(*head, self._content(head.opcode, stored[HEAD.size :]))
            except MALFORMED as error:
                yield Damage(place, head.end if head else self.size, reason_of(error))
                return
            yield record
            place = record.end
            if record.opcode == Opcode.FOOTER:
                yield from self._behind(place)
                return
        yield Damage(self.size, self.size, ENDS_EARLY)

    def whole(self) -> Iterator[Record | Damage]:
        """All whole records, and the damage between them.

        Behind damage the next chunk or attachment is searched for. Nothing is read behind the end
        of a finished file, nor where another one begins.
        """
        place = searched = 0  # chunks and attachments that begin before `searched` are known
        if self._bytes(0, len(MCAP0_MAGIC)) == MCAP0_MAGIC:
            place = self._header
        elif self._next(0) > (begin := self._beginning(0, self.size)):
            yield Damage(0, begin, "this is ahead of the recording")
            place = searched = self._header = begin + len(MCAP0_MAGIC)
        while place < self.size:
            head = None
            try:
                head = self.head(place)
                record = self.read(head)
            except MALFORMED as error:
                reason = reason_of(error)
            else:
                yield record
                place = record.end
                if record.opcode in _TEXT_AT:
                    searched = place
                if record.opcode == Opcode.FOOTER:
                    yield from self._behind(place)
                    return
                continue
            if head is not None and head.opcode in _TEXT_AT:
                searched = place + 1
            if head is not None and self._may_begin(head.end):
                end = head.end
            else:
                end = self._next(searched)
                reason = TOO_MUCH_DAMAGE if self._readable <= 0 else reason
            other = self._beginning(place, end)
            yield Damage(min(place, end), other, reason)
            if other < end:
                yield Damage(other, self.size, "another recording begins here")
                return
            if end == self.size:
                return
            place = end
        yield Damage(self.size, self.size, ENDS_EARLY)

    def head(self, place: int) -> Head:
        """Of the record at a place; ValueError if none can be there."""
        data = self._bytes(place, HEAD.size + _INDEX_HEAD.size)
        if len(data) < HEAD.size:
            raise ValueError(ENDS_EARLY)
        opcode, length = HEAD.unpack_from(data)
        end = place + HEAD.size + length
        fits = opcode > 0 and length == _LENGTHS.get(opcode, length)
        fits &= (opcode == Opcode.HEADER) == (place == self._header)
        if opcode == Opcode.MESSAGE_INDEX and len(data) == HEAD.size + _INDEX_HEAD.size:
            _, size = _INDEX_HEAD.unpack_from(data, HEAD.size)
            fits &= length == _INDEX_HEAD.size + size and size % _INDEX_ENTRY == 0
        if not fits:
            raise ValueError(NO_RECORD)
        if end > self.size:
            raise ValueError("it is cut within a record, or a length in it is wrong")
        return Head(opcode, place, end)

    def read(self, head: Head) -> Record:
        """The record; any of MALFORMED if it is not whole."""
        if head.opcode in self._limits.passed_by:
            return Record(*head, b"")
        place = head.start + HEAD.size
        return Record(*head, self._content(head.opcode, self._bytes(place, head.end - place)))

    def _content(self, opcode: int, body: bytes) -> bytes:
        if opcode == Opcode.CHUNK:
            chunk = parsed(opcode, body)
            most = min(self._unpackable, self._limits.largest)
            if chunk.uncompressed_size <= most:
                self._unpackable -= chunk.uncompressed_size
            return unpacked(chunk, most, checked=self._limits.checked)
        if opcode == Opcode.ATTACHMENT:
            (checksum,) = _NUMBER.unpack(body[-_NUMBER.size :])
            if zlib.crc32(body[: -_NUMBER.size]) != checksum:
                raise ValueError("the checksum of an attachment is wrong")
        return body

    def _behind(self, place: int) -> Iterator[Damage]:
        """What is wrong behind the last record, where the file should end."""
        end = place + len(MCAP0_MAGIC)
        if self._bytes(place, len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            yield Damage(place, self.size, "the end of the file is missing")
        elif end < self.size:
            yield Damage(end, self.size, "this is behind the recording's end")

    def _may_begin(self, place: int) -> bool:
        """Whether a record can be at a place."""
        try:
            return self.head(place).end > place
        except ValueError:
            return False

    def _next(self, start: int) -> int:
        """Where the next chunk or attachment seems to begin, by its lengths; else the end."""
        for at, mark in self._found(self._any_mark, start, self.size):
            kind = self._marks[mark]
            place = at - _TEXT_AT[kind]
            if place >= start and self._agrees(place, kind):
                return place
        return self.size

    def _beginning(self, start: int, stop: int) -> int:
        """Where a recording begins in some bytes; their end, if none does."""
        return next((at for at, _ in self._found(_BEGINNING, start, stop)), stop)

    def _agrees(self, place: int, kind: int) -> bool:
        """Whether lengths say that a chunk or attachment is at a place."""
        try:
            head = self.head(place)
        except ValueError:
            return False
        if head.opcode != kind or kind != Opcode.CHUNK:
            return head.opcode == kind
        start = place + _TEXT_AT[kind]
        (name,) = _NUMBER.unpack(self._bytes(start, _NUMBER.size))
        start += _NUMBER.size + name
        length = int.from_bytes(self._bytes(start, 8), "little")
        return start + 8 + length == head.end

    def _found(
        self, pattern: re.Pattern[bytes], start: int, stop: int
    ) -> Iterator[tuple[int, bytes]]:
        """Where a pattern is, and what is there; until too much was read."""
        window = _FIRST_WINDOW
        while start < stop and self._readable > 0:
            data = self._bytes(start, min(window, stop - start))
            is_last = start + len(data) >= stop
            step = len(data) if is_last else max(len(data) - _LONGEST_PATTERN, 1)
            for found in pattern.finditer(data):
                if found.start() < step:
                    yield start + found.start(), found.group()
            start += step
            window = min(2 * window, _WINDOW)

    def _bytes(self, place: int, length: int) -> bytes:
        """Bytes of the file, never more than it has, nor than may be read."""
        length = max(min(length, self.size - place), 0)
        if length > self._limits.largest:
            raise ValueError(f"a record has {length} bytes; accepted: {self._limits.largest}")
        if length > _WINDOW and length > self._readable:
            raise ValueError(TOO_MUCH_DAMAGE)
        self._readable -= length
        if length > 0:
            self._file.seek(place)
        return self._file.read(length)
