"""The messages of a recording that are the project's own, and the topics that carry them.

An event of `chsel.events` that names its topic is written, read, checked, compared and exported
as its message here says. A new field or event stands in its class and in this table.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from replay.mcap.texts import check_name
from replay.mcap.validation import (
    Check,
    ascending_costs,
    between,
    chances,
    check_archive,
    check_decision,
    check_hand,
    check_hypotheses,
    distribution,
    finite,
    intrinsics,
    not_empty,
    numbers_of_points,
    one_of,
    plain_texts,
    positive,
    rigid,
    sensor_name,
    session_end,
    short_names,
    stop_reason,
    verdict,
    voxel_side,
)

FORMAT_VERSION = 1
"""A reader refuses every other one, so any change of meaning needs a new number."""

PROFILE = "chsel"
"""Name of this use of MCAP in the header of a file."""

STEP_TIME = 10**9
"""Nanoseconds of log time from one step to the next; step k begins at k + 1 times this."""

BEFORE_ALL_STEPS = -1
"""The step of a session's start."""

LARGEST_SIDE = 8192
"""Pixels of an image, either way."""

MESH, SDF_GRID = "mesh.ply", "sdf_grid"
"""Names of attachments."""

PACKAGE = "chsel"

# A field is a protobuf scalar, a message of this table, or an array with its type and shape. In a
# shape, a letter is a length that is the same wherever it stands in the message. "?" after a field
# says that it may be absent, "*" that it repeats; repeated Numbers and Texts are a mapping by their
# names. "f8~" is stored in 32 bits where that is exact. Functions behind the type say what values
# are accepted. Field numbers follow the order: only append.
MESSAGES: Mapping[str, Mapping[str, str | tuple[str | Check, ...]]] = {
    # The bytes are little-endian, in C order; the type is named as numpy names it.
    "Array": {"dtype": "string", "shape": "uint64*", "data": "bytes"},
    "Number": {"name": "string", "value": "double"},
    "Text": {"name": "string", "value": "string"},
    # When steps register; `steps`: of no others than these.
    "Start": {"contacts": "uint32", "step": "sint32", "steps": "i8[S]?"},
    # Parts of a prior that are absent are not given.
    "PosePrior": {
        "centre": ("f8[3]?", finite),
        "centre_noise": ("f8[1]?", finite),  # metres
        "point": ("f8[3]?", finite),
        "axis": ("f8[3]?", finite),
        "along": ("f8[3]?", finite),
        "axis_noise": ("f8[1]?", finite),  # radians
        "object_from_world": ("f8[J,4,4]?", rigid),
        "covariances": ("f8[J,6,6]?", finite),
        "weights": ("f8[J]?", chances),
    },
    "Session": {
        "format_version": "uint32",
        "runner": ("string", check_name),
        "object": ("string", check_name),
        "session": ("string", check_name),
        "method": ("string", check_name),
        "seed": "uint64",
        "config": "string",  # JSON
        "workspace": "f8[2,3]",
        "free_resolution": ("double", voxel_side),
        "world_from_object": ("f8[4,4]?", rigid),
        "environment": ("Text*", short_names, plain_texts),
        "mesh_digest": "string",
        "sdf_digest": "string",
        "source": ("string", check_name),
        "start": "Start?",
        "moves": ("f8[1]?", finite),  # metres
        "prior": "PosePrior?",
    },
    "Probe": {
        "step": "sint32",
        "outcome": ("string", one_of("contact", "free", "points")),
        "gripper_path": ("f8[P,4,4]", rigid),
        "contacts": ("f8[C,3]", finite),
        "contact_normals": ("f8[C,3]", finite),
        "world_from_object": ("f8[4,4]?", rigid),
        "image_points": "uint32",
        "withdrawn": ("i8[W]?", numbers_of_points),
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
        "normals": "f8[N,3]?",  # of new known points, 0 where unknown; absent where all are
        "normal_noise": "f8[N]?",  # radians
    },
    "Pushes": {"directions": "f8[P,3]", "before": "i8[P,3]", "largest": "double"},
    "Problem": {
        "step": "sint32",
        "initial_set": ("f8[B,4,4]", not_empty, rigid),
        "low_cost_set": ("f8[L,4,4]?", rigid),  # absent: all elites of the last hypotheses
        "workspace": "f8[2,3]",
        "free_resolution": ("double", voxel_side),
        "key_seed": "uint64",
        "key_step": "uint32",
        "points_digest": "string",
        "sdf_digest": "string",
        "digest": "string",
        "pushes": "Pushes?",
        "prior": "PosePrior?",
    },
    "ArchiveSnapshot": {
        "step": "sint32",
        "iteration": "uint32",
        "refinement": "uint32",
        "measure_names": ("string*", short_names),
        "shape": "uint32*",
        "lower": ("f8[k]", finite),
        "upper": ("f8[k]", finite),
        "cells": "i8[C]",
        "solutions": ("f8[C,d]", finite),
        "objectives": ("f8[C]", finite),
        "measures": ("f8[C,k]", finite),
        "digest": "string",
    },
    "Trace": {
        "step": "sint32",
        "stage": ("string", check_name),
        "iteration": "uint32",
        "digest": ("string", check_name),
        "lowest_cost": "double",
        "median_cost": "double",
        "highest_cost": "double",
    },
    "Hypotheses": {
        "step": "sint32",
        "object_from_world": "f8[B,4,4]",
        "cost": ("f8[B]", ascending_costs),
        "duplicate": "b1[B]",
        "cell": "i8[B]",
        "elites": "f8[L,4,4]",
        "archive": "ArchiveSnapshot?",
        "archive_is_last_snapshot": "bool",  # then `archive` is absent
        "digest": "string",
        "push_distance": ("double", between(0.0, 1.0, unit="m")),
    },
    "Measured": {"step": "sint32", "values": ("Number*", short_names)},
    "Timed": {"step": "sint32", "seconds": ("Number*", short_names, finite)},
    "SessionEnded": {"step": "sint32", "outcome": ("string", session_end)},
    "Rig": {
        "step": "sint32",
        "name": ("string", check_name),
        "source": ("string", check_name),  # digest of the raw log
        "hand_vertices": "f8[V,3]?",
        "hand_faces": "i4[F,3]?",
    },
    # Pixels are compressed by Zstandard, row by row.
    "SensorImage": {
        "step": "sint32",
        "sensor": ("string", sensor_name),
        "kind": ("string", one_of("depth", "deformation")),
        "height": ("uint32", between(1, LARGEST_SIDE, unit="pixels")),
        "width": ("uint32", between(1, LARGEST_SIDE, unit="pixels")),
        "values": "bytes",  # 16 bits a pixel, little-endian
        "unit": ("double", between(1e-9, 1e3, unit="m")),
        "mask": "bytes",  # a bit a pixel, the first the highest of a byte
        "intrinsics": ("f8[4]", intrinsics),  # fx, fy, cx, cy, pixels
        "world_from_camera": ("f8[4,4]", rigid),
    },
    "Actions": {
        "step": "sint32",
        "world_from_hand": ("f8[A,4,4]", rigid),
        "length": ("f8[A]", positive),
        "seconds": ("f8[A]?", positive),
        "hand_vertices": "f8[V,3]",
        "hand_faces": "i4[F,3]",
        "digest": "string",  # of both
    },
    # Grid, points, workspace, actions and hand of the problem are those of the messages before.
    "Decision": {
        "step": "sint32",
        "poses": ("f8[K,4,4]", not_empty, rigid),  # of the belief, object_from_world
        "weights": ("f8[K]", distribution),
        "available": "b1[A]",
        "key_seed": "uint64",
        "key_step": "uint32",
        "problem_digest": "string",
        "chosen": "sint32",
        "stop": ("string", stop_reason),
        "spread": ("double", between(0.0, 1e6, unit="m")),
        "score": "f8[A]",
        "hit_chance": ("f8[A]", chances),
        "blocked_chance": ("f8[A]", chances),
        "expected_spread": ("f8[A]", finite),
        "contacts": "f8[N,3]",
        "digest": "string",  # of chosen to contacts
        "surprise": ("double", finite),
        "verdict": ("string", verdict),
    },
    "Belief": {
        "step": "sint32",
        "numbers": "i8[M]",
        "weights": ("f8[M]", chances),
        "object_from_world": ("f8[M,4,4]", rigid),
        "centres": ("f8[M,3]", finite),
        "covariances": ("f8[M,6,6]", finite),
        "spread": ("double", between(0.0, 1e6, unit="m")),
    },
    # Proper rotations about the centre, their products with those about the axis, or all rotations.
    "Symmetry": {
        "centre": ("f8[3]", finite),
        "rotations": ("f8[S,3,3]", finite),
        "axis": ("f8[3]?", finite),
        "sphere": "bool",
    },
    # No topic: this is the attachment "sdf_grid".
    "SdfGrid": {
        "origin": "f8[3]",
        "resolution": "double",
        "values": "f8~[x,y,z]",
        "gradients": "f8~[x,y,z,3]",
        "symmetry": "Symmetry?",  # of the object, as declared
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
    "/rig": "Rig",
    "/sensor_image": "SensorImage",
    "/actions": "Actions",
    "/decision": "Decision",
    "/belief": "Belief",
}
"""Topics that carry messages of the table."""

NUMBERS = ("/measured", "/timed")
"""Topics whose numbers are about a step: rows of exported metrics, and curves in Rerun."""

TOGETHER: Mapping[str, Callable[[Mapping[str, Any]], None]] = {
    "Actions": check_hand,
    "ArchiveSnapshot": check_archive,
    "Decision": check_decision,
    "Hypotheses": check_hypotheses,
    "Rig": check_hand,
}
"""Checks of the values of a message together; they raise RecordingError."""
