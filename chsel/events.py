"""The events of a session, which it announces to recorders.

`replay.mcap.schemas` says how the message on an event's topic is stored, and what it accepts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from chsel.next_probe.decision_problem import Actions, Decision, DecisionProblem, HandShape
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.pose_prior import PosePrior
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses, RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid

if TYPE_CHECKING:
    import trimesh

_LEAST_SIDEWAYS = 0.2  # horizontal part of the direction of a push that moves the object


@dataclass(frozen=True, kw_only=True)
class Start:
    """When the steps of a session register by themselves."""

    contacts: int = 0  # at least so many are known
    step: int = 0  # not before this one
    steps: tuple[int, ...] | None = None  # of no others than these; None: of all


@dataclass(frozen=True, eq=False, kw_only=True)
class SessionStarted:
    """Opens every recording."""

    topic: ClassVar[str] = "/session"
    step: ClassVar[int] = -1  # before all steps

    runner: str
    object: str
    session: str
    method: str
    seed: int
    config: Mapping[str, Any]  # the resolved configuration, plain values
    mesh: trimesh.Trimesh  # of the object, in its frame, metres
    sdf: SdfGrid
    workspace: Workspace
    free_resolution: float  # side of the voxels of free space, metres
    initial_points: KnownPoints  # known before any probe
    world_from_object: FloatArray | None = None  # (4, 4): the true pose, where known
    # Versions, platform, processor, state of the checkout; no clock, no paths.
    environment: Mapping[str, str] = field(default_factory=dict)
    # Digest of the recording whose problems these are, "" if the session made its own.
    source: str = ""
    # None where a program asks for each registration, and in recordings of earlier versions.
    start: Start | None = None
    # Metres that a touch moves the object at most; None in recordings of earlier versions.
    moves: float | None = None
    # On the pose before the first probe; None: nothing is known of it.
    prior: PosePrior | None = None


@dataclass(frozen=True, eq=False)
class RigDescribed:
    """The sensors of a recorded robot session, and the raw log that they wrote; at most one."""

    topic: ClassVar[str] = "/rig"

    step: int  # -1: before all steps
    name: str
    source: str  # digest of the raw log, which is not part of the recording
    # The solid parts of the hand in its own frame, that of `Probe.gripper_path`, where known.
    hand: trimesh.Trimesh | None = None


@dataclass(frozen=True, eq=False)
class ActionsOffered:
    """The probes that a steered session offers, before the first decision and where they change."""

    topic: ClassVar[str] = "/actions"

    step: int  # of the last probe, -1 before the first
    actions: Actions
    hand: HandShape  # that takes them


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorImage:
    """An image from which known points of a step come; it precedes the step's probe."""

    topic: ClassVar[str] = "/sensor_image"

    step: int
    sensor: str  # its name in the rig
    kind: str  # "depth" of a camera, or "deformation" of a tactile pad
    # (H, W), uint16, in units of `unit`; 0 where nothing is measured, or beyond the workspace
    values: np.ndarray
    unit: float  # metres
    mask: np.ndarray  # (H, W): the pixels that count: those of free rays, or those in contact
    intrinsics: FloatArray  # (4,): fx, fy, cx, cy, pixels
    world_from_camera: FloatArray  # (4, 4): of the optical centre, x right, y down, z forward


@dataclass(frozen=True, eq=False)
class Probe:
    """One probe and what became known with it."""

    topic: ClassVar[str] = "/probe"

    step: int  # index of the probe, from 0
    outcome: str  # "contact", "free" or "points"
    new_points: KnownPoints  # all that becomes known with this probe, contacts included
    # world_from_gripper (P, 4, 4) in order of time; P may be 0.
    gripper_path: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    # (C, 3): on the object's surface, in the world.
    contacts: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    # (C, 3): unit, pointing out of the object, zero where unknown.
    contact_normals: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    # (4, 4): the true pose after the probe, where that moved the object and it is known.
    world_from_object: FloatArray | None = None
    image_points: int = 0  # so many of the new known points, the last, are of an image
    # (W,), ascending: which of the points known before are not of the object after all.
    withdrawn: IntArray | None = None

    @property
    def push(self) -> FloatArray | None:
        """In which direction (3,) a hand that probes along its z axis has pushed the object.

        A horizontal unit vector; None without a contact, for unknown paths, and for pushes down.
        """
        if self.outcome != "contact" or len(self.gripper_path) == 0:
            return None
        x, y, _ = self.gripper_path[-1, :3, 2].tolist()
        length = math.sqrt(x * x + y * y)
        return np.array([x, y, 0.0]) / length if length > _LEAST_SIDEWAYS else None

    def added_to(self, points: KnownPoints) -> KnownPoints:
        """Return all points that are known with this probe, by those that are known before it."""
        if self.withdrawn is not None:
            kept = np.ones(len(points.known), dtype=bool)
            kept[self.withdrawn] = False
            points = points.with_known(kept)
        return points.merged(self.new_points)


@dataclass(frozen=True, eq=False)
class ProblemPosed:
    """A registration starts; with the events before it, this is the whole problem."""

    topic: ClassVar[str] = "/problem"

    step: int
    problem: RegistrationProblem


@dataclass(frozen=True, eq=False)
class SnapshotTaken:
    """The archive at one moment of a registration."""

    topic: ClassVar[str] = "/archive"

    step: int
    archive: ArchiveSnapshot


@dataclass(frozen=True)
class Traced:
    """State of a stage of a registration at its start or after a block of iterations."""

    topic: ClassVar[str] = "/trace"

    step: int
    stage: str
    iteration: int
    digest: str  # of the search vectors and costs (B,)
    lowest_cost: float
    median_cost: float
    highest_cost: float

    @property
    def costs(self) -> tuple[float, float, float]:
        """Lowest, median and highest cost."""
        return self.lowest_cost, self.median_cost, self.highest_cost


@dataclass(frozen=True, eq=False)
class HypothesesFound:
    """A registration ends."""

    topic: ClassVar[str] = "/hypotheses"

    step: int
    hypotheses: Hypotheses


@dataclass(frozen=True)
class Measured:
    """Numbers about a step that follow from the recorded values alone (no clock among them).

    Names are `snake_case` and carry the unit where it is not SI, such as
    best_position_error, best_rotation_error, distinct_hypotheses, coverage_mm2.
    """

    topic: ClassVar[str] = "/measured"

    step: int
    values: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Decided:
    """The probe that a policy takes next, or why none; it follows the results of its step."""

    topic: ClassVar[str] = "/decision"

    step: int  # of the last probe, -1 before the first; that taken is of the next step
    problem: DecisionProblem
    decision: Decision
    # Of the outcome of the last probe under the decision before, nats; 0 for the first decision.
    surprise: float


@dataclass(frozen=True, eq=False)
class Believed:
    """The belief after a result, mode by mode; see `chsel.PoseBelief`."""

    topic: ClassVar[str] = "/belief"

    step: int
    numbers: IntArray  # (M,), of the modes, the same from step to step
    weights: FloatArray  # (M,), shares of the members
    object_from_world: FloatArray  # (M, 4, 4), the best of each
    centres: FloatArray  # (M, 3), of the object in these poses, world
    covariances: FloatArray  # (M, 6, 6), of centres (metres) and rotation vectors (radians)
    spread: float  # of the members, metres


@dataclass(frozen=True)
class Timed:
    """Wall-clock seconds by stage. With it no two recordings are equal to the byte."""

    topic: ClassVar[str] = "/timed"

    step: int
    seconds: Mapping[str, float]


@dataclass(frozen=True)
class Logged:
    """A line of text."""

    topic: ClassVar[str] = "/log"

    step: int
    level: str  # "info" or "warning"
    text: str


@dataclass(frozen=True)
class SessionEnded:
    """Closes a recording."""

    topic: ClassVar[str] = "/session_ended"

    step: int
    # "finished", "interrupted", "failed: REASON", or "recovered: REASON" where a damaged recording
    # has no end.
    outcome: str


Event = (
    SessionStarted
    | RigDescribed
    | ActionsOffered
    | SensorImage
    | Probe
    | ProblemPosed
    | SnapshotTaken
    | Traced
    | HypothesesFound
    | Measured
    | Decided
    | Believed
    | Timed
    | Logged
    | SessionEnded
)


class Recorder:
    """Writes nothing down; each kind of recorder does more in some of these methods."""

    def check(self, event: Event) -> None:
        """Raise RecordingError for an event whose values cannot be recorded."""

    def record(self, event: Event) -> None:
        """Take one event; events of one session come in the order in which things happen."""

    def flush(self) -> None:
        """Make sure that all events so far survive the end of the process."""

    def close(self) -> None:
        """Finish what was written. Closing twice is closing once."""


class ListRecorder(Recorder):
    """Keeps the events in `events`."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def record(self, event: Event) -> None:
        """Keep it."""
        self.events.append(event)
