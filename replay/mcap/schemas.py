"""The messages of a recording that are the project's own: one table, made into protobuf here."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message

FORMAT_VERSION = 3
"""That of new recordings. A reader refuses newer ones, so any change of meaning needs a new number.

Version 2 added a rig and images of its sensors, version 3 seals.
"""

SEALED_SINCE = 3
"""From this version on, seals cover every record, and measured values are those of the results."""

PROFILE = "chsel"
"""How the file's header names this use of MCAP."""

STEP_TIME = 10**9
"""Nanoseconds of log time from one step to the next; step k begins at k + 1 times this."""

BEFORE_ALL_STEPS = -1
"""The step of a session's start."""

MESH, SDF_GRID = "mesh.ply", "sdf_grid"
"""Names of attachments."""

# A field is a protobuf scalar, a message of this table, or an array with its type and shape. In a
# shape, a letter is a length that is the same wherever it stands in the message. "?" after a field
# says that it may be absent, "*" that it repeats. "f8~" is
# stored in 32 bits where that is exact. Field numbers follow the order: only append.
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
        "source": "string",
        "lost": "string*",  # attachments that a damaged file no longer held when it was recovered
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
        "digest": "string",  # of all points so far; empty since version 3
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
    "Timed": {"step": "sint32", "seconds": "Number*"},
    "SessionEnded": {"step": "sint32", "outcome": "string"},
    "Rig": {
        "step": "sint32",
        "name": "string",
        "source": "string",  # digest of the raw log
        "hand_vertices": "f8[V,3]?",
        "hand_faces": "i4[F,3]?",
    },
    # Pixels are compressed by Zstandard, row by row: a blank image is as good as nothing, and no
    # other message may grow as much as one can.
    "SensorImage": {
        "step": "sint32",
        "sensor": "string",
        "kind": "string",
        "height": "uint32",
        "width": "uint32",
        "values": "bytes",  # 16 bits a pixel, little-endian
        "unit": "double",
        "mask": "bytes",  # a bit a pixel, the first the highest of a byte
        "intrinsics": "f8[4]",
        "world_from_camera": "f8[4,4]",
    },
    # The last message: a row for each probe, so that a large file tells at once what is in it.
    "Contents": {
        "step": "i8[S]",
        "free": "i8[S]",
        "occupied": "i8[S]",
        "known": "i8[S]",
        "contacts": "i8[S]",
        "posed": "b1[S]",
        "hypotheses": "i8[S]",  # -1 where there is no result
        "distinct": "i8[S]",
        "best_cost": "f8[S]",  # NaN where there is no result
        "session": "string",  # as in the seals; empty before version 3
        "digest": "string",  # of the last seal
    },
    # Ends the session's start, every step and every chunk; see seal.py.
    "Seal": {
        "step": "sint32",
        "session": "string",  # digest of all before the first seal
        "previous": "string",  # digest of the seal before, empty for the first
        "parts": "Text*",  # of each topic with messages since then, and the digest of these
        "digest": "string",  # of the above, and of number and time of this message
    },
    # No topic: this is the attachment "sdf_grid".
    "SdfGrid": {
        "origin": "f8[3]",
        "resolution": "double",
        "values": "f8~[x,y,z]",
        "gradients": "f8~[x,y,z,3]",
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
    "/timed": "Timed",
    "/session_ended": "SessionEnded",
    "/contents": "Contents",
    "/rig": "Rig",
    "/sensor_image": "SensorImage",
    "/seal": "Seal",
}
"""Topics that carry messages of the table."""

SINCE_VERSION: Mapping[str, int] = {"/rig": 2, "/sensor_image": 2, "/seal": SEALED_SINCE}
"""Topics that a recording of a lower version does not have."""

PACKAGE = "chsel"
_ARRAY_KIND = re.compile(r"([fib]\d)(~?)\[(.*)\]")


@dataclass(frozen=True)
class Kind:
    """One field of the table, taken apart; `dtype` is None for all but arrays."""

    type: str
    repeated: bool
    optional: bool
    dtype: np.dtype[Any] | None
    shape: tuple[str, ...]
    narrow: bool

    @property
    def is_message(self) -> bool:
        return self.type in MESSAGES


def message_class(name: str) -> type[Message]:
    """The protobuf class of a message of the table."""
    return message_factory.GetMessageClass(_pool().FindMessageTypeByName(f"{PACKAGE}.{name}"))


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


@cache
def field_kinds(name: str) -> dict[str, Kind]:
    """The fields of a message, taken apart."""
    kinds = {}
    for field, text in MESSAGES[name].items():
        bare = text.rstrip("?*")
        array = _ARRAY_KIND.fullmatch(bare)
        kinds[field] = Kind(
            type="Array" if array else bare,
            repeated=text.endswith("*"),
            optional=text.endswith("?"),
            dtype=np.dtype(f"<{array[1]}") if array else None,
            shape=tuple(array[3].split(",")) if array else (),
            narrow=bool(array and array[2]),
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
        name=_path(name), package=PACKAGE, syntax="proto3", message_type=[{"name": name}]
    )
    for number, (field, kind) in enumerate(field_kinds(name).items(), start=1):
        proto = file.message_type[0].field.add(name=field, number=number)
        proto.label = proto.LABEL_REPEATED if kind.repeated else proto.LABEL_OPTIONAL
        if kind.is_message:
            proto.type, proto.type_name = proto.TYPE_MESSAGE, f".{PACKAGE}.{kind.type}"
            if _path(kind.type) not in file.dependency:
                file.dependency.append(_path(kind.type))
        else:
            proto.type = proto.Type.Value(f"TYPE_{kind.type.upper()}")
    return file


def _path(name: str) -> str:
    return f"{PACKAGE}/{name}.proto"
