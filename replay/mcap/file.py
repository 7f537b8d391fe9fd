"""MCAP files, read by the `mcap` package: records of any writer, and messages of recordings."""

from __future__ import annotations

import shlex
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import zstandard
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Chunk, DataEnd, Header, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from chsel.errors import RecordingError
from chsel.numerics.arrays import refuse_special_file
from replay.mcap.schemas import PROFILE
from replay.mcap.texts import one_line

MALFORMED = (
    McapError,
    ValueError,
    struct.error,
    zstandard.ZstdError,
    RuntimeError,  # how lz4 says that a frame is broken
    OverflowError,
    MemoryError,
)
"""Errors of reading records."""

COMPRESSIONS = ("", "zstd", "lz4")  # of chunks that are read
ACCEPTED = "accepted: a recording.mcap that this project wrote"
_FOOTER = struct.Struct("<QQI")  # where summary and its offsets start, checksum
_MOST_UNPACKED = 2**29  # bytes of a chunk; writers make chunks of megabytes, or of one large image


class DamagedRecordingError(RecordingError):
    """A recording is unfinished or damaged. damage: how, without what can be done about it."""

    def __init__(self, path: Path, damage: str) -> None:
        super().__init__(f"recording {path} {damage}; {recover_hint(path)}")
        self.damage = damage


def recover_hint(path: Path) -> str:
    """Return the command that saves what is whole of a file."""
    return f"`python -m replay recover {shlex.quote(str(path))} -o OUT` saves what is whole"


def file_records(file: IO[bytes], size: int) -> Iterator[McapRecord]:
    """Yield the records of a file, chunks as they are, up to its footer.

    Raises any of MALFORMED at the first damage, also if the checksum of all data is wrong.
    """
    file.seek(0)
    reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=size)
    yield from reader.records


def chunk_at(file: IO[bytes], size: int, *, place: int) -> Chunk:
    """Return the chunk at a place; raise one of MALFORMED if there is none."""
    file.seek(place)
    reader = StreamReader(file, skip_magic=True, emit_chunks=True, record_size_limit=size)
    record = next(reader.records, None)
    if not isinstance(record, Chunk):
        raise ValueError("a chunk is not where the index says")
    return record


def unknown_compression(name: str) -> str:
    """Return the error text of a chunk whose compression is not read."""
    return f"a chunk is compressed by {one_line(name)!r}; accepted: zstd, lz4, or none"


def unpacked(chunk: Chunk) -> list[McapRecord]:
    """Return the records of a chunk; raise one of MALFORMED if it is damaged or too large."""
    if chunk.compression not in COMPRESSIONS:  # the package takes its bytes as they are
        raise ValueError(unknown_compression(chunk.compression))
    size = chunk.uncompressed_size
    if chunk.compression == "zstd":
        size = max(size, zstandard.frame_content_size(chunk.data))
    if size > _MOST_UNPACKED:
        raise ValueError(f"a chunk claims {size} bytes, unpacked; accepted: {_MOST_UNPACKED}")
    return breakup_chunk(chunk, validate_crc=True)


def file_summary(file: IO[bytes], size: int) -> Summary | None:
    """Return the summary at the end of a finished file; None if there is none that is whole."""
    try:
        file.seek(size - len(MCAP0_MAGIC) - _FOOTER.size)
        start, _, checksum = _FOOTER.unpack(file.read(_FOOTER.size))
        file.seek(start)
        if checksum not in (0, zlib.crc32(file.read(size - start - len(MCAP0_MAGIC) - 4))):
            return None
        file.seek(0)
        return SeekingReader(file, record_size_limit=size).get_summary()
    except (*MALFORMED, OSError, StopIteration):
        return None


def reason_of(error: BaseException) -> str:
    """Return one line that an error says of a file; that of struct is replaced."""
    text = "" if isinstance(error, struct.error) else one_line(str(error))
    return text or "a record is cut short"


@dataclass(frozen=True)
class StoredMessage:
    """One message as it stands in the file; log_time in nanoseconds."""

    topic: str
    log_time: int
    data: bytes


class McapFile:
    """A recording that is read from start to end.

    attachments: by name, those met so far. damage: what ended a partial reading. place: bytes that
    were whole by then. count: messages so far.
    """

    def __init__(self, path: Path, names: Mapping[str, str], *, partial: bool = False) -> None:
        """Open no file yet. names: topics that are read, with the full names of their messages.

        partial: take what is whole from an unfinished or damaged file, up to the first damage.
        """
        self.path = path
        self.attachments: dict[str, bytes] = {}
        self.damage: str | None = None
        self.place = self.count = 0
        self._names = names
        self._schemas: dict[int, str] = {}  # names by id
        self._topics: dict[int, str] = {}  # by id of their channel
        self._partial = partial

    def messages(self) -> Iterator[StoredMessage]:
        """Yield all messages in the order of writing; raise RecordingError for an invalid file."""
        with opened(self.path) as file:
            size = file.seek(0, 2)
            unfinished = not self._has_end(file, size)
            if unfinished:
                self._stop_at("unfinished")
            try:
                for record in file_records(file, size):
                    if self.place == 0:
                        self._check_header(record)
                    if isinstance(record, DataEnd):
                        return
                    if isinstance(record, Message):
                        raise ValueError("a message stands outside of a chunk")
                    if isinstance(record, Attachment):
                        self.attachments.setdefault(record.name, record.data)
                    elif isinstance(record, Chunk):
                        yield from self.chunk_messages(record)
                    self.place = file.tell()
            except MALFORMED as error:
                if not unfinished or file.tell() < size:
                    self._stop_at(f"damaged after byte {self.place}: {reason_of(error)}")
            else:
                self._stop_at(f"damaged after byte {self.place}: the end of its data is missing")

    def chunk_messages(self, chunk: Chunk) -> list[StoredMessage]:
        """Return the messages of a chunk; raise one of MALFORMED if some are missing."""
        found, count = [], self.count
        for record in unpacked(chunk):
            if isinstance(record, Schema):
                self._schemas[record.id] = record.name
            elif isinstance(record, Channel):
                name, wanted = self._schemas.get(record.schema_id), self._names.get(record.topic)
                if wanted not in (None, name):
                    raise ValueError(f"topic {record.topic} carries {name}")
                self._topics[record.id] = record.topic
            elif isinstance(record, Message):
                if record.sequence != count:
                    raise ValueError(f"message {count} is missing, {record.sequence} follows")
                count += 1
                topic = self._topics.get(record.channel_id, "")
                if topic in self._names:
                    found.append(StoredMessage(topic, record.log_time, data=record.data))
        self.count = count
        return found

    def later_messages(self, chunk: Chunk) -> tuple[list[StoredMessage], int]:
        """Return the messages of a chunk behind damage, and how many are missing before it."""
        first = next((r.sequence for r in unpacked(chunk) if isinstance(r, Message)), self.count)
        missing = first - self.count
        if missing < 0:
            raise ValueError("its messages were there before")
        count, self.count = self.count, first
        try:
            return self.chunk_messages(chunk), missing
        except MALFORMED:
            self.count = count
            raise

    def _has_end(self, file: IO[bytes], size: int) -> bool:
        """Return whether a file is finished; raise RecordingError unless it begins as MCAP."""
        file.seek(0)
        if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise RecordingError(f"recording {self.path} is not an MCAP file; {ACCEPTED}")
        file.seek(max(size - len(MCAP0_MAGIC), len(MCAP0_MAGIC)))
        return file.read() == MCAP0_MAGIC

    def _check_header(self, record: McapRecord) -> None:
        if not isinstance(record, Header) or record.profile != PROFILE:
            raise RecordingError(f"recording {self.path} is another program's; {ACCEPTED}")

    def _stop_at(self, damage: str) -> None:
        """Keep the damage in mind, or raise it if all is wanted."""
        if not self._partial:
            raise DamagedRecordingError(self.path, f"is {damage}")
        self.damage = damage


@contextmanager
def opened(path: Path) -> Iterator[IO[bytes]]:
    """Open a recording for reading; raise RecordingError where that fails, also later on."""
    refuse_special_file(f"recording {path}", path, error=RecordingError)
    try:
        with path.open("rb") as file:
            yield file
    except IsADirectoryError:
        raise RecordingError(f"recording {path} is a folder; {ACCEPTED}") from None
    except FileNotFoundError:
        raise RecordingError(f"recording {path} does not exist; {ACCEPTED}") from None
    except OSError as error:
        reason = error.strerror or str(error)
        raise RecordingError(f"recording {path} cannot be read: {reason}") from error
