"""What is whole in a damaged MCAP file: the records that their own checksums vouch for."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import IO, Any

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Chunk
from mcap.writer import MCAP0_MAGIC

from replay.mcap.attachments import MESH, SDF_GRID
from replay.mcap.chunk_records import DAMAGE, check_size, chunk_records, plausible_size
from replay.mcap.texts import one_line

_HEAD = struct.Struct("<BQ")  # of every record: opcode, length of what follows
# Of a chunk: start, end, uncompressed size, checksum, compression with its length, size of the data
_CHUNK_HEAD = struct.Struct("<QQQII4sQ")
_INDEX_HEAD = struct.Struct("<HI")  # channel, size of the entries
_INDEX_ENTRY = 16  # bytes
_LENGTH = struct.Struct("<I")  # ahead of every text
_CRC_SIZE = 4
# How chunks and attachments are found: by a text that stands in each at a fixed place.
_CHUNK_MARK = _LENGTH.pack(4) + b"zstd"
_MARKS = (_CHUNK_MARK, *(_LENGTH.pack(len(name)) + name.encode() for name in (MESH, SDF_GRID)))
_CHUNK_MARK_AT, _ATTACHMENT_MARK_AT = _HEAD.size + 28, _HEAD.size + 16
_ANY_MARK = re.compile(b"|".join(map(re.escape, _MARKS)))
_MAGIC = re.compile(re.escape(MCAP0_MAGIC))
_LONGEST_PATTERN = max(map(len, (*_MARKS, MCAP0_MAGIC)))
_FIRST_WINDOW, _WINDOW = 2**12, 2**20  # bytes that a search looks at in one go
_SUMMARY = frozenset(
    {
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.STATISTICS,
        Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT_INDEX,
        Opcode.SUMMARY_OFFSET,
        Opcode.FOOTER,
    }
)
_SIZES = {Opcode.DATA_END: 4, Opcode.FOOTER: 20}  # bytes after the head


@dataclass(frozen=True)
class Damage:
    """Bytes of a file from start to before end that cannot be believed, and why."""

    start: int
    end: int
    reason: str


@dataclass(frozen=True, eq=False)
class WholeRecord:
    """An attachment, or what is in a chunk, at bytes from start to before end; its CRC is right."""

    start: int
    end: int
    content: Attachment | list[Any]


class WholeRecords:
    """Finds whole chunks and attachments, also behind damage; no other record is believed.

    damages: what lies between them and is no well-formed record either, as far as read.
    finished: whether the end of a finished file was met. What lies behind it is another matter.
    Time and memory are bounded: of records with wrong checksums, no more is read than a file of
    this size can plausibly hold.
    """

    def __init__(self, file: IO[bytes], size: int) -> None:
        self.damages: list[Damage] = []
        self.finished = False
        self._file = file
        self._size = size
        self._allowance = plausible_size(size)  # bytes of chunks, unpacked
        self._broken: dict[int, tuple[int, str]] = {}  # end and reason of records, by their start
        self._data_ended = False

    def __iter__(self) -> Iterator[WholeRecord]:
        position = 0
        while True:
            found = self._next(position)
            if self._ends_between(position, found.start if found else self._size):
                return
            if found is None:
                return
            yield found
            position = found.end

    def _next(self, position: int) -> WholeRecord | None:
        """The first whole record from a position on."""
        self._broken = {}
        searched = position
        while (found := self._find(_ANY_MARK, searched, self._size)) is not None:
            at, mark = found
            searched = at + 1
            start = at - (_CHUNK_MARK_AT if mark == _CHUNK_MARK else _ATTACHMENT_MARK_AT)
            end = self._end_of_frame(start, mark) if start >= position else None
            if end is None:
                continue
            if self._allowance < 0:
                return None
            try:
                return WholeRecord(start, end, self._content(start, end, mark))
            except DAMAGE as error:
                self._broken[start] = (end, one_line(str(error)))
                if self._may_begin(end):
                    position = searched = end
        return None

    def _end_of_frame(self, start: int, mark: bytes) -> int | None:
        """Where a record ends that seems to start here; None if it is none."""
        head = self._read(start, _HEAD.size + _CHUNK_HEAD.size)
        if len(head) < _HEAD.size + _CHUNK_HEAD.size:
            return None
        opcode, length = _HEAD.unpack_from(head)
        if mark != _CHUNK_MARK:
            return start + _HEAD.size + length if opcode == Opcode.ATTACHMENT else None
        data_size = _CHUNK_HEAD.unpack_from(head, _HEAD.size)[-1]
        agrees = opcode == Opcode.CHUNK and length == _CHUNK_HEAD.size + data_size
        return start + _HEAD.size + length if agrees else None

    def _content(self, start: int, end: int, mark: bytes) -> Attachment | list[Any]:
        """What is in a record; any of DAMAGE if its checksum does not hold."""
        kind = "chunk" if mark == _CHUNK_MARK else "attachment"
        if end > self._size:
            raise ValueError(f"the file ends within this {kind}")
        self._allowance -= end - start
        body = self._read(start + _HEAD.size, end - start - _HEAD.size)
        stream = ReadDataStream(BytesIO(body))
        if kind == "attachment":
            if zlib.crc32(body[:-_CRC_SIZE]) != _LENGTH.unpack(body[-_CRC_SIZE:])[0]:
                raise ValueError("the checksum of an attachment is wrong")
            return Attachment.read(stream)
        chunk = Chunk.read(stream)
        check_size(chunk, self._allowance)
        self._allowance -= chunk.uncompressed_size
        if chunk.uncompressed_crc == 0:
            raise ValueError("a chunk has no checksum")
        return list(chunk_records(chunk))

    def _ends_between(self, position: int, stop: int) -> bool:
        """Look at what lies between two whole records; whether the recording ends in there."""
        if position == 0 and self._read(0, len(MCAP0_MAGIC)) == MCAP0_MAGIC:
            position = len(MCAP0_MAGIC)
        while position < stop:
            opcode, end = self._well_formed(position, stop)
            if opcode == Opcode.FOOTER:
                self._end(end)
                return True
            if opcode == 0:
                end, reason = self._broken.get(position, (stop, "there is no whole record here"))
                if end >= stop or not self._may_begin(end):
                    return self._is_of_another(position, stop, reason)
                self.damages.append(Damage(position, end, reason))
            position = end
        return False

    def _is_of_another(self, position: int, stop: int, reason: str) -> bool:
        """Note a stretch as damaged; whether another recording begins in it."""
        if self._allowance < 0:
            reason = "there is more damage than can be searched"
        found = self._find(_MAGIC, position, stop)
        while found is not None and self._read(found[0] + len(MCAP0_MAGIC), 1) != b"\x01":
            found = self._find(_MAGIC, found[0] + 1, stop)
        end = stop if found is None else found[0]
        if end > position:
            self.damages.append(Damage(position, end, reason))
        if found is not None:
            self.damages.append(Damage(end, self._size, "another recording begins here"))
        return found is not None

    def _well_formed(self, position: int, stop: int) -> tuple[int, int]:
        """Opcode and end of a record that may stand between two whole ones; 0 if there is none."""
        head = self._read(position, _HEAD.size + _INDEX_HEAD.size)
        if len(head) < _HEAD.size:
            return 0, stop
        opcode, length = _HEAD.unpack_from(head)
        end = position + _HEAD.size + length
        if opcode == Opcode.HEADER:
            fits = position == len(MCAP0_MAGIC)
        elif opcode == Opcode.MESSAGE_INDEX and len(head) == _HEAD.size + _INDEX_HEAD.size:
            size = _INDEX_HEAD.unpack_from(head, _HEAD.size)[1]
            fits = length == _INDEX_HEAD.size + size and size % _INDEX_ENTRY == 0
        else:
            fits = opcode == Opcode.DATA_END or (self._data_ended and opcode in _SUMMARY)
            fits = fits and length == _SIZES.get(opcode, length)
        if not fits or end > stop:
            return 0, stop
        self._data_ended |= opcode == Opcode.DATA_END
        return opcode, end

    def _end(self, position: int) -> None:
        """The recording ends here, and the file should too."""
        end = position + len(MCAP0_MAGIC)
        self.finished = self._read(position, len(MCAP0_MAGIC)) == MCAP0_MAGIC
        if not self.finished:
            self.damages.append(Damage(position, self._size, "the end of the file is missing"))
        elif end < self._size:
            self.damages.append(Damage(end, self._size, "this is behind the recording's end"))

    def _may_begin(self, position: int) -> bool:
        """Whether a record, or the end of the file, may be here."""
        head = self._read(position, _HEAD.size)
        if len(head) < _HEAD.size:
            return position == self._size
        opcode, length = _HEAD.unpack(head)
        return 0 < opcode <= Opcode.DATA_END and position + _HEAD.size + length <= self._size

    def _find(self, pattern: re.Pattern[bytes], start: int, stop: int) -> tuple[int, bytes] | None:
        """Where a pattern is first found, and what was found there."""
        window = _FIRST_WINDOW
        while start < stop:
            data = self._read(start, min(window, stop - start))
            if not data:
                return None
            if found := pattern.search(data):
                return start + found.start(), found.group()
            if start + len(data) >= stop:
                return None
            start += max(1, len(data) - _LONGEST_PATTERN + 1)
            window = min(2 * window, _WINDOW)
        return None

    def _read(self, position: int, size: int) -> bytes:
        self._file.seek(position)
        return self._file.read(max(0, min(size, self._size - position)))
