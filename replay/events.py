"""What happens in a session: the values that recorders write and readers give back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses, RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, eq=False)
class SessionStarted:
    """Opens every recording.

    config: the resolved configuration, plain values. mesh: of the object, in its frame, metres.
    world_from_object (4, 4): the true pose, where known. initial_points: known before any probe.
    environment: versions, platform, processor, state of the checkout; no clock, no paths.
    source: digest of the recording whose problems these are, "" if the session made its own.
    """

    runner: str
    object: str
    session: str
    method: str
    seed: int
    config: Mapping[str, Any]
    mesh: trimesh.Trimesh
    sdf: SdfGrid
    workspace: Workspace
    free_resolution: float
    initial_points: KnownPoints
    world_from_object: FloatArray | None = None
    environment: Mapping[str, str] = field(default_factory=dict)
    source: str = ""


@dataclass(frozen=True, eq=False)
class RigDescribed:
    """The sensors of a recorded robot session, and the raw log that they wrote.

    Comes at most once, before all steps: its own is -1. name: of the rig. source: digest of the raw
    log, which is not part of the recording. hand: its solid parts in its own frame, that of
    `Probe.gripper_path`, where known.
    """

    step: int
    name: str
    source: str
    hand: trimesh.Trimesh | None = None


@dataclass(frozen=True, eq=False)
class SensorImage:
    """An image from which known points of a step come; it precedes the step's probe.

    sensor: its name in the rig. kind: "depth" of a camera, or "deformation" of a tactile pad.
    values (H, W): uint16, in units of `unit` metres, 0 where there is no measurement. mask (H, W):
    the pixels that count: those whose rays are free, or those in contact. intrinsics (4,): fx, fy,
    cx, cy, pixels. world_from_camera (4, 4): of the optical centre, x right, y down, z forward.
    """

    step: int
    sensor: str
    kind: str
    values: np.ndarray
    unit: float
    mask: np.ndarray
    intrinsics: FloatArray
    world_from_camera: FloatArray


@dataclass(frozen=True, eq=False)
class Probe:
    """One probe and what it told.

    step: index of the probe, from 0. gripper_path (P, 4, 4): world_from_gripper, in order of time,
    P may be 0. contacts (C, 3): on the object's surface, in the world. contact_normals (C, 3):
    unit, pointing out of the object, zero where unknown. outcome: "contact", "free" or "points".
    new_points: all that becomes known with this probe, contacts included.
    """

    step: int
    outcome: str
    new_points: KnownPoints
    gripper_path: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    contacts: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    contact_normals: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class ProblemPosed:
    """A registration starts; with the events before it, this is the whole problem."""

    step: int
    problem: RegistrationProblem


@dataclass(frozen=True, eq=False)
class SnapshotTaken:
    """The archive at one moment of a registration."""

    step: int
    archive: ArchiveSnapshot


@dataclass(frozen=True)
class Traced:
    """Where a stage of a registration stands at its start or after a block of iterations.

    digest: of the search vectors and costs. costs: lowest, median and highest, over B.
    """

    step: int
    stage: str
    iteration: int
    digest: str
    costs: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class HypothesesFound:
    """A registration ends."""

    step: int
    hypotheses: Hypotheses


@dataclass(frozen=True)
class Measured:
    """Numbers about a step that follow from the recorded values alone (no clock among them).

    Names are `snake_case` and carry the unit where it is not SI, such as
    best_position_error, best_rotation_error, distinct_hypotheses, coverage_mm2.
    """

    step: int
    values: Mapping[str, float]


@dataclass(frozen=True)
class Timed:
    """Wall-clock seconds by stage. With it no two recordings are equal to the byte."""

    step: int
    seconds: Mapping[str, float]


@dataclass(frozen=True)
class Logged:
    """A line of text; level is "info" or "warning"."""

    step: int
    level: str
    text: str


@dataclass(frozen=True)
class SessionEnded:
    """Closes a recording.

    outcome: "finished", "interrupted", "failed: REASON", or "recovered: REASON" where a damaged
    recording did not tell.
    """

    step: int
    outcome: str


Event = (
    SessionStarted
    | RigDescribed
    | SensorImage
    | Probe
    | ProblemPosed
    | SnapshotTaken
    | Traced
    | HypothesesFound
    | Measured
    | Timed
    | Logged
    | SessionEnded
)


class Recorder(Protocol):
    """Writes events down."""

    def record(self, event: Event) -> None:
        """Take one event; events of one session come in the order in which things happen."""

    def flush(self) -> None:
        """Make sure that all events so far survive the end of the process."""

    def close(self) -> None:
        """Finish what was written. Closing twice is closing once."""
