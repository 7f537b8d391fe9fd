"""The messages and attachments of an MCAP file of this project, or a clear error."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from mcap.exceptions import EndOfFile
from mcap.records import Attachment, Channel, Chunk, DataEnd, Footer, Header, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC

from chsel.errors import RecordingError
from chsel.problem.file_checks import refuse_special_file
from replay.mcap.chunk_records import DAMAGE, check_size, chunk_records, plausible_size
from replay.mcap.damaged import DamagedRecordingError
from replay.mcap.schemas import PROFILE
from replay.mcap.seal import Chain
from replay.mcap.texts import one_line

UNFINISHED = "unfinished"
_ACCEPTED = "accepted: a recording.mcap that this project wrote"
_PLAUSIBLE_MESSAGES = 10_000  # and one more for every so many bytes of the file:
_LEAST_BYTES = 4


@dataclass(frozen=True)
class StoredMessage:
    """One message as it stands in the file; log_time in nanoseconds."""

    topic: str
    log_time: int
    data: bytes


class Topics:
    """Which topic the channels of a file stand for, and whether it matters.

    schemas: the full name of the message on every topic that matters.
    """

    def __init__(self, schemas: Mapping[str, str]) -> None:
        self._schemas = schemas
        self._described: dict[int, Schema] = {}  # by id
        self._channels: dict[int, Channel] = {}  # by id

    def describe(self, part: Schema | Channel) -> None:
        """Take note of a schema or channel; ValueError if it is not as this project writes it."""
        if isinstance(part, Schema):
            if self._described.setdefault(part.id, part) != part:
                raise ValueError(f"schema {part.id} is described twice, and not the same")
            return
        schema = self._described.get(part.schema_id)
        name = None if schema is None else schema.name
        if self._schemas.get(part.topic, name) != name:
            raise ValueError(f"topic {part.topic} carries {name}")
        if self._channels.setdefault(part.id, part) != part:
            raise ValueError(f"channel {part.id} is described twice, and not the same")

    def stored(self, message: Message) -> StoredMessage:
        """The message with its topic; ValueError if that is unknown."""
        channel = self._channels.get(message.channel_id)
        if channel is None:
            raise ValueError(f"channel {message.channel_id} does not exist")
        return StoredMessage(channel.topic, message.log_time, message.data)

    def matters(self, message: StoredMessage) -> bool:
        """Whether the topic of a message is one of those named."""
        return message.topic in self._schemas


class McapFile:
    """Reads one file from start to end, checking every checksum on the way.

    schemas: the full name of the message on every topic that matters; others are skipped.
    partial: take what is whole from an unfinished or damaged file, up to the first damage.
    check_seals: whether what was changed since it was written counts as damage.
    attachments: by name, those met so far. chain: follows the seals of the file.
    damage: what ended a partial reading, or None.
    """

    def __init__(
        self,
        path: Path,
        schemas: Mapping[str, str],
        *,
        partial: bool = False,
        check_seals: bool = True,
    ) -> None:
        self.path = path
        self.attachments: dict[str, bytes] = {}
        self.chain = Chain()
        self.damage: str | None = None
        self._topics = Topics(schemas)
        self._partial = partial
        self._check_seals = check_seals
        self._repeated: list[Schema | Channel] = []
        self._count = 0  # messages met so far
        self._most_messages = _PLAUSIBLE_MESSAGES
        self._data_ended = False
        self._footer = Footer(summary_start=0, summary_offset_start=0, summary_crc=0)

    def messages(self) -> Iterator[StoredMessage]:
        """All messages in the order of writing. Raises RecordingError if the file is no good."""
        refuse_special_file(f"recording {self.path}", self.path, RecordingError)
        try:
            with self.path.open("rb") as file:
                size = file.seek(0, 2)
                self._check_kind(file, size)
                yield from self._whole_messages(file, size)
        except IsADirectoryError:
            raise RecordingError(f"recording {self.path} is a folder; {_ACCEPTED}") from None
        except FileNotFoundError:
            raise RecordingError(f"recording {self.path} does not exist; {_ACCEPTED}") from None
        except OSError as error:
            reason = error.strerror or str(error)
            raise RecordingError(f"recording {self.path} cannot be read: {reason}") from error

    def _check_kind(self, file: IO[bytes], size: int) -> None:
        file.seek(0)
        if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise RecordingError(f"recording {self.path} is no MCAP file; {_ACCEPTED}")
        file.seek(max(0, size - len(MCAP0_MAGIC)))
        if size < 2 * len(MCAP0_MAGIC) or file.read() != MCAP0_MAGIC:
            self._stop_at(UNFINISHED)
        file.seek(0)

    def _whole_messages(self, file: IO[bytes], size: int) -> Iterator[StoredMessage]:
        stream = _Bounded(file, size)
        limit = plausible_size(size)
        self._most_messages = _PLAUSIBLE_MESSAGES + size // _LEAST_BYTES
        reader = StreamReader(
            stream,  # type: ignore[arg-type]
            emit_chunks=True,
            validate_crcs=True,
            record_size_limit=size,
        )
        records = iter(reader.records)
        while True:
            try:
                record = next(records, None)
                if record is None:
                    return self._check_end(file, size)
                found = self._take(record, limit)
            except DAMAGE as error:
                reason = "it ends early" if isinstance(error, EndOfFile) else str(error)
                return self._stop_at(f"damaged before byte {file.tell()}: {reason}")
            if isinstance(record, Chunk):
                limit -= record.uncompressed_size
            yield from found

    def _take(self, record: Any, limit: int) -> list[StoredMessage]:
        """The messages in a record; ValueError if it is not as this project writes it."""
        if isinstance(record, Attachment | Chunk | Message) and self._data_ended:
            raise ValueError("data follow the end of its data")
        match record:
            case Header() if record.profile != PROFILE:
                raise RecordingError(f"recording {self.path} is another program's; {_ACCEPTED}")
            case Attachment() if record.name in self.attachments:
                raise ValueError(f"the attachment {record.name!r} stands in it twice")
            case Attachment():
                self.attachments[record.name] = record.data
                if self._check_seals:
                    self.chain.attach(record)
            case Schema() | Channel():  # of the summary, where they stand once more
                self._repeated.append(record)
            case Message():
                raise ValueError("a message stands outside of a chunk")
            case Chunk():
                check_size(record, limit)
                found = [self._message(part) for part in chunk_records(record)]
                return [message for message in found if message is not None]
            case DataEnd():  # its checksum, of all before it, has been compared by now
                self._data_ended = True
            case Footer() if not self._data_ended:
                raise ValueError("the end of its data is missing")
            case Footer():
                self._footer = record
        return []

    def _message(self, part: Any) -> StoredMessage | None:
        """A message on a topic that matters; takes note of schemas and channels."""
        match part:
            case Schema() | Channel():
                self._topics.describe(part)
                if self._check_seals:
                    self.chain.describe(part)
            case Message():
                if part.sequence != self._count:
                    raise ValueError(f"message {self._count} is missing, {part.sequence} follows")
                self._count += 1
                if self._count > self._most_messages:
                    raise ValueError(f"it holds more than {self._most_messages} messages")
                stored = self._topics.stored(part)
                if self._check_seals:
                    self.chain.read(stored.topic, part)
                return stored if self._topics.matters(stored) else None
        return None

    def _check_end(self, file: IO[bytes], size: int) -> None:
        """The summary's checksum, which reading in order passes by, and what no seal closes."""
        if file.tell() != size:
            return self._stop_at(f"damaged: it ends at byte {file.tell()} of {size}")
        crc_size = 4
        length = size - self._footer.summary_start - len(MCAP0_MAGIC) - crc_size
        if length < 0:
            return self._stop_at("damaged: its summary starts beyond its end")
        file.seek(self._footer.summary_start)
        summary = file.read(length)
        if zlib.crc32(summary) != self._footer.summary_crc:
            return self._stop_at("damaged: the checksum of its summary is wrong")
        try:
            for part in self._repeated:
                self._topics.describe(part)
        except ValueError as error:
            return self._stop_at(f"damaged: in its summary, {error}")
        if self.chain.session and self.chain.is_open:
            return self._stop_at("damaged: records follow its last seal")
        return None

    def _stop_at(self, damage: str) -> None:
        """Keep the damage in mind, or raise it if all is wanted."""
        if not self._partial:
            raise DamagedRecordingError(self.path, f"is {one_line(damage)}")
        self.damage = self.damage or damage


class _Bounded:
    """A file that never makes room for more bytes than it has left."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        self._file = file
        self._size = size

    def read(self, length: int) -> bytes:
        return self._file.read(min(length, self._size - self._file.tell()))
