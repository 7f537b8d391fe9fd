"""Values to the bytes of a message and back, as the table of messages says."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError, Message

from chsel.errors import RecordingError
from replay.mcap.schemas import MESSAGES, PACKAGE, TOGETHER
from replay.mcap.validation import Check

_ARRAY = re.compile(r"([fib]\d)(~?)\[(.*)\]")
_NARROW = np.dtype("<f4")
_LONGEST = 2**40  # of an array's side: what is beyond overflows numpy before it can be checked
_NAMED = {"Number", "Text"}  # messages that repeat as a mapping from names to values


@dataclass(frozen=True)
class Kind:
    """One field of the table, taken apart."""

    type: str
    """A protobuf scalar, or the name of a message."""
    repeated: bool
    optional: bool
    checks: tuple[Check, ...]
    dtype: np.dtype[Any] | None
    """Type of the entries of an array; None for all else."""
    shape: tuple[str, ...]
    """Lengths of an array: numbers, or letters."""
    narrow: bool
    """Whether an array is stored in 32 bits where that is exact."""

    @property
    def is_message(self) -> bool:
        return self.type in MESSAGES

    @property
    def is_mapping(self) -> bool:
        return self.repeated and self.type in _NAMED


@cache
def field_kinds(name: str) -> dict[str, Kind]:
    """Return the fields of a message, taken apart."""
    kinds = {}
    for field, entry in MESSAGES[name].items():
        text, *checks = (entry,) if isinstance(entry, str) else entry
        assert isinstance(text, str)
        bare = text.rstrip("?*")
        array = _ARRAY.fullmatch(bare)
        kinds[field] = Kind(
            type="Array" if array else bare,
            repeated=text.endswith("*"),
            optional=text.endswith("?"),
            checks=tuple(check for check in checks if not isinstance(check, str)),
            dtype=np.dtype(f"<{array[1]}") if array else None,
            shape=tuple(array[3].split(",")) if array else (),
            narrow=bool(array and array[2]),
        )
    return kinds


def shared_values(message: str, source: object) -> dict[str, Any]:
    """Return the fields of a message that a value has as attributes."""
    return {name: getattr(source, name) for name in MESSAGES[message] if hasattr(source, name)}


def shared_arguments(kind: type, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a dataclass that a message has, too."""
    return {field.name: values[field.name] for field in fields(kind) if field.name in values}


def check_message(name: str, values: Mapping[str, Any]) -> None:
    """Raise RecordingError unless the values of a message are as the table accepts them."""
    try:
        _check_fields(name, values)
    except (RecordingError, ValueError, IndexError, TypeError) as error:
        text = str(error)
        if not isinstance(error, RecordingError):  # of arrays that do not fit together
            text = f"it has a value of another shape or type: {error}"
        where = f"{name} of step {values['step']}" if "step" in values else name
        raise RecordingError(f"{where}: {text}") from None


def encode(name: str, values: Mapping[str, Any]) -> bytes:
    """Return the bytes of a message, from a value for each of its fields.

    Raise RecordingError if a value does not have the type or shape that the table gives.
    """
    message: Any = message_class(name)()
    _fill(message, name, values=values)
    data: bytes = message.SerializeToString(deterministic=True)
    return data


def decode(name: str, data: bytes) -> dict[str, Any]:
    """Return the values of a message's fields; arrays are read-only, absent fields are None.

    Raise RecordingError if the bytes are no such message or an array is not as the table says.
    """
    return _values(parsed(message_class(name), data), name)


def parsed(kind: Any, data: bytes) -> Any:
    """Return the message of a protobuf class; raise RecordingError if the bytes are none."""
    try:
        return kind.FromString(data)
    except DecodeError:
        raise RecordingError(f"a message is not a valid {kind.DESCRIPTOR.full_name}") from None


@cache
def message_class(name: str) -> type[Message]:
    """Return the protobuf class of a message of the table."""
    return message_factory.GetMessageClass(_pool().FindMessageTypeByName(f"{PACKAGE}.{name}"))


def descriptor_set(message: type[Message]) -> bytes:
    """Return a FileDescriptorSet: all that a reader needs to decode a message."""
    files: dict[str, Any] = {}

    def visit(file: Any) -> None:
        for dependency in file.dependencies:
            visit(dependency)
        files.setdefault(file.name, file)

    visit(message.DESCRIPTOR.file)
    collected = descriptor_pb2.FileDescriptorSet()
    for file in files.values():
        file.CopyToProto(collected.file.add())
    return collected.SerializeToString(deterministic=True)


def _check_fields(name: str, values: Mapping[str, Any]) -> None:
    for field, kind in field_kinds(name).items():
        value = values[field]
        if value is None and kind.optional:
            continue
        for check in kind.checks:
            check(field, value)
        if kind.is_message and kind.dtype is None and not kind.repeated:
            _check_fields(kind.type, value)
    if name in TOGETHER:
        TOGETHER[name](values)


def _fill(message: Any, name: str, *, values: Mapping[str, Any]) -> None:
    lengths: dict[str, int] = {}
    for field, kind in field_kinds(name).items():
        value = values[field]
        if value is None and kind.optional:
            continue
        try:
            _set(message, field, kind=kind, value=value, lengths=lengths)
        except (TypeError, ValueError) as error:
            raise RecordingError(f"{name}.{field} cannot be recorded: {error}") from None


def _set(message: Any, field: str, *, kind: Kind, value: Any, lengths: dict[str, int]) -> None:
    if kind.dtype is not None:
        _set_array(getattr(message, field), kind, value=np.asarray(value), lengths=lengths)
    elif kind.is_mapping:
        for key, item in value.items():
            getattr(message, field).add(name=key, value=item)
    elif kind.is_message:
        getattr(message, field).SetInParent()
        _fill(getattr(message, field), kind.type, values=value)
    elif kind.repeated:
        getattr(message, field).extend(value)
    else:
        setattr(message, field, value)


def _set_array(target: Any, kind: Kind, *, value: np.ndarray, lengths: dict[str, int]) -> None:
    _check_array(kind, value.dtype, shape=value.shape, lengths=lengths)
    stored = value.astype(kind.dtype, copy=False)
    if kind.narrow:
        with np.errstate(over="ignore"):
            narrow = stored.astype(_NARROW)
        stored = narrow if (narrow == stored).all() else stored
    target.dtype = stored.dtype.str
    target.shape.extend(value.shape)
    target.data = stored.tobytes()


def _values(message: Any, name: str) -> dict[str, Any]:
    lengths: dict[str, int] = {}
    return {
        field: _get(message, f"{name}.{field}", field=field, kind=kind, lengths=lengths)
        for field, kind in field_kinds(name).items()
    }


def _get(message: Any, where: str, *, field: str, kind: Kind, lengths: dict[str, int]) -> Any:
    value = getattr(message, field)
    if kind.is_mapping:
        return {item.name: item.value for item in value}
    if kind.repeated:
        return tuple(value)
    if not kind.is_message:
        return value
    if not message.HasField(field):
        if kind.optional:
            return None
        raise RecordingError(f"{where} is missing")
    return (
        _values(value, kind.type)
        if kind.dtype is None
        else _array(where, kind, message=value, lengths=lengths)
    )


def _array(where: str, kind: Kind, *, message: Any, lengths: dict[str, int]) -> np.ndarray:
    """Return the array of an Array message, in the machine's byte order; read-only."""
    wide, data = kind.dtype, message.data
    assert wide is not None
    shape = tuple(message.shape)
    dtype = _NARROW if kind.narrow and message.dtype == _NARROW.str else wide
    if message.dtype != dtype.str:
        raise RecordingError(f"{where} is of type {message.dtype!r}; accepted: {dtype.str!r}")
    try:
        _check_array(kind, wide, shape=shape, lengths=lengths)
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
    kind: Kind, dtype: np.dtype[Any], *, shape: tuple[int, ...], lengths: dict[str, int]
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


@cache
def _pool() -> descriptor_pool.DescriptorPool:
    """Return all messages of the table, one file each, in a pool of their own."""
    pool = descriptor_pool.DescriptorPool()
    for name in MESSAGES:
        pool.Add(_file(name))
    return pool


def _file(name: str) -> descriptor_pb2.FileDescriptorProto:
    """Return the .proto file of one message."""
    file = descriptor_pb2.FileDescriptorProto(
        name=_path(name), package=PACKAGE, syntax="proto3", message_type=[{"name": name}]
    )
    for number, (field, kind) in enumerate(field_kinds(name).items(), start=1):
        proto = file.message_type[0].field.add(name=field, number=number)
        proto.label = proto.LABEL_REPEATED if kind.repeated else proto.LABEL_OPTIONAL
        if kind.is_message:
            proto.type = proto.TYPE_MESSAGE
            proto.type_name = f".{PACKAGE}.{kind.type}"
            if _path(kind.type) not in file.dependency:
                file.dependency.append(_path(kind.type))
        else:
            proto.type = proto.Type.Value(f"TYPE_{kind.type.upper()}")
    return file


def _path(name: str) -> str:
    return f"{PACKAGE}/{name}.proto"
