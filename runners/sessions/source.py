"""The protocols of sources of probes, wherever their points come from, and what makes a kind."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Protocol, runtime_checkable

from chsel.errors import InputWarning, SessionError
from chsel.events import Logged, Probe, RigDescribed, SensorImage, SessionStarted, Start
from chsel.next_probe.action_lattice import ActionSettings
from chsel.next_probe.decision_problem import Actions, HandShape
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.pose_prior import PosePrior
from runners.objects.loader import ObjectModel
from runners.sensors.session_report import Report

ProbeEvent = RigDescribed | SensorImage | Logged | Probe
"""Event that a source yields: a probe, or before it another event about it, to be recorded."""


class ProbeSource(Protocol):
    """A source of known points, probe by probe. Classes that extend it have its defaults."""

    workspace: Workspace
    """Box in which the object can be."""

    free_resolution: float
    """Side in metres of the voxels that free points are merged into."""

    world_from_object: FloatArray | None
    """True pose (4, 4) of the mesh frame, where known: after the last probe, if it moves."""

    initial_points: KnownPoints
    """Points that are known before the first probe."""

    count: int
    """Number of probes in the order of the source."""

    start: Start
    """Contacts and probe from which a registration is made."""

    push_distance: float = 0.0
    """Largest distance in metres by which a push moves the object, as registration assumes."""

    prior: PosePrior | None = None
    """Prior on the pose of the object before the first probe; None: nothing is known of it."""

    warnings: Sequence[InputWarning] = ()
    """Warnings about the source, for the recording."""

    report: Report | None = None
    """Counts of sensors' messages, filled while probes are read; None without sensors."""

    recorded: SessionStarted | None = None
    """Begin of the recording that brings the object; None: the object is the run's."""

    def probes(self) -> Iterator[ProbeEvent]:
        """Make, or read, one probe after the other; events that are no Probe are to be recorded."""

    def close(self) -> None:
        """Release engines and files, if any are held."""


@runtime_checkable
class Steerable(ProbeSource, Protocol):
    """A source whose probes can be chosen, one after the other, in place of `probes`."""

    @property
    def hand(self) -> HandShape:
        """The hand in its frame, where it probes along z."""

    def offer(self, settings: ActionSettings) -> Actions:
        """Return the probes to choose from; once, before the first. Raise SettingError for none."""

    def available(self) -> BoolArray:
        """Return which of them (A,) can be taken now."""

    def take(self, step: int, action: int) -> Iterator[ProbeEvent]:
        """Make the probe `step` by an action (its index); the last event is its Probe.

        Raise SessionError for an action that cannot be taken.
        """


class ObjectOrigin(Enum):
    """The origin of the object of a source."""

    PLACED = "the source places the run's object, by a configuration"
    REAL = "the points are those of a real object, which the run names"
    RECORDED = "the source brings its object"


@dataclass(frozen=True)
class SourceKind:
    """A kind of sources, the choice `session=KIND`."""

    settings: type[Any]
    """Dataclass of its settings."""

    open: Callable[[Any, ObjectModel | None, int], ProbeSource]
    """Opens a source with its settings, the object, None if it is RECORDED, and the seed.

    Raises ChselError if that is not possible.
    """

    object: ObjectOrigin
    """Origin of the object."""

    keys: Mapping[str, str] = field(default_factory=dict)
    """Values of settings in the option of Hydra, in place of those of the class."""

    groups: Sequence[Mapping[str, str]] = ()
    """Groups of options below that of the kind, each with its usual option."""


def require_available(action: int, available: BoolArray) -> None:
    """Raise SessionError unless an action is one of those offered and available (A,)."""
    if not 0 <= action < len(available):
        raise SessionError(
            f"action {action} does not exist; accepted: 0 to {len(available) - 1}, as offered"
        )
    if not available[action]:
        raise SessionError(f"action {action} was taken before; accepted: those available")
