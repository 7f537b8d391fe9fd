"""The messages of a damaged recording, with the gaps between them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Channel, Message, Schema

from chsel.errors import RecordingError
from replay.mcap.file import StoredMessage, Topics
from replay.mcap.seal import MIXED, Chain
from replay.mcap.texts import one_line
from replay.mcap.whole_records import Damage, WholeRecord, WholeRecords


@dataclass(frozen=True)
class Gap:
    """So many messages are missing between the one before and the one that follows."""

    messages: int


class Salvage:
    """Reads all messages of one file that are in whole chunks, and that its seals tie together.

    schemas: the full name of the message on every topic that matters; others are skipped.
    attachments: by name, those met so far. Raises RecordingError if the file cannot be read.
    """

    def __init__(self, path: Path, schemas: Mapping[str, str]) -> None:
        self.path = path
        self.attachments: dict[str, bytes] = {}
        self._damages: list[Damage] = []
        self._records: WholeRecords | None = None
        self._topics = Topics(schemas)
        self._chain = Chain(forgiving=True)
        self._count = 0  # messages met or missed so far
        self._whole_until = 0  # the end of the last chunk with messages

    @property
    def damages(self) -> list[Damage]:
        """All damage of the file met so far, in its order."""
        found = self._damages + (self._records.damages if self._records else [])
        return sorted(found, key=lambda damage: damage.start)

    @property
    def rest(self) -> Damage | None:
        """The damage behind the last whole message, if there is any."""
        return next((d for d in self.damages if d.start >= self._whole_until), None)

    def messages(self) -> Iterator[StoredMessage | Gap]:
        """All whole messages in the order of writing, and where others are missing."""
        try:
            with self.path.open("rb") as file:
                size = file.seek(0, 2)
                self._records = WholeRecords(file, size)
                for record in self._records:
                    if self._is_of_another(record):
                        reason = "another recording goes on here"
                        self._damages.append(Damage(record.start, size, reason))
                        break
                    yield from self._take(record)
        except OSError as error:
            reason = error.strerror or str(error)
            raise RecordingError(f"recording {self.path} cannot be read: {reason}") from error

    def _is_of_another(self, record: WholeRecord) -> bool:
        """Whether a record is one that a recording has once, at its beginning."""
        if isinstance(record.content, Attachment):
            return self._count > 0 or record.content.name in self.attachments
        return self._count > 0 and _sequences(record.content)[:1] == [0]

    def _take(self, record: WholeRecord) -> list[StoredMessage | Gap]:
        if isinstance(record.content, Attachment):
            self.attachments[record.content.name] = record.content.data
            self._chain.attach(record.content)
            return []
        try:
            messages = self._messages(record.content)
        except ValueError as error:
            self._damages.append(Damage(record.start, record.end, one_line(str(error))))
            return []
        for name in self._chain.lost:
            self.attachments.pop(name, None)
        self._whole_until = record.end
        return messages

    def _messages(self, parts: list[Any]) -> list[StoredMessage | Gap]:
        """The messages of a chunk; ValueError if they cannot be where they are."""
        sequences = _sequences(parts)
        first = sequences[0] if sequences else self._count
        if sequences != list(range(first, first + len(sequences))):
            raise ValueError("the messages of a chunk are not in order")
        if first < self._count:
            raise ValueError("the messages of a chunk were there before")
        stored = self._sealed(parts, after_gap=first > self._count)
        gap = [Gap(first - self._count)] if first > self._count else []
        self._count = first + len(sequences)
        return [*gap, *(message for message in stored if self._topics.matters(message))]

    def _sealed(self, parts: list[Any], *, after_gap: bool) -> list[StoredMessage]:
        """The messages of a chunk; ValueError if they are not those of the session.

        Every chunk ends with a seal, but in files of older formats, which have none.
        """
        if after_gap:
            self._chain.skip()
        stored = []
        for part in parts:
            if isinstance(part, Schema | Channel):
                self._topics.describe(part)
                self._chain.describe(part)
            elif isinstance(part, Message):
                stored.append(self._topics.stored(part))
                self._chain.read(stored[-1].topic, part)
        if self._chain.session and self._chain.is_open:
            raise ValueError(f"the chunk has no seal of this recording: {MIXED}")
        return stored


def _sequences(parts: list[Any]) -> list[int]:
    return [part.sequence for part in parts if isinstance(part, Message)]
