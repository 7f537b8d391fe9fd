"""The summary at the end of a finished MCAP file."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import IO, Any

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from replay.mcap.record_bytes import HEAD, parsed, parts

FOOTER = struct.Struct("<BQQQI")  # opcode, length, summary start, offsets' start, checksum
_CRC_SIZE = 4
_LARGEST = 2**28  # bytes
_KINDS = frozenset(
    {
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.STATISTICS,
        Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT_INDEX,
    }
)


def summary(file: IO[bytes], *, checked: bool) -> Iterator[Any]:
    """Its records that matter, of mcap's types, one at a time; none if a file has no summary.

    checked: whether it has to have a checksum. Raises any of MALFORMED if it is not whole.
    """
    size, end = file.seek(0, 2), FOOTER.size + len(MCAP0_MAGIC)
    file.seek(max(0, size - end))
    footer = file.read(end)
    if len(footer) != end or footer[FOOTER.size :] != MCAP0_MAGIC:
        raise ValueError("it was never finished, or it is cut")
    opcode, length, start, _, checksum = FOOTER.unpack_from(footer)
    if opcode != Opcode.FOOTER or length != FOOTER.size - HEAD.size:
        raise ValueError("its end is damaged")
    if start == 0 and not checked:
        return
    if not 0 < start <= size - end or size - end - start > _LARGEST:
        raise ValueError("it does not start where the end says")
    file.seek(start)
    data = file.read(size - end - start)
    whole = zlib.crc32(footer[: FOOTER.size - _CRC_SIZE], zlib.crc32(data))
    if (checksum or checked) and whole != checksum:
        raise ValueError("its checksum is wrong")
    for opcode, first, last in parts(data):
        if opcode in _KINDS:
            yield parsed(opcode, data[first:last])
