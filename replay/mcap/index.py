"""What the index at the end of a finished MCAP file says, and single messages found by it."""

from __future__ import annotations

from pathlib import Path
from typing import IO

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, ChunkIndex, Message, Statistics
from mcap.writer import MCAP0_MAGIC

from chsel.errors import RecordingError
from replay.mcap.file import LIMITS, opened
from replay.mcap.record_bytes import MALFORMED, message, parsed, parts
from replay.mcap.records import Records
from replay.mcap.schemas import PROFILE
from replay.mcap.summary import summary


class McapIndex:
    """The end of a file, and what it points to; a large file's middle is never read."""

    def __init__(self, path: Path) -> None:
        """Raises RecordingError if the file has no index, or if what is read of it is damaged."""
        self.path = path
        self.attachments: dict[str, int] = {}  # bytes of each, by name
        self.messages: dict[str, int] = {}  # how many, by topic
        self._topics: dict[int, str] = {}  # by id of channel
        self._chunks: list[ChunkIndex] = []
        self._read: tuple[int, list[Message]] = (-1, [])  # the last chunk: where, and its messages
        try:
            with opened(path) as file:
                self._take_summary(file)
                records = Records(file, LIMITS)
                self.size = records.size  # of the file, bytes
                header = records.read(records.head(len(MCAP0_MAGIC)))
                if parsed(Opcode.HEADER, header.content).profile != PROFILE:
                    raise ValueError(f"its header is not that of profile {PROFILE}")
        except MALFORMED as error:
            raise RecordingError(f"recording {path} has no index: {error}") from error

    def message(self, topic: str) -> bytes | None:
        """The one message on a topic; None if there is none. RecordingError if there are more."""
        count = self.messages.get(topic, 0)
        if count == 0:
            return None
        found: list[bytes] = []
        try:
            for index in self._chunks:
                if topic in {self._topics[number] for number in index.message_index_offsets}:
                    chunk = self._messages(index)
                    found += [m.data for m in chunk if self._topics[m.channel_id] == topic]
        except (*MALFORMED, KeyError) as error:
            raise RecordingError(f"recording {self.path} has a damaged chunk: {error}") from error
        if len(found) != 1 or count != 1:
            raise RecordingError(f"recording {self.path} has {len(found)} messages on {topic}")
        return found[0]

    def _take_summary(self, file: IO[bytes]) -> None:
        counts: dict[int, int] = {}
        for record in summary(file, checked=True):
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
        start = index.chunk_start_offset
        if self._read[0] != start:
            with opened(self.path) as file:
                records = Records(file, LIMITS)
                head = records.head(start)
                if head.opcode != Opcode.CHUNK or head.end - start != index.chunk_length:
                    raise ValueError(f"there is none of {index.chunk_length} bytes at byte {start}")
                data = records.read(head).content
            found = [data[a:b] for opcode, a, b in parts(data) if opcode == Opcode.MESSAGE]
            self._read = start, [message(body) for body in found]
        return self._read[1]
