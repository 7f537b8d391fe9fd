"""A recording in progress: messages in compressed chunks, each ended by a seal."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Channel, Message, Schema
from mcap.writer import CompressionType, Writer

from chsel.errors import RecordingError
from replay.files import sync_folder
from replay.mcap.attachments import MEDIA_TYPES
from replay.mcap.encoding import descriptor_set, encode, message_class
from replay.mcap.foxglove_messages import FOXGLOVE
from replay.mcap.schemas import BEFORE_ALL_STEPS, PROFILE, RECORDS, SINCE_VERSION, STEP_TIME
from replay.mcap.seal import CONTENTS, SEAL, Chain

_CHUNK_SIZE = 8 * 2**20  # bytes: flushing ends a chunk after every probe, well before this
_NEVER = 2**62  # the size at which the library would end a chunk by itself, without a seal
_LIBRARY = "chsel-replay"  # without versions of packages, which stand in the session's environment


class SealedFile:
    """Writes messages to a new file, with a description of every topic of its format.

    All is done within `writing`. Raises RecordingError if the file exists or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.chain = Chain()
        self.closed = False
        self.step = BEFORE_ALL_STEPS  # of the last message
        self._count = 0  # messages written so far
        self._unflushed = 0  # bytes of messages in the chunk in progress
        self._channels: dict[str, int] = {}  # by topic
        with self.writing():
            self._file = path.open("xb")
            self._writer = Writer(
                self._file,
                chunk_size=_NEVER,
                compression=CompressionType.ZSTD,
                enable_crcs=True,
                enable_data_crcs=True,
            )
            self._writer.start(profile=PROFILE, library=_LIBRARY)

    def describe(self, version: int) -> None:
        """Describe all topics of a version of the format, used or not; before anything else."""
        topics: dict[str, Any] = {topic: message_class(name) for topic, name in RECORDS.items()}
        schemas: dict[str, int] = {}
        for topic, kind in {**topics, **FOXGLOVE}.items():
            if SINCE_VERSION.get(topic, 0) > version:
                continue
            name = kind.DESCRIPTOR.full_name
            if name not in schemas:
                schemas[name] = self._describe_schema(kind)
            number = self._writer.register_channel(topic, "protobuf", schemas[name])
            self._channels[topic] = number
            self.chain.describe(Channel(number, topic, "protobuf", {}, schemas[name]))
        self._describe_schema(message_class("SdfGrid"))  # the file describes its attachment too

    def attach(self, name: str, data: bytes) -> None:
        """Write an attachment."""
        self._writer.add_attachment(0, 0, name, MEDIA_TYPES[name], data)
        self.chain.attach(Attachment(0, 0, name, MEDIA_TYPES[name], data))

    def add(self, topic: str, step: int, make: Callable[[int], bytes]) -> None:
        """Write a message of a step; make: its bytes, from its log time."""
        channel, time = self._channels[topic], self._next_time(step)
        data = make(time)
        self._writer.add_message(channel, time, data, time, sequence=self._count)
        self.chain.write(topic, Message(channel, time, data, time, self._count))
        self._count += 1
        self.step = step
        self._unflushed += len(data)
        if self._unflushed > _CHUNK_SIZE and topic != CONTENTS:
            self.end_chunk()

    def seal(self) -> None:
        """Close the messages since the last seal, if there are any, with one of their own."""
        if self.chain.is_open and self._count > 0:
            values = self.chain.sealed(self.step, self._count, self._next_time(self.step))
            self.add(SEAL, self.step, lambda time: encode(RECORDS[SEAL], values))

    def end_chunk(self) -> None:
        """End the chunk in progress with a seal, and hand it to the operating system."""
        self._unflushed = 0
        self.seal()
        self._writer.flush()
        self._unflushed = 0

    def check_in_place(self) -> None:
        """Raise RecordingError if nobody will find what is written: the file has no name left."""
        if os.fstat(self._file.fileno()).st_nlink == 0:
            self._abandon()
            raise RecordingError(f"recording {self.path} was removed while it was written")

    def finish(self) -> None:
        """Write index and checksums, and wait until all is on the disk."""
        self._writer.finish()
        self._file.flush()
        self.check_in_place()
        os.fsync(self._file.fileno())
        self._file.close()
        self.closed = True
        sync_folder(self.path.parent)

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Turn errors of the disk into one RecordingError; leave the file alone after any break."""
        try:
            yield
        except OSError as error:
            self._abandon()
            reason = error.strerror or str(error)
            raise RecordingError(f"recording {self.path} cannot be written: {reason}") from error
        except KeyboardInterrupt:
            self._abandon()  # it may have come within a record
            raise

    def _abandon(self) -> None:
        """Close the file as it stands: unfinished, whole up to the last flush."""
        self.closed = True
        if hasattr(self, "_file"):
            with suppress(OSError):
                self._file.close()

    def _next_time(self, step: int) -> int:
        """Log time of the next message."""
        return (step - BEFORE_ALL_STEPS) * STEP_TIME + self._count

    def _describe_schema(self, kind: Any) -> int:
        name, described = kind.DESCRIPTOR.full_name, descriptor_set(kind)
        number: int = self._writer.register_schema(name, "protobuf", described)
        self.chain.describe(Schema(id=number, data=described, encoding="protobuf", name=name))
        return number
