"""What the index at the end of a finished MCAP file says, and single messages found by it."""

from __future__ import annotations

import struct
import zlib
from io import BytesIO
from pathlib import Path
from typing import IO, Any

from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    Header,
    Message,
    Statistics,
)
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC

from chsel.errors import RecordingError
from chsel.problem.file_checks import refuse_special_file
from replay.mcap.chunk_records import DAMAGE, check_size, chunk_records, plausible_size
from replay.mcap.schemas import PROFILE

_FOOTER = struct.Struct("<BQQQI")  # opcode, length, summary start, offsets' start, checksum
_CRC_SIZE = 4
_LONGEST_HEADER = 4096


class McapIndex:
    """The end of a file, and what it points to; a large file's middle is never read.

    size: of the file, bytes. attachments: bytes of each, by name. messages: how many, by topic.
    Raises RecordingError if the file has no such end, or if a checksum of what is read is wrong.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.attachments: dict[str, int] = {}
        self.messages: dict[str, int] = {}
        self._topics: dict[int, str] = {}  # by id of channel
        self._chunks: list[ChunkIndex] = []
        self._read: tuple[int, list[Message]] = (-1, [])  # the last chunk: where, and its messages
        refuse_special_file(f"recording {path}", path, RecordingError)
        try:
            with path.open("rb") as file:
                self.size = file.seek(0, 2)
                self._check_header(file)
                self._take_summary(_summary(file, self.size))
        except (*DAMAGE, OSError) as error:
            raise RecordingError(f"recording {path} has no index: {error}") from error

    def message(self, topic: str) -> bytes | None:
        """The one message on a topic; None if there is none. RecordingError if there are more."""
        count = self.messages.get(topic, 0)
        if count == 0:
            return None
        found: list[bytes] = []
        try:
            for index in self._chunks:
                topics = {self._topics[number] for number in index.message_index_offsets}
                if topic in topics:
                    chunk = self._messages(index)
                    found += [m.data for m in chunk if self._topics[m.channel_id] == topic]
        except (*DAMAGE, KeyError, OSError) as error:
            raise RecordingError(f"recording {self.path} has a damaged chunk: {error}") from error
        if len(found) != 1 or count != 1:
            raise RecordingError(f"recording {self.path} has {len(found)} messages on {topic}")
        return found[0]

    def _check_header(self, file: IO[bytes]) -> None:
        file.seek(0)
        first = BytesIO(file.read(_LONGEST_HEADER))
        records = StreamReader(first, record_size_limit=_LONGEST_HEADER).records
        header = next(iter(records), None)
        if not isinstance(header, Header) or header.profile != PROFILE:
            raise ValueError(f"its header is not that of profile {PROFILE}")

    def _take_summary(self, records: list[Any]) -> None:
        counts: dict[int, int] = {}
        for record in records:
            match record:
                case Channel():
                    self._topics[record.id] = record.topic
                case Statistics():
                    counts = record.channel_message_counts
                case ChunkIndex():
                    self._chunks.append(record)
                case AttachmentIndex():
                    self.attachments[record.name] = record.data_size
        if not counts or set(counts) - set(self._topics):
            raise ValueError("its statistics are missing or name channels that do not exist")
        self.messages = {self._topics[number]: count for number, count in counts.items()}

    def _messages(self, index: ChunkIndex) -> list[Message]:
        """The messages of a chunk, its checksum compared."""
        start, length = index.chunk_start_offset, index.chunk_length
        if self._read[0] != start:
            if start + length > self.size:
                raise ValueError(f"it should lie from byte {start} on, {length} bytes long")
            with self.path.open("rb") as file:
                file.seek(start)
                data = BytesIO(file.read(length))
            reader = StreamReader(data, skip_magic=True, emit_chunks=True, record_size_limit=length)
            chunk = next(iter(reader.records), None)
            if not isinstance(chunk, Chunk):
                raise ValueError(f"there is none at byte {start}")
            check_size(chunk, plausible_size(self.size))
            self._read = (start, [p for p in chunk_records(chunk) if isinstance(p, Message)])
        return self._read[1]


def _summary(file: IO[bytes], size: int) -> list[Any]:
    """The records of the summary, its checksum compared."""
    end = _FOOTER.size + len(MCAP0_MAGIC)
    file.seek(max(0, size - end))
    footer = file.read(end)
    if len(footer) != end or footer[_FOOTER.size :] != MCAP0_MAGIC:
        raise ValueError("it does not end as a finished file does")
    opcode, length, start, _, crc = _FOOTER.unpack_from(footer)
    if opcode != Opcode.FOOTER or length != _FOOTER.size - 9 or not 0 < start <= size - end:
        raise ValueError("its last record is no footer of a file with a summary")
    file.seek(start)
    summary = file.read(size - end - start)
    if zlib.crc32(footer[: _FOOTER.size - _CRC_SIZE], zlib.crc32(summary)) != crc:
        raise ValueError("the checksum of its summary is wrong")
    stream = BytesIO(summary + footer)
    reader = StreamReader(stream, skip_magic=True, emit_chunks=True, record_size_limit=size)
    return [record for record in reader.records if not isinstance(record, Footer)]
