"""Chunks of MCAP files of any writer, unpacked within bounds and taken apart."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

import lz4.frame  # type: ignore[import-untyped]
import zstandard

LARGEST_CHUNK = 2**29  # bytes; writers make them of some megabytes, or of one large message
UNPACKING_ERRORS = (
    ValueError,
    struct.error,
    zstandard.ZstdError,
    RuntimeError,  # how lz4 says that a frame is broken
    EOFError,
    OverflowError,
    MemoryError,
)
_CHUNK = struct.Struct("<QQQII")  # first and last time, size, checksum, length of a name
_SIZE = struct.Struct("<Q")
_RECORD = struct.Struct("<BQ")  # opcode, length


def unpacked(body: bytes, allowance: int) -> bytes:
    """The records in a chunk's body. Raises one of UNPACKING_ERRORS if it is damaged.

    allowance: bytes that it may have. A checksum of 0 says that there is none.
    """
    _, _, size, checksum, name_length = _CHUNK.unpack_from(body)
    place = _CHUNK.size + name_length
    compression = bytes(body[_CHUNK.size : place])
    (length,) = _SIZE.unpack_from(body, place)
    packed = memoryview(body)[place + _SIZE.size :]
    if length != len(packed):
        raise ValueError(f"a chunk of {len(packed)} bytes claims {length}")
    if size > min(allowance, LARGEST_CHUNK):
        raise ValueError(f"a chunk claims {size} bytes, unpacked")
    data = _decompressed(compression, packed, size)
    if len(data) != size:
        raise ValueError(f"a chunk has {len(data)} bytes, unpacked, and claims {size}")
    if checksum and zlib.crc32(data) != checksum:
        raise ValueError("the checksum of a chunk is wrong")
    return data


def _decompressed(compression: bytes, packed: memoryview, size: int) -> bytes:
    if compression == b"":
        return bytes(packed)
    if compression == b"zstd":
        if zstandard.frame_content_size(packed) > size:
            raise ValueError("a chunk is larger than it claims")
        return zstandard.ZstdDecompressor().decompress(packed, max_output_size=max(size, 1))
    if compression == b"lz4":
        return lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    raise ValueError(f"a chunk is compressed by {compression[:20]!r}; accepted: zstd, lz4")


def records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of each record in a chunk; ValueError where one does not fit."""
    place = 0
    while place < len(data):
        if place + _RECORD.size > len(data):
            raise ValueError("a chunk ends within a record")
        opcode, length = _RECORD.unpack_from(data, place)
        start = place + _RECORD.size
        place = start + length
        if place > len(data):
            raise ValueError("a record does not fit into its chunk")
        yield opcode, start, place
