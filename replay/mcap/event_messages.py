"""Events as the values of their messages, and back.

A field that an event and its message share is taken over as it is; here is what is stored in
another form, and in `sensor_messages`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, get_args

from chsel.problem.mesh import mesh_digest
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.registration_problem import ArchiveSnapshot, RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from replay.events import (
    ActionsOffered,
    Decided,
    Event,
    ProblemPosed,
    RigDescribed,
    SensorImage,
    SessionStarted,
    SnapshotTaken,
)
from replay.lost_attachment import LostAttachment
from replay.mcap.decision_messages import decision_values, offered_from, offered_values
from replay.mcap.encoding import shared_arguments, shared_values
from replay.mcap.plain_config import config_from_json, config_to_json
from replay.mcap.schemas import FORMAT_VERSION, RECORDS, UNSTEERED_VERSION
from replay.mcap.sensor_messages import image_values, rig_from, rig_values
from replay.mcap.validation import check_digest

if TYPE_CHECKING:
    import trimesh

EVENTS: Mapping[str, type[Event]] = {kind.topic: kind for kind in get_args(Event)}
"""The classes of events by their topics."""


def event_values(event: Event) -> dict[str, Any]:
    """An event as its message has it; results may repeat an archive, see `McapRecorder`."""
    match event:
        case SessionStarted():
            return _session_values(event)
        case ProblemPosed():
            return _problem_values(event)
        case SnapshotTaken():
            return archive_values(event.step, event.archive)
        case RigDescribed():
            return rig_values(event)
        case ActionsOffered():
            return offered_values(event)
        case SensorImage():
            return image_values(event)
        case Decided():
            return decision_values(event)
        case _:
            return shared_values(RECORDS[event.topic], event)


def event_from(topic: str, values: Mapping[str, Any]) -> Event:
    """The event of a message that is all of it."""
    kind = EVENTS[topic]
    if kind is RigDescribed:
        return rig_from(values)
    if kind is ActionsOffered:
        return offered_from(values)
    return kind(**shared_arguments(kind, values))


def is_steered(start: SessionStarted) -> bool:
    """Whether a policy decides on the probes of a session, and its decisions are recorded."""
    return "policy" in start.config


def version_of(start: SessionStarted) -> int:
    """The version of the format in which a session is written: the first that has its topics."""
    return FORMAT_VERSION if is_steered(start) else UNSTEERED_VERSION


def step_numbers(event: Event) -> dict[str, float]:
    """The numbers of an event, by their names: scalar fields, and mappings to numbers."""
    numbers: dict[str, float] = {}
    for name, value in event_values(event).items():
        if isinstance(value, Mapping):
            numbers |= value
        elif isinstance(value, float):
            numbers[name] = value
    return numbers


def _session_values(event: SessionStarted) -> dict[str, Any]:
    """The message `Session`."""
    mesh: Any = event.mesh
    lost = [part.name for part in (event.mesh, event.sdf) if isinstance(part, LostAttachment)]
    return shared_values("Session", event) | {
        "format_version": version_of(event),
        "config": config_to_json(event.config),
        "workspace": event.workspace.bounds,
        "mesh_digest": mesh.digest if isinstance(mesh, LostAttachment) else mesh_digest(mesh),
        "sdf_digest": event.sdf.digest,
        "lost": lost,
    }


def session_from(
    values: Mapping[str, Any], points: KnownPoints, mesh: trimesh.Trimesh, sdf: SdfGrid
) -> SessionStarted:
    """The start of a session, with its points and attachments."""
    parts = {
        "config": config_from_json(values["config"]),
        "workspace": workspace_from(values),
        "initial_points": points,
        "mesh": mesh,
        "sdf": sdf,
    }
    return SessionStarted(**shared_arguments(SessionStarted, values) | parts)


def _problem_values(event: ProblemPosed) -> dict[str, Any]:
    """The message `Problem`, with its low-cost set."""
    problem = event.problem
    return shared_values("Problem", problem) | {
        "step": event.step,
        "workspace": problem.workspace.bounds,
        "key_seed": problem.key.seed,
        "key_step": problem.key.step,
        "points_digest": problem.points.digest,
        "sdf_digest": problem.sdf.digest,
    }


def problem_from(
    values: Mapping[str, Any], sdf: SdfGrid, points: KnownPoints
) -> RegistrationProblem:
    """The problem in a message that has its low-cost set, with its grid and points."""
    parts = {
        "workspace": workspace_from(values),
        "key": StreamKey(values["key_seed"], values["key_step"]),
        "sdf": sdf,
        "points": points,
    }
    return RegistrationProblem(**shared_arguments(RegistrationProblem, values) | parts)


def archive_values(step: int, archive: ArchiveSnapshot) -> dict[str, Any]:
    """The message `ArchiveSnapshot`."""
    return {"step": step} | shared_values("ArchiveSnapshot", archive)


def archive_from(values: Mapping[str, Any]) -> ArchiveSnapshot:
    """The archive in a message; RecordingError unless it has its digest."""
    archive = ArchiveSnapshot(**shared_arguments(ArchiveSnapshot, values))
    check_digest(f"an archive of step {values['step']}", archive.digest, values["digest"])
    return archive


def workspace_from(values: Mapping[str, Any]) -> Workspace:
    """The workspace of a message."""
    return Workspace(*values["workspace"].tolist())
