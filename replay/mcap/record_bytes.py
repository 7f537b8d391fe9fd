"""What is in the bytes of an MCAP record, taken apart without believing a length in it.

The types of the `mcap` package read the fields. Its readers of chunks and streams are not used, see
`replay/mcap/records.py`.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from replay.mcap.texts import one_line

MALFORMED = (
    McapError,
    ValueError,
    struct.error,
    zstandard.ZstdError,
    RuntimeError,  # how lz4 says that a frame is broken
    EOFError,
    OverflowError,
    MemoryError,
)
"""What reading records may raise."""

HEAD = struct.Struct("<BQ")  # of every record: opcode, length of what follows
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK_INDEX = struct.Struct("<QQQQI")  # times, start, length, size of the entries
_ENTRY = struct.Struct("<HQ")  # channel, and where its messages are listed
_TYPES: dict[int, Any] = {
    Opcode.HEADER: records.Header,
    Opcode.FOOTER: records.Footer,
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.CHUNK: records.Chunk,
    Opcode.ATTACHMENT: records.Attachment,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex,
    Opcode.STATISTICS: records.Statistics,
}


class ChunkIndex(NamedTuple):
    """Where a chunk is, and the times and channels of its messages."""

    first: int  # log time, nanoseconds
    last: int
    start: int  # in the file, bytes
    length: int  # of the whole record
    channels: frozenset[int]  # by id; none if they are not known


def parsed(opcode: int, body: bytes) -> Any:
    """A record of mcap's type; any of MALFORMED if its fields do not fit into its bytes.

    That of a chunk in an index is our own: mcap reads those of a large log six times as slowly.
    """
    if opcode == Opcode.CHUNK_INDEX:
        first, last, start, length, size = _CHUNK_INDEX.unpack_from(body)
        entries = _ENTRY.iter_unpack(body[_CHUNK_INDEX.size :][:size])
        return ChunkIndex(first, last, start, length, frozenset(number for number, _ in entries))
    return _TYPES[opcode].read(ReadDataStream(_Exact(body)))  # type: ignore[arg-type]


def message(body: bytes) -> records.Message:
    """A message; ValueError if it is too short."""
    if len(body) < MESSAGE_HEAD.size:
        raise ValueError(f"a message has {len(body)} bytes; accepted: at least {MESSAGE_HEAD.size}")
    channel, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(body)
    content = body[MESSAGE_HEAD.size :]
    return records.Message(channel, log_time, content, publish_time, sequence)


def parts(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of the content of each record in a chunk or a summary.

    Raises ValueError where one does not fit.
    """
    place = 0
    while place < len(data):
        if place + HEAD.size > len(data):
            raise ValueError("a chunk ends within a record")
        opcode, length = HEAD.unpack_from(data, place)
        start = place + HEAD.size
        place = start + length
        if place > len(data):
            raise ValueError(f"a record of {length} bytes does not fit into its chunk")
        yield opcode, start, place


def unpacked(chunk: records.Chunk, most: int, *, checked: bool) -> bytes:
    """The records in a chunk, its checksum compared; any of MALFORMED if it is not whole.

    most: bytes that it may have. checked: whether it has to have a checksum.
    """
    size, checksum = chunk.uncompressed_size, chunk.uncompressed_crc
    if size > most:
        raise ValueError(f"a chunk claims {size} bytes, unpacked")
    data = _decompressed(chunk.compression, chunk.data, size)
    if len(data) != size:
        raise ValueError(f"a chunk has {len(data)} bytes, unpacked, and claims {size}")
    if (checksum or checked) and zlib.crc32(data) != checksum:
        raise ValueError("the checksum of a chunk is wrong")
    return data


def reason_of(error: BaseException) -> str:
    """What an error says of a file, on one line; struct's speaks of our program instead."""
    if isinstance(error, struct.error):
        return "a record is cut short"
    return one_line(str(error)) or f"a record is broken ({type(error).__name__})"


def _decompressed(compression: str, packed: bytes, size: int) -> bytes:
    """What is in a chunk; never much more than the size that it claims."""
    if compression == "":
        return packed
    if compression == "zstd":
        if zstandard.frame_content_size(packed) > size:
            raise ValueError("a chunk is larger than it claims")
        return zstandard.ZstdDecompressor().decompress(packed, max_output_size=max(size, 1))
    if compression == "lz4":
        data: bytes = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
        return data
    raise ValueError(f"a chunk is compressed by {compression[:20]!r}; accepted: zstd, lz4")


class _Exact:
    """Bytes of which no more can be read than there are."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._place = 0

    def read(self, length: int) -> bytes:
        if length > len(self._data) - self._place:
            raise ValueError(f"{length} bytes do not fit into their record")
        self._place += length
        return self._data[self._place - length : self._place]
