"""Makes the seals of a changed recording again, as whoever knows the format could."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Message, Schema

from chsel.errors import ChselError
from replay.mcap.encoding import decode, encode
from replay.mcap.record_bytes import MALFORMED
from replay.mcap.schemas import STEP_TIME
from replay.mcap.seal import CONTENTS, SEAL, Chain
from tests.tools.mutations import Record, file_of, joined, packed, split, unpacked

_HEAD = struct.Struct("<HIQQ")  # of a message: channel, sequence, log time, publish time
_MALFORMED = (*MALFORMED, ChselError, KeyError)


def reseal_file(path: Path) -> Path:
    """Change the file so that its seals, contents and checksums are right."""
    path.write_bytes(file_of(resealed(split(path.read_bytes()[8:-8]))))
    return path


def resealed(everything: Sequence[Record]) -> list[Record]:
    """The records with other seals and contents; what is malformed is left as it is."""
    chain, topics, made = Chain(), {}, []
    for opcode, content in everything:
        try:
            if opcode == Opcode.ATTACHMENT:
                chain.attach(_parsed(Attachment, content))
            elif opcode == Opcode.CHUNK:
                inside = [_sealed(chain, topics, *part) for part in split(unpacked(content))]
                content = packed(joined(inside))
        except _MALFORMED:
            chain.skip()
        made.append((opcode, content))
    return made


def _sealed(chain: Chain, topics: dict[int, str], opcode: int, content: bytes) -> Record:
    """A record of a chunk, if it is a seal or the contents with other values."""
    if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
        part: Any = _parsed(Schema if opcode == Opcode.SCHEMA else Channel, content)
        chain.describe(part)
        if isinstance(part, Channel):
            topics[part.id] = part.topic
    elif opcode == Opcode.MESSAGE:
        number, sequence, log_time, publish_time = _HEAD.unpack_from(content)
        topic, data = topics[number], content[_HEAD.size :]
        if topic == SEAL:
            values = chain.sealed(decode("Seal", data)["step"], sequence, log_time)
            data = encode("Seal", values)
        elif topic == CONTENTS:
            ends = {"session": chain.session, "digest": chain.last}
            data = encode("Contents", decode("Contents", data) | ends)
            log_time = log_time // STEP_TIME * STEP_TIME + sequence
            content = _HEAD.pack(number, sequence, log_time, log_time)
        else:
            chain.write(topic, Message(number, log_time, data, publish_time, sequence))
        content = content[: _HEAD.size] + data
    return opcode, content


def _parsed(kind: Any, content: bytes) -> Any:
    return kind.read(ReadDataStream(BytesIO(content)))
