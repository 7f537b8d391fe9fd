"""Events as the values of their messages, and back.

A field that an event and its message share is taken over as it is; here is what is stored in
another form.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, get_args

import numpy as np
import zstandard

from chsel.errors import ChselError, RecordingError
from chsel.events import (
    ActionsOffered,
    Decided,
    Event,
    ProblemPosed,
    RigDescribed,
    SensorImage,
    SessionStarted,
    SnapshotTaken,
    Start,
)
from chsel.next_probe.decision_problem import (
    Actions,
    Decision,
    DecisionProblem,
    HandShape,
    WeightedPoses,
)
from chsel.numerics.arrays import digest
from chsel.problem.mesh import mesh_digest
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.pose_prior import PosePrior
from chsel.problem.pushes import Pushes
from chsel.problem.registration_problem import ArchiveSnapshot, RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from replay.mcap.encoding import check_message, shared_arguments, shared_values
from replay.mcap.schemas import FORMAT_VERSION, RECORDS
from replay.mcap.validation import check_digest

if TYPE_CHECKING:
    import trimesh

EVENTS: Mapping[str, type[Event]] = {kind.topic: kind for kind in get_args(Event)}
"""The classes of events by their topics."""

_LEVEL = 3  # of an image's compression: a higher one takes longer for hardly less
_VALUE = np.dtype("<u2")


def event_values(event: Event) -> dict[str, Any]:
    """Return an event as its message has it; results may repeat an archive, see `McapRecorder`."""
    match event:
        case SessionStarted():
            return _session_values(event)
        case ProblemPosed():
            return _problem_values(event)
        case SnapshotTaken():
            return archive_values(event.step, event.archive)
        case RigDescribed():
            return _rig_values(event)
        case ActionsOffered():
            return _offered_values(event)
        case SensorImage():
            return image_values(event)
        case Decided():
            return _decision_values(event)
        case _:
            return shared_values(RECORDS[event.topic], event)


def event_from(topic: str, values: Mapping[str, Any]) -> Event:
    """Return the event of a message that is all of it."""
    kind = EVENTS[topic]
    if kind is RigDescribed:
        return _rig_from(values)
    if kind is ActionsOffered:
        return _offered_from(values)
    return kind(**shared_arguments(kind, values))


def step_numbers(event: Event) -> dict[str, float]:
    """Return the numbers of an event, by their names: scalar fields, and mappings to numbers."""
    numbers: dict[str, float] = {}
    for name, value in event_values(event).items():
        if isinstance(value, Mapping):
            numbers |= value
        elif isinstance(value, float):
            numbers[name] = value
    return numbers


def _session_values(event: SessionStarted) -> dict[str, Any]:
    """Return the message `Session`."""
    try:
        config = json.dumps(dict(event.config), ensure_ascii=False, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"the configuration cannot be recorded: {error}") from None
    return shared_values("Session", event) | {
        "format_version": FORMAT_VERSION,
        "config": config,
        "workspace": event.workspace.bounds,
        "mesh_digest": mesh_digest(event.mesh),
        "sdf_digest": event.sdf.digest,
        "start": _start_values(event.start),
        "moves": None if event.moves is None else np.array([event.moves]),
        "prior": _prior_values(event.prior),
    }


def session_from(
    values: Mapping[str, Any], points: KnownPoints, *, mesh: trimesh.Trimesh, sdf: SdfGrid
) -> SessionStarted:
    """Return the start of a session, with its points and attachments."""
    parts = {
        "config": config_from_json(values["config"]),
        "workspace": _workspace_from(values),
        "initial_points": points,
        "mesh": mesh,
        "sdf": sdf,
        "start": _start_from(values["start"]),
        "moves": None if values["moves"] is None else float(values["moves"][0]),
        "prior": _prior_from(values["prior"]),
    }
    return SessionStarted(**shared_arguments(SessionStarted, values) | parts)


def _start_values(start: Start | None) -> dict[str, Any] | None:
    """Return the message `Start`."""
    if start is None:
        return None
    steps = None if start.steps is None else np.array(start.steps, dtype=np.int64)
    return {"contacts": start.contacts, "step": start.step, "steps": steps}


def _start_from(values: Mapping[str, Any] | None) -> Start | None:
    """Return when the steps of a session register, from a message `Start`."""
    if values is None:
        return None
    steps = None if values["steps"] is None else tuple(values["steps"].tolist())
    return Start(contacts=values["contacts"], step=values["step"], steps=steps)


def _prior_values(prior: PosePrior | None) -> dict[str, Any] | None:
    """Return the message `PosePrior`."""
    if prior is None:
        return None
    values = shared_values("PosePrior", prior)
    return {
        name: np.array([each]) if isinstance(each, float) else each for name, each in values.items()
    }


def _prior_from(values: Mapping[str, Any] | None) -> PosePrior | None:
    """Return the prior of a message `PosePrior`; raise RecordingError if it is none."""
    if values is None:
        return None
    noise = {
        name: None if values[name] is None else float(values[name][0])
        for name in ("centre_noise", "axis_noise")
    }
    try:
        return PosePrior(**{**values, **noise})
    except ChselError as error:
        raise RecordingError(f"its prior cannot be used: {error}") from None


def config_from_json(text: str) -> dict[str, Any]:
    """Return the configuration of a session; raise RecordingError if it is no mapping in JSON."""
    try:
        config = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"its configuration is not valid JSON: {error}") from None
    if not isinstance(config, dict):
        raise RecordingError("its configuration is not a mapping")
    return config


def _problem_values(event: ProblemPosed) -> dict[str, Any]:
    """Return the message `Problem`, with its low-cost set."""
    problem = event.problem
    pushes = problem.pushes
    return shared_values("Problem", problem) | {
        "pushes": None if pushes is None else shared_values("Pushes", pushes),
        "prior": _prior_values(problem.prior),
        "step": event.step,
        "workspace": problem.workspace.bounds,
        "key_seed": problem.key.seed,
        "key_step": problem.key.step,
        "points_digest": problem.points.digest,
        "sdf_digest": problem.sdf.digest,
    }


@dataclass(frozen=True, eq=False)
class RecordedProblem:
    """A problem without its points and grid, which the events before it give."""

    topic: ClassVar[str] = ProblemPosed.topic

    values: Mapping[str, Any]  # of the message `Problem`, the low-cost set included

    @property
    def step(self) -> int:
        """Step of the registration."""
        return int(self.values["step"])

    @property
    def seed(self) -> int:
        """Seed of the random streams."""
        return int(self.values["key_seed"])

    def completed(self, sdf: SdfGrid, points: KnownPoints) -> RegistrationProblem:
        """Return the whole problem; raise RecordingError unless it is the recorded one."""
        values = self.values
        parts = {
            "workspace": _workspace_from(values),
            "key": StreamKey(values["key_seed"], values["key_step"]),
            "sdf": sdf,
            "points": points,
            "pushes": None if values["pushes"] is None else Pushes(**values["pushes"]),
            "prior": _prior_from(values["prior"]),
        }
        problem = RegistrationProblem(**shared_arguments(RegistrationProblem, values) | parts)
        check_digest(f"the problem of step {self.step}", problem.digest, recorded=values["digest"])
        check_digest(
            f"all points of step {self.step}", points.digest, recorded=values["points_digest"]
        )
        return problem


def archive_values(step: int, archive: ArchiveSnapshot) -> dict[str, Any]:
    """Return the message `ArchiveSnapshot`."""
    return {"step": step} | shared_values("ArchiveSnapshot", archive)


def archive_from(values: Mapping[str, Any]) -> ArchiveSnapshot:
    """Return the archive in a message; raise RecordingError unless it has its digest."""
    archive = ArchiveSnapshot(**shared_arguments(ArchiveSnapshot, values))
    check_digest(f"an archive of step {values['step']}", archive.digest, recorded=values["digest"])
    return archive


def _rig_values(event: RigDescribed) -> dict[str, Any]:
    """Return the message `Rig`."""
    hand = event.hand
    return shared_values("Rig", event) | {
        "hand_vertices": None if hand is None else np.asarray(hand.vertices, np.float64),
        "hand_faces": None if hand is None else np.asarray(hand.faces, np.int32),
    }


def _rig_from(values: Mapping[str, Any]) -> RigDescribed:
    """Return the rig of a message `Rig`."""
    import trimesh

    hand = None
    if values["hand_vertices"] is not None:
        vertices = values["hand_vertices"].copy()
        faces = values["hand_faces"].astype(np.int64)
        hand = trimesh.Trimesh(vertices, faces, process=False)
    return RigDescribed(**shared_arguments(RigDescribed, values), hand=hand)


@dataclass(frozen=True)
class ImagePlace:
    """The place of a sensor's image among the events; its pixels are read when they matter."""

    topic = SensorImage.topic

    step: int


def image_values(event: SensorImage) -> dict[str, Any]:
    """Return the message `SensorImage`; raise RecordingError for pixels of another shape."""
    values, mask = event.values, event.mask
    if values.dtype != np.uint16 or values.ndim != 2:
        raise RecordingError(
            f"an image has values of {values.dtype} {values.shape}; accepted: uint16 (H, W)"
        )
    if mask.dtype != np.bool_ or mask.shape != values.shape:
        raise RecordingError(
            f"the mask of an image is {mask.dtype} {mask.shape}; accepted: bool {values.shape}"
        )
    return shared_values("SensorImage", event) | {
        "height": values.shape[0],
        "width": values.shape[1],
        "values": zstandard.compress(np.ascontiguousarray(values, _VALUE).tobytes(), _LEVEL),
        "mask": zstandard.compress(np.packbits(mask).tobytes(), _LEVEL),
    }


def image_from(values: Mapping[str, Any]) -> SensorImage:
    """Return the image of a message `SensorImage`; its arrays are read-only.

    Raise RecordingError if it is not as the table accepts it, or has not as many pixels as it
    says.
    """
    check_message("SensorImage", values)
    shape = (values["height"], values["width"])
    count = values["height"] * values["width"]
    pixels = {}
    for name, size in (("values", count * _VALUE.itemsize), ("mask", -(-count // 8))):
        try:
            claimed = zstandard.frame_content_size(values[name])
            pixels[name] = zstandard.decompress(values[name]) if claimed == size else b""
        except zstandard.ZstdError as error:
            raise RecordingError(f"{name} of an image cannot be read: {error}") from None
        if len(pixels[name]) != size:
            raise RecordingError(
                f"{name} of an image of {values['sensor']} have {claimed} bytes; "
                f"accepted: {size} for {shape}"
            )
    depths = np.frombuffer(pixels["values"], _VALUE).astype(np.uint16, copy=False)
    bits = np.frombuffer(pixels["mask"], np.uint8)
    mask = np.unpackbits(bits, count=count).view(np.bool_).reshape(shape)
    mask.setflags(write=False)
    parts = {"values": depths.reshape(shape), "mask": mask}
    return SensorImage(**shared_arguments(SensorImage, values) | parts)


def _offered_values(event: ActionsOffered) -> dict[str, Any]:
    """Return the message `Actions`."""
    return shared_values("Actions", event.actions) | {
        "step": event.step,
        "hand_vertices": event.hand.vertices,
        "hand_faces": event.hand.faces.astype(np.int32),
        "digest": _digest_of(event),
    }


def _offered_from(values: Mapping[str, Any]) -> ActionsOffered:
    """Return the actions in a message; raise RecordingError unless they have their digest."""
    actions = Actions(**shared_arguments(Actions, values))
    hand = HandShape(values["hand_vertices"], values["hand_faces"])
    event = ActionsOffered(values["step"], actions, hand=hand)
    check_digest("the actions offered", _digest_of(event), recorded=values["digest"])
    return event


def _digest_of(event: ActionsOffered) -> str:
    texts = event.actions.digest + event.hand.digest
    return digest(np.frombuffer(texts.encode(), dtype=np.uint8))


def _decision_values(event: Decided) -> dict[str, Any]:
    """Return the message `Decision`."""
    problem = event.problem
    return shared_values("Decision", event.decision) | {
        "step": event.step,
        "poses": problem.belief.object_from_world,
        "weights": problem.belief.weights,
        "available": problem.available,
        "key_seed": problem.key.seed,
        "key_step": problem.key.step,
        "problem_digest": problem.digest,
        "surprise": float(event.surprise),
        "verdict": problem.verdict,
    }


@dataclass(frozen=True, eq=False)
class RecordedDecision:
    """A decision without what its problem has of the events before it."""

    topic: ClassVar[str] = Decided.topic

    values: Mapping[str, Any]  # of the message `Decision`
    decision: Decision

    @property
    def step(self) -> int:
        """Step of the registration that the decision follows."""
        return int(self.values["step"])

    def completed(
        self, start: SessionStarted, offered: ActionsOffered, *, points: KnownPoints
    ) -> Decided:
        """Return it with its whole problem; raise RecordingError unless that was recorded."""
        values = self.values
        problem = DecisionProblem(
            sdf=start.sdf,
            points=points,
            workspace=start.workspace,
            free_resolution=start.free_resolution,
            belief=WeightedPoses(values["poses"], values["weights"]),
            actions=offered.actions,
            available=values["available"],
            hand=offered.hand,
            key=StreamKey(values["key_seed"], values["key_step"]),
            verdict=values["verdict"],
        )
        what = f"the problem of the decision of step {self.step}"
        check_digest(what, problem.digest, recorded=values["problem_digest"])
        return Decided(self.step, problem, decision=self.decision, surprise=values["surprise"])


def decision_from(values: Mapping[str, Any]) -> RecordedDecision:
    """Return the decision in a message; raise RecordingError unless it has its digest."""
    decision = Decision(**shared_arguments(Decision, values))
    check_digest(
        f"the decision of step {values['step']}", decision.digest, recorded=values["digest"]
    )
    return RecordedDecision(values, decision)


def _workspace_from(values: Mapping[str, Any]) -> Workspace:
    """Return the workspace of a message."""
    return Workspace(*values["workspace"].tolist())
