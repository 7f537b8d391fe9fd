"""The messages of a recording that are the project's own: one table, made into protobuf here."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError, Message

from chsel.errors import RecordingError

FORMAT_VERSION = 1
"""Of the recording. A reader refuses all others, so any change of meaning needs a new number."""

# A field is a protobuf scalar, a message of this table, or an array with its type and shape. In a
# shape, a letter is a length that is the same wherever it stands in the message. "?" after a field
# says that it may be absent, "*" that it repeats. Field numbers follow the order: only append.
MESSAGES: Mapping[str, Mapping[str, str]] = {
    # The bytes are little-endian, in C order; the type is named as numpy names it.
    "Array": {"dtype": "string", "shape": "uint64*", "data": "bytes"},
    "Number": {"name": "string", "value": "double"},
    "Text": {"name": "string", "value": "string"},
    "Session": {
        "format_version": "uint32",
        "runner": "string",
        "object": "string",
        "session": "string",
        "method": "string",
        "seed": "uint64",
        "config": "string",  # JSON
        "workspace": "f8[2,3]",
        "free_resolution": "double",
        "world_from_object": "f8[4,4]?",
        "environment": "Text*",
        "mesh_digest": "string",
        "sdf_digest": "string",
    },
    "Probe": {
        "step": "sint32",
        "outcome": "string",
        "gripper_path": "f8[P,4,4]",
        "contacts": "f8[C,3]",
        "contact_normals": "f8[C,3]",
    },
    # Closes a session's start and every probe, after the point clouds that it counts.
    "KnownPoints": {
        "step": "sint32",
        "new_free": "uint64",
        "new_occupied": "uint64",
        "new_known": "uint64",
        "new_digest": "string",
        "free": "uint64",
        "occupied": "uint64",
        "known": "uint64",
        "digest": "string",
    },
    "Problem": {
        "step": "sint32",
        "initial_set": "f8[B,4,4]",
        "low_cost_set": "f8[L,4,4]?",  # absent: the elites of the last hypotheses, all of them
        "workspace": "f8[2,3]",
        "free_resolution": "double",
        "key_seed": "uint64",
        "key_step": "uint32",
        "points_digest": "string",
        "sdf_digest": "string",
        "digest": "string",
    },
    "ArchiveSnapshot": {
        "step": "sint32",
        "iteration": "uint32",
        "refinement": "uint32",
        "measure_names": "string*",
        "shape": "uint32*",
        "lower": "f8[k]",
        "upper": "f8[k]",
        "cells": "i8[C]",
        "solutions": "f8[C,d]",
        "objectives": "f8[C]",
        "measures": "f8[C,k]",
        "digest": "string",
    },
    "Trace": {
        "step": "sint32",
        "stage": "string",
        "iteration": "uint32",
        "digest": "string",
        "lowest_cost": "double",
        "median_cost": "double",
        "highest_cost": "double",
    },
    "Hypotheses": {
        "step": "sint32",
        "object_from_world": "f8[B,4,4]",
        "cost": "f8[B]",
        "duplicate": "b1[B]",
        "cell": "i8[B]",
        "elites": "f8[L,4,4]",
        "archive": "ArchiveSnapshot?",
        "archive_is_last_snapshot": "bool",  # then `archive` is absent
        "digest": "string",
    },
    "Measured": {"step": "sint32", "values": "Number*"},
    "SessionEnded": {"step": "sint32", "outcome": "string"},
    # No topic: this is the attachment "sdf_grid".
    "SdfGrid": {
        "origin": "f8[3]",
        "resolution": "double",
        "values": "f8[x,y,z]",
        "gradients": "f8[x,y,z,3]",
    },
}

RECORDS: Mapping[str, str] = {
    "/session": "Session",
    "/probe": "Probe",
    "/known_points": "KnownPoints",
    "/problem": "Problem",
    "/archive": "ArchiveSnapshot",
    "/trace": "Trace",
    "/hypotheses": "Hypotheses",
    "/measured": "Measured",
    "/session_ended": "SessionEnded",
}
"""Topics that carry messages of the table."""

_PACKAGE = "chsel"
_ARRAY_KIND = re.compile(r"([fib]\d)\[(.*)\]")
_LONGEST = 2**40  # of an array's side; what is beyond overflows numpy before it can be checked


@dataclass(frozen=True)
class _Kind:
    """One field of the table, taken apart; `dtype` is None for all but arrays."""

    type: str
    repeated: bool
    optional: bool
    dtype: np.dtype[Any] | None
    shape: tuple[str, ...]

    @property
    def is_message(self) -> bool:
        return self.type in MESSAGES


def message_class(name: str) -> type[Message]:
    """The protobuf class of a message of the table."""
    return message_factory.GetMessageClass(_pool().FindMessageTypeByName(f"{_PACKAGE}.{name}"))


def descriptor_set(message: type[Message]) -> bytes:
    """All that a reader without this code needs to decode a message: a FileDescriptorSet."""
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
    try:
        message.ParseFromString(data)
    except DecodeError:
        raise RecordingError(f"a message is no valid {_PACKAGE}.{name}") from None
    return _values(message, name)


def _fill(message: Any, name: str, values: Mapping[str, Any]) -> None:
    lengths: dict[str, int] = {}
    for field, kind in _kinds(name).items():
        value = values[field]
        if value is None and kind.optional:
            continue
        try:
            _set(message, field, kind, value, lengths)
        except (TypeError, ValueError) as error:
            raise RecordingError(f"{name}.{field} cannot be recorded: {error}") from None


def _set(message: Any, field: str, kind: _Kind, value: Any, lengths: dict[str, int]) -> None:
    if kind.dtype is not None:
        value = np.asarray(value)
        _check_array(kind, value.dtype, value.shape, lengths)
        target = getattr(message, field)
        target.dtype = kind.dtype.str
        target.shape.extend(value.shape)
        target.data = value.astype(kind.dtype, copy=False).tobytes()
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
        for field, kind in _kinds(name).items()
    }


def _get(message: Any, where: str, field: str, kind: _Kind, lengths: dict[str, int]) -> Any:
    if kind.repeated:
        items = getattr(message, field)
        return tuple(_values(item, kind.type) for item in items) if kind.is_message else tuple(items)
    if not kind.is_message:
        return getattr(message, field)
    if not message.HasField(field):
        if kind.optional:
            return None
        raise RecordingError(f"{where} is missing")
    value = getattr(message, field)
    return _values(value, kind.type) if kind.dtype is None else _array(where, kind, value, lengths)


def _array(where: str, kind: _Kind, message: Any, lengths: dict[str, int]) -> np.ndarray:
    """The array in an Array message, in the machine's byte order; read-only."""
    dtype, shape, data = kind.dtype, tuple(message.shape), message.data
    assert dtype is not None
    if message.dtype != dtype.str:
        raise RecordingError(f"{where} is of type {message.dtype!r}; accepted: {dtype.str!r}")
    try:
        _check_array(kind, dtype, shape, lengths)
    except ValueError as error:
        raise RecordingError(f"{where}: {error}") from None
    if max(shape) > _LONGEST or len(data) != math.prod(shape) * dtype.itemsize:
        raise RecordingError(f"{where} has {len(data)} bytes, which do not fill its shape {shape}")
    if dtype.kind == "b" and data.strip(b"\0\1"):
        raise RecordingError(f"{where} holds bytes other than 0 and 1")
    array = np.frombuffer(data, dtype).reshape(shape).astype(dtype.newbyteorder("="), copy=False)
    array.setflags(write=False)
    return array


def _check_array(
    kind: _Kind, dtype: np.dtype[Any], shape: tuple[int, ...], lengths: dict[str, int]
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
def _kinds(name: str) -> dict[str, _Kind]:
    """The fields of a message, taken apart."""
    kinds = {}
    for field, text in MESSAGES[name].items():
        bare = text.rstrip("?*")
        array = _ARRAY_KIND.fullmatch(bare)
        kinds[field] = _Kind(
            type="Array" if array else bare,
            repeated=text.endswith("*"),
            optional=text.endswith("?"),
            dtype=np.dtype(f"<{array[1]}") if array else None,
            shape=tuple(array[2].split(",")) if array else (),
        )
    return kinds


@cache
def _pool() -> descriptor_pool.DescriptorPool:
    """All messages of the table, one file each, in a pool of their own."""
    pool = descriptor_pool.DescriptorPool()
    for name in MESSAGES:
        pool.Add(_file(name))
    return pool


def _file(name: str) -> descriptor_pb2.FileDescriptorProto:
    """The .proto file of one message."""
    file = descriptor_pb2.FileDescriptorProto(
        name=_path(name), package=_PACKAGE, syntax="proto3", message_type=[{"name": name}]
    )
    for number, (field, kind) in enumerate(_kinds(name).items(), start=1):
        proto = file.message_type[0].field.add(name=field, number=number)
        proto.label = proto.LABEL_REPEATED if kind.repeated else proto.LABEL_OPTIONAL
        if kind.is_message:
            proto.type, proto.type_name = proto.TYPE_MESSAGE, f".{_PACKAGE}.{kind.type}"
            if _path(kind.type) not in file.dependency:
                file.dependency.append(_path(kind.type))
        else:
            proto.type = proto.Type.Value(f"TYPE_{kind.type.upper()}")
    return file


def _path(name: str) -> str:
    return f"{_PACKAGE}/{name}.proto"
