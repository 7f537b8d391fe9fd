"""What is in a chunk, taken apart without believing a single length."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema

DAMAGE = (
    McapError,
    ValueError,
    struct.error,
    zstandard.ZstdError,
    OverflowError,
    MemoryError,
)
"""What reading a damaged file may raise."""

_PLAUSIBLE_SIZE = 16 * 2**20
_PLAUSIBLE_RATIO = 100
_HEAD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


def plausible_size(file_size: int) -> int:
    """Bytes that all chunks of a file of some size may hold, unpacked.

    Arrays of equal numbers compress to next to nothing, whole recordings do not.
    """
    return _PLAUSIBLE_SIZE + _PLAUSIBLE_RATIO * file_size


def check_size(chunk: Chunk, limit: int) -> None:
    """Raise ValueError unless a chunk says truly how large it is, and that is within the limit."""
    if chunk.compression not in ("", "zstd"):
        raise ValueError(f"a chunk is compressed by {chunk.compression!r}; accepted: zstd")
    size = len(chunk.data)
    if chunk.compression:
        size = zstandard.frame_content_size(chunk.data)
    if size != chunk.uncompressed_size or size > limit:
        raise ValueError(f"a chunk claims {chunk.uncompressed_size} bytes")


def chunk_records(chunk: Chunk) -> Iterator[Schema | Channel | Message]:
    """Schemas, channels and messages of a chunk; other records are passed by.

    Raises ValueError, ZstdError or McapError if its checksum or a length within it is wrong. How
    large it may become is the caller's to check.
    """
    data = chunk.data
    if chunk.compression:
        data = zstandard.decompress(data, chunk.uncompressed_size)
    if zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("crc validation failed in Chunk")
    place = 0
    while place < len(data):
        if len(data) - place < _HEAD.size:
            raise ValueError("a chunk ends within a record")
        opcode, length = _HEAD.unpack_from(data, place)
        place += _HEAD.size
        if length > len(data) - place:
            raise ValueError(f"a record of {length} bytes does not fit into its chunk")
        if opcode == Opcode.MESSAGE:
            yield _message(data, place, length)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            stream = ReadDataStream(_Exact(data[place : place + length]))  # type: ignore[arg-type]
            yield (Schema if opcode == Opcode.SCHEMA else Channel).read(stream)
        place += length


def _message(data: bytes, place: int, length: int) -> Message:
    if length < _MESSAGE.size:
        raise ValueError(f"a message has {length} bytes; accepted: at least {_MESSAGE.size}")
    channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, place)
    content = data[place + _MESSAGE.size : place + length]
    return Message(channel, log_time, content, publish_time, sequence)


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
