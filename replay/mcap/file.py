"""The messages and attachments of an MCAP file of this project, or a clear error."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Message, Schema
from mcap.writer import MCAP0_MAGIC

from chsel.errors import RecordingError
from chsel.problem.file_checks import refuse_special_file
from replay.mcap.damaged import DamagedRecordingError
from replay.mcap.record_bytes import MALFORMED, message, parsed, parts, reason_of
from replay.mcap.records import Damage, Limits, Record, Records
from replay.mcap.schemas import MESH, PROFILE, SDF_GRID
from replay.mcap.seal import Chain
from replay.mcap.summary import summary
from replay.mcap.texts import one_line

# Arrays of equal numbers compress to next to nothing, whole recordings do not.
LIMITS = Limits(2**24, ratio=100, largest=2**62, checked=True, attachments=(MESH, SDF_GRID))
UNFINISHED = "unfinished"
ACCEPTED = "accepted: a recording.mcap that this project wrote"
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

    names: the full name of the message on every topic that matters.
    """

    def __init__(self, names: Mapping[str, str]) -> None:
        self._names = names
        self._schemas: dict[int, Schema] = {}  # by id
        self._channels: dict[int, Channel] = {}  # by id

    def describe(self, part: Schema | Channel) -> None:
        """Take note of a schema or channel; ValueError if it is not as this project writes it."""
        if isinstance(part, Schema):
            if self._schemas.setdefault(part.id, part) != part:
                raise ValueError(f"schema {part.id} is described twice, and not the same")
            return
        schema = self._schemas.get(part.schema_id)
        name = None if schema is None else schema.name
        if self._names.get(part.topic, name) != name:
            raise ValueError(f"topic {part.topic} carries {name}")
        if self._channels.setdefault(part.id, part) != part:
            raise ValueError(f"channel {part.id} is described twice, and not the same")

    def messages(
        self, chunk: bytes, chain: Chain | None = None
    ) -> Iterator[tuple[Message, StoredMessage]]:
        """Messages in a chunk; any of MALFORMED if one is not as this project writes it.

        chain: gets the schemas and channels.
        """
        for opcode, start, end in parts(chunk):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                part: Schema | Channel = parsed(opcode, chunk[start:end])
                self.describe(part)
                if chain is not None:
                    chain.describe(part)
            elif opcode == Opcode.MESSAGE:
                found = message(chunk[start:end])
                channel = self._channels.get(found.channel_id)
                if channel is None:
                    raise ValueError(f"channel {found.channel_id} does not exist")
                yield found, StoredMessage(channel.topic, found.log_time, found.data)

    def matters(self, message: StoredMessage) -> bool:
        """Whether the topic of a message is one of those named."""
        return message.topic in self._names


class McapFile:
    """Reads one file from start to end, checking every checksum on the way."""

    def __init__(
        self,
        path: Path,
        names: Mapping[str, str],
        *,
        partial: bool = False,
        check_seals: bool = True,
    ) -> None:
        """names: the full name of the message on every topic that matters; others are skipped.

        partial: take what is whole from an unfinished or damaged file, up to the first damage.
        check_seals: whether what was changed since it was written counts as damage.
        """
        self.path = path
        self.attachments: dict[str, bytes] = {}  # by name, those met so far
        self.chain = Chain()  # of the seals of the file
        self.damage: str | None = None  # what ended a partial reading
        self._topics = Topics(names)
        self._partial = partial
        self._check_seals = check_seals
        self._count = 0  # messages met so far
        self._most_messages = _PLAUSIBLE_MESSAGES
        self._data_ended = False

    def messages(self) -> Iterator[StoredMessage]:
        """All messages in the order of writing. Raises RecordingError if the file is not valid."""
        with opened(self.path) as file:
            self._check_kind(file)
            records = Records(file, LIMITS)
            self._most_messages = _PLAUSIBLE_MESSAGES + records.size // _LEAST_BYTES
            for record in records.up_to_damage():
                if isinstance(record, Damage):
                    return self._stop_at(f"damaged before byte {record.end}: {record.reason}")
                try:
                    found = self._take(record)
                except MALFORMED as error:
                    where = f"damaged before byte {record.end}"
                    return self._stop_at(f"{where}: {reason_of(error)}")
                yield from found
            try:
                self._check_summary(file)
            except MALFORMED as error:
                return self._stop_at(f"damaged: in its summary, {reason_of(error)}")
        if self.chain.session and self.chain.is_open:
            self._stop_at("damaged: records follow its last seal")

    def _check_kind(self, file: IO[bytes]) -> None:
        if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise RecordingError(f"recording {self.path} is no MCAP file; {ACCEPTED}")
        size = file.seek(0, 2)
        file.seek(max(0, size - len(MCAP0_MAGIC)))
        if size < 2 * len(MCAP0_MAGIC) or file.read() != MCAP0_MAGIC:
            self._stop_at(UNFINISHED)

    def _take(self, record: Record) -> list[StoredMessage]:
        """The messages in a record that matter; any of MALFORMED if it is not as was written."""
        opcode, content = record.opcode, record.content
        if opcode == Opcode.MESSAGE:
            raise ValueError("a message stands outside of a chunk")
        if self._data_ended and opcode in (Opcode.ATTACHMENT, Opcode.CHUNK):
            raise ValueError("data follow the end of its data")
        match opcode:
            case Opcode.HEADER if parsed(opcode, content).profile != PROFILE:
                raise RecordingError(f"recording {self.path} is another program's; {ACCEPTED}")
            case Opcode.ATTACHMENT:
                self._attach(parsed(opcode, content))
            case Opcode.CHUNK:
                return [stored for stored in self._chunk(content) if self._topics.matters(stored)]
            case Opcode.DATA_END:
                self._data_ended = True
            case Opcode.FOOTER if not self._data_ended:
                raise ValueError("the end of its data is missing")
        return []

    def _attach(self, attachment: Attachment) -> None:
        if attachment.name in self.attachments:
            raise ValueError(f"the attachment {attachment.name!r} stands in it twice")
        self.attachments[attachment.name] = attachment.data
        if self._check_seals:
            self.chain.attach(attachment)

    def _chunk(self, content: bytes) -> Iterator[StoredMessage]:
        """All messages of a chunk, their numbers and seals compared."""
        chain = self.chain if self._check_seals else None
        for found, stored in self._topics.messages(content, chain):
            if found.sequence != self._count:
                raise ValueError(f"message {self._count} is missing, {found.sequence} follows")
            self._count += 1
            if self._count > self._most_messages:
                raise ValueError(f"it holds more than {self._most_messages} messages")
            if chain is not None:
                chain.read(stored.topic, found)
            yield stored

    def _check_summary(self, file: IO[bytes]) -> None:
        """Raise ValueError unless the summary is whole and describes the same topics."""
        for part in summary(file, checked=True):
            if isinstance(part, Schema | Channel):
                self._topics.describe(part)

    def _stop_at(self, damage: str) -> None:
        """Keep the damage in mind, or raise it if all is wanted."""
        if not self._partial:
            raise DamagedRecordingError(self.path, f"is {one_line(damage)}")
        self.damage = self.damage or damage


@contextmanager
def opened(path: Path) -> Iterator[IO[bytes]]:
    """A recording, open for reading; RecordingError where that fails, also later on."""
    refuse_special_file(f"recording {path}", path, RecordingError)
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
