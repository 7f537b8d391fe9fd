"""The bytes of protobuf messages: what is in them, counted before anything is made of it.

Two bytes can make an empty message or a number in a list that takes fifty in memory, so that a
large message of such would take far more memory than the file has bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from google.protobuf.message import DecodeError

from chsel.errors import RecordingError

SMALL = 2**20  # bytes of a message that cannot do harm
MOST_FIELDS = 10_000
_LONGEST_LIST = 2**12  # bytes of a list of numbers
_DEEPEST = 8
_VARINT, _FIXED_64, _LENGTH, _FIXED_32 = 0, 1, 2, 5


def parsed(kind: Any, data: bytes) -> Any:
    """The message of a protobuf class in bytes; RecordingError if they are no such message."""
    check_wire(kind.DESCRIPTOR, data)
    try:
        return kind.FromString(data)
    except DecodeError:
        raise RecordingError(f"a message is not a valid {kind.DESCRIPTOR.full_name}") from None


def length_prefix(field: int, parts: Sequence[bytes]) -> bytes:
    """What stands before a message in a field, given its number and all bytes of the message."""
    prefix = bytearray()
    for value in (field << 3 | _LENGTH, sum(map(len, parts))):
        while value > 0x7F:
            prefix.append(value & 0x7F | 0x80)
            value >>= 7
        prefix.append(value)
    return bytes(prefix)


def check_wire(descriptor: Any, data: bytes) -> None:
    """Raise RecordingError if a large message has more fields than any that is recorded."""
    if len(data) > SMALL:
        _Count(descriptor.full_name).take(descriptor, memoryview(data), 0)


class _Count:
    """Counts the fields of a message and of those within it."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._fields = 0

    def take(self, descriptor: Any, data: memoryview, depth: int) -> None:
        """Go through one message."""
        place = 0
        while place < len(data):
            self._fields += 1
            if self._fields > MOST_FIELDS or depth > _DEEPEST:
                raise RecordingError(f"a message {self._name} has more fields than any recorded")
            tag, place = self._varint(data, place)
            kind = tag & 7
            if kind == _LENGTH:
                length, place = self._varint(data, place)
                field = descriptor.fields_by_number.get(tag >> 3)
                self._look_into(field, data[place : place + length], depth)
                place += length
            elif kind == _VARINT:
                _, place = self._varint(data, place)
            elif kind in (_FIXED_64, _FIXED_32):
                place += 8 if kind == _FIXED_64 else 4
            else:
                raise self._invalid()
        if place != len(data):
            raise self._invalid()

    def _look_into(self, field: Any, data: memoryview, depth: int) -> None:
        if field is None or field.type in (field.TYPE_BYTES, field.TYPE_STRING):
            return
        if field.message_type is not None:
            self.take(field.message_type, data, depth + 1)
        elif len(data) > _LONGEST_LIST:
            raise RecordingError(f"a message {self._name} has a list of {len(data)} bytes")

    def _varint(self, data: memoryview, place: int) -> tuple[int, int]:
        """A number and the place after it."""
        value = shift = 0
        while place < len(data) and shift < 70:
            byte = data[place]
            value |= (byte & 0x7F) << shift
            shift, place = shift + 7, place + 1
            if byte < 0x80:
                return value, place
        raise self._invalid()

    def _invalid(self) -> RecordingError:
        return RecordingError(f"a message is not a valid {self._name}")
