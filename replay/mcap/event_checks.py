"""What an event may say: the writer lets nothing else into a recording, and the reader out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from chsel.errors import PoseError, RecordingError
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import check_rigid
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses
from chsel.problem.sdf_grid import COARSEST, FINEST
from chsel.qd.selection import MOST_CELLS
from replay.events import (
    Event,
    HypothesesFound,
    Logged,
    Measured,
    Probe,
    RigDescribed,
    SensorImage,
    SessionEnded,
    SessionStarted,
    SnapshotTaken,
    Timed,
    Traced,
)
from replay.mcap.attachments import check_mesh
from replay.mcap.texts import check_name, check_text

OUTCOMES = ("contact", "free", "points")
ENDS = ("finished", "interrupted")
FAILED = "failed: "
KINDS_OF_IMAGE = ("depth", "deformation")
LARGEST_SIDE = 8192
"""Pixels of an image, either way."""
RECOVERED = "recovered: "
"""Opens what a recovery adds to a recording: lines of its log, and the end if there was none."""

_UNITS = (1e-9, 1e3)
_LONGEST_FOCUS = 1e6


def check_event(event: Event) -> None:
    """Raise RecordingError unless an event is as its class says; a problem checks itself."""
    try:
        _check(event)
    except (ValueError, IndexError, TypeError) as error:  # of arrays that do not fit together
        kind = type(event).__name__
        raise RecordingError(f"{kind} has a value of another shape or type: {error}") from None


def _check(event: Event) -> None:
    match event:
        case SessionStarted():
            _check_start(event)
        case RigDescribed():
            check_name("the rig", event.name)
            check_name("the source of the rig", event.source)
            if event.hand is not None:
                check_mesh(event.hand.vertices, event.hand.faces)
        case SensorImage():
            _check_image(event)
        case Probe():
            _check_probe(event)
        case SnapshotTaken():
            _check_archive(f"the archive of step {event.step}", event.archive)
        case Traced():
            _check_trace(event)
        case HypothesesFound():
            _check_hypotheses(f"the hypotheses of step {event.step}", event.hypotheses)
        case Measured():
            _check_names("a measured value", event.values)
        case Timed():
            _check_names("a time", event.seconds)
            if not all(math.isfinite(value) for value in event.seconds.values()):
                raise RecordingError("a time is not finite; accepted: seconds")
        case Logged():
            check_text("a log line", event.text)
        case SessionEnded():
            check_text("the outcome of the session", event.outcome)
            if event.outcome not in ENDS and not event.outcome.startswith((FAILED, RECOVERED)):
                raise RecordingError(
                    f"the outcome of the session is {event.outcome!r}; "
                    f"accepted: {', '.join(ENDS)}, {FAILED}REASON, {RECOVERED}REASON"
                )


def check_poses(what: str, poses: FloatArray) -> None:
    """Raise RecordingError unless poses (B, 4, 4) are rigid."""
    with np.errstate(all="ignore"):
        try:
            check_rigid(what, poses)
        except PoseError as error:
            raise RecordingError(str(error)) from None


def check_free_resolution(resolution: float) -> None:
    """Raise RecordingError unless a voxel side is one that a problem can have."""
    if not FINEST <= resolution <= COARSEST:
        raise RecordingError(
            f"free_resolution is {resolution}; accepted: {FINEST:g} to {COARSEST:g} (m)"
        )


def check_image_head(
    sensor: str,
    kind: str,
    shape: tuple[int, int],
    unit: float,
    intrinsics: FloatArray,
    world_from_camera: FloatArray,
) -> None:
    """Raise RecordingError unless all of an image but its pixels (H, W) is as its class says."""
    check_name("a sensor", sensor)
    if not sensor.replace("_", "").isalnum():
        raise RecordingError(f"a sensor is named {sensor!r}; accepted: letters, digits and _")
    if kind not in KINDS_OF_IMAGE:
        accepted = ", ".join(KINDS_OF_IMAGE)
        raise RecordingError(f"an image of {sensor} is of kind {kind!r}; accepted: {accepted}")
    if not (min(shape) >= 1 and max(shape) <= LARGEST_SIDE):
        raise RecordingError(
            f"an image of {sensor} has {shape} pixels; accepted: 1 to {LARGEST_SIDE} either way"
        )
    low, high = _UNITS
    if not low <= unit <= high:
        raise RecordingError(
            f"the unit of an image of {sensor} is {unit}; accepted: {low:g} to {high:g} (m)"
        )
    if not (np.abs(intrinsics) <= _LONGEST_FOCUS).all() or not (intrinsics[:2] > 0.0).all():
        raise RecordingError(
            f"intrinsics of an image of {sensor} are {np.asarray(intrinsics).tolist()}; accepted: "
            f"focal lengths above 0, all up to {_LONGEST_FOCUS:g} (pixels)"
        )
    check_poses(f"world_from_camera of {sensor}", np.asarray(world_from_camera)[None])


def _check_start(event: SessionStarted) -> None:
    for name in ("runner", "object", "session", "method", "source"):
        check_name(name, getattr(event, name))
    _check_names("an entry of the environment", event.environment)
    for name, value in event.environment.items():
        check_text(f"{name} of the environment", value)
    check_free_resolution(event.free_resolution)
    if event.world_from_object is not None:
        check_poses("world_from_object", np.asarray(event.world_from_object)[None])


def _check_probe(event: Probe) -> None:
    if event.outcome not in OUTCOMES:
        raise RecordingError(
            f"the outcome of probe {event.step} is {event.outcome!r}; "
            f"accepted: {', '.join(OUTCOMES)}"
        )
    check_poses("gripper_path", event.gripper_path)
    for name in ("contacts", "contact_normals"):
        _check_finite(f"{name} of probe {event.step}", getattr(event, name))


def _check_image(event: SensorImage) -> None:
    height, width = event.values.shape
    check_image_head(
        event.sensor,
        event.kind,
        (height, width),
        event.unit,
        event.intrinsics,
        event.world_from_camera,
    )
    if event.values.dtype != np.uint16:
        raise RecordingError(f"an image has values of {event.values.dtype}; accepted: uint16")
    if event.mask.dtype != np.bool_ or event.mask.shape != event.values.shape:
        raise RecordingError(
            f"the mask of an image is {event.mask.dtype} {event.mask.shape}; "
            f"accepted: bool {event.values.shape}"
        )


def _check_archive(what: str, archive: ArchiveSnapshot) -> None:
    axes = len(archive.shape)
    counts = (len(archive.measure_names), len(archive.lower), archive.measures.shape[-1])
    if axes == 0 or set(counts) != {axes}:
        raise RecordingError(f"{what} has {axes} axes, but names, ranges or measures for {counts}")
    for name in archive.measure_names:
        check_name(f"a measure of {what}", name)
    cells = math.prod(archive.shape)
    if not 0 < cells <= MOST_CELLS or min(archive.shape) < 1:
        raise RecordingError(
            f"{what} has {cells} cells, {archive.shape}; accepted: 1 to {MOST_CELLS}"
        )
    for name in ("lower", "upper", "solutions", "objectives", "measures"):
        _check_finite(f"{name} of {what}", getattr(archive, name))
    if not (archive.lower < archive.upper).all():
        raise RecordingError(f"{what} has an empty range; accepted: lower below upper")
    occupied = archive.cells
    if len(occupied) and not (
        occupied[0] >= 0 and occupied[-1] < cells and (occupied[:-1] < occupied[1:]).all()
    ):
        raise RecordingError(f"{what} has cells out of order; accepted: ascending, below {cells}")


def _check_trace(event: Traced) -> None:
    check_name("a stage", event.stage)
    check_name("the digest of a stage", event.digest)
    lowest, median, highest = event.costs
    if not lowest <= median <= highest:
        raise RecordingError(
            f"{event.stage}, iteration {event.iteration} has the costs {event.costs}; "
            "accepted: lowest, median, highest"
        )


def _check_hypotheses(what: str, found: Hypotheses) -> None:
    _check_found_poses(f"object_from_world of {what}", found.object_from_world, found.cost)
    _check_found_poses(f"elites of {what}", found.elites)
    if not (found.cost[:-1] <= found.cost[1:]).all() or np.isnan(found.cost).any():
        raise RecordingError(f"cost of {what} is out of order; accepted: ascending numbers")
    if np.isneginf(found.cost).any():
        raise RecordingError(f"cost of {what} is -inf; accepted: finite numbers, or inf")
    cells = 0
    if found.archive is not None:
        _check_archive(f"the last archive of {what}", found.archive)
        cells = math.prod(found.archive.shape)
    if len(found.cell) and not (found.cell.min() >= -1 and found.cell.max() < cells):
        raise RecordingError(f"cell of {what} is out of range; accepted: -1 to {cells - 1}")


def _check_found_poses(what: str, poses: FloatArray, cost: FloatArray | None = None) -> None:
    """Rigid, or not finite: there a descent diverged, and no cost can be finite."""
    finite = np.isfinite(poses).all(axis=(1, 2))
    if cost is not None and (np.isfinite(cost) & ~finite).any():
        raise RecordingError(f"{what} is not finite where the cost is; accepted: rigid transforms")
    check_poses(what, poses if finite.all() else poses[finite])


def _check_names(what: str, values: Mapping[str, Any]) -> None:
    for name in values:
        check_name(f"the name of {what}", name)


def _check_finite(what: str, array: FloatArray) -> None:
    if not np.isfinite(array).all():
        raise RecordingError(f"{what} has a number that is not finite; accepted: finite numbers")
