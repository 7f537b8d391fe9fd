"""Values to the bytes of a message and back, checked against the table of messages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from chsel.errors import RecordingError
from replay.mcap.schemas import PACKAGE, Kind, field_kinds, message_class
from replay.mcap.wire import check_wire

_NARROW = np.dtype("<f4")
_LONGEST = 2**40  # of an array's side: what is beyond overflows numpy before it can be checked


def encode(name: str, values: Mapping[str, Any]) -> bytes:
    """The bytes of a message, from a value for each of its fields.

    Raises RecordingError if a value does not have the type or shape that the table gives.
    """
    message = message_class(name)()
    _fill(message, name, values)
    return message.SerializeToString(deterministic=True)


def decode(name: str, data: bytes) -> dict[str, Any]:
    """The values of a message's fields; arrays are read-only, absent fields are None.

    Raises RecordingError if the bytes are no such message or an array is not as the table says.
    """
    message = message_class(name)()
    check_wire(message.DESCRIPTOR, data)
    try:
        message.ParseFromString(data)
    except DecodeError:
        raise RecordingError(f"a message is no valid {PACKAGE}.{name}") from None
    return _values(message, name)


def _fill(message: Any, name: str, values: Mapping[str, Any]) -> None:
    lengths: dict[str, int] = {}
    for field, kind in field_kinds(name).items():
        value = values[field]
        if value is None and kind.optional:
            continue
        try:
            _set(message, field, kind, value, lengths)
        except (TypeError, ValueError) as error:
            raise RecordingError(f"{name}.{field} cannot be recorded: {error}") from None


def _set(message: Any, field: str, kind: Kind, value: Any, lengths: dict[str, int]) -> None:
    if kind.dtype is not None:
        value = np.asarray(value)
        _check_array(kind, value.dtype, value.shape, lengths)
        target = getattr(message, field)
        stored = value.astype(kind.dtype, copy=False)
        if kind.narrow and (stored.astype(_NARROW).astype(kind.dtype) == stored).all():
            stored = stored.astype(_NARROW)
        target.dtype = stored.dtype.str
        target.shape.extend(value.shape)
        target.data = stored.tobytes()
    elif kind.is_message and kind.repeated:
        for item in value:
            _fill(getattr(message, field).add(), kind.type, item)
    elif kind.is_message:
        getattr(message, field).SetInParent()
        _fill(getattr(message, field), kind.type, value)
    elif kind.repeated:
        getattr(message, field).extend(value)
    else:
        setattr(message, field, value)


def _values(message: Any, name: str) -> dict[str, Any]:
    lengths: dict[str, int] = {}
    return {
        field: _get(message, f"{name}.{field}", field, kind, lengths)
        for field, kind in field_kinds(name).items()
    }


def _get(message: Any, where: str, field: str, kind: Kind, lengths: dict[str, int]) -> Any:
    if kind.repeated:
        items = getattr(message, field)
        return (
            tuple(_values(item, kind.type) for item in items) if kind.is_message else tuple(items)
        )
    if not kind.is_message:
        return getattr(message, field)
    if not message.HasField(field):
        if kind.optional:
            return None
        raise RecordingError(f"{where} is missing")
    value = getattr(message, field)
    return _values(value, kind.type) if kind.dtype is None else _array(where, kind, value, lengths)


def _array(where: str, kind: Kind, message: Any, lengths: dict[str, int]) -> np.ndarray:
    """The array in an Array message, in the machine's byte order; read-only."""
    wide, data = kind.dtype, message.data
    assert wide is not None
    shape = tuple(message.shape[: len(kind.shape) + 1])  # not all of a list of millions
    dtype = _NARROW if kind.narrow and message.dtype == _NARROW.str else wide
    if message.dtype != dtype.str:
        raise RecordingError(f"{where} is of type {message.dtype!r}; accepted: {dtype.str!r}")
    try:
        _check_array(kind, wide, shape, lengths)
    except ValueError as error:
        raise RecordingError(f"{where}: {error}") from None
    if max(shape) > _LONGEST or len(data) != math.prod(shape) * dtype.itemsize:
        raise RecordingError(f"{where} has {len(data)} bytes, which do not fill its shape {shape}")
    if dtype.kind == "b" and data.strip(b"\0\1"):
        raise RecordingError(f"{where} holds bytes other than 0 and 1")
    array = np.frombuffer(data, dtype).reshape(shape)
    array = array.astype(wide.newbyteorder("="), copy=False)
    array.setflags(write=False)
    return array


def _check_array(
    kind: Kind, dtype: np.dtype[Any], shape: tuple[int, ...], lengths: dict[str, int]
) -> None:
    """Raise ValueError unless type and shape are right; keeps the lengths of letters."""
    assert kind.dtype is not None
    fits = dtype.newbyteorder("<") == kind.dtype and len(shape) == len(kind.shape)
    for wanted, length in zip(kind.shape, shape, strict=False):
        known = int(wanted) if wanted.isdigit() else lengths.setdefault(wanted, length)
        fits = fits and known == length
    if not fits:
        wanted = ", ".join(str(lengths.get(letter, letter)) for letter in kind.shape)
        raise ValueError(f"it is {dtype} {shape}; accepted: {kind.dtype} ({wanted})")
