"""What every session offers, wherever its points come from."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol, runtime_checkable

from chsel.errors import SessionError
from chsel.events import Logged, Probe, RigDescribed, SensorImage
from chsel.next_probe.action_lattice import ActionSettings
from chsel.next_probe.decision_problem import Actions, HandShape
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.points import KnownPoints, Workspace

ProbeEvent = RigDescribed | SensorImage | Logged | Probe
"""What a session yields: probes, and ahead of each what else is to be recorded about it."""


class ProbeSource(Protocol):
    """A source of known points, probe by probe."""

    workspace: Workspace
    """Where the object can be."""

    free_resolution: float
    """Side in metres of the voxels that free points are merged into."""

    world_from_object: FloatArray | None
    """The true pose (4, 4) of the mesh frame, where known: after the last probe, if it moves."""

    initial_points: KnownPoints
    """What is known before the first probe."""

    count: int
    """How many probes there will be."""

    def probes(self) -> Iterator[ProbeEvent]:
        """Do, or read, one probe after the other; events that are no Probe are to be recorded."""

    def close(self) -> None:
        """Let go of engines and files."""


@runtime_checkable
class Steerable(ProbeSource, Protocol):
    """A session whose probes can be chosen, one after the other, in place of `probes`."""

    hand: HandShape
    """The hand in its own frame, where it probes along z."""

    def offer(self, settings: ActionSettings) -> Actions:
        """The probes that can be chosen from; once, before the first. SettingError for none."""

    def available(self) -> BoolArray:
        """Which of them (A,) can be taken now."""

    def take(self, step: int, action: int) -> Iterator[ProbeEvent]:
        """Do the probe `step` as an action (its index) says; the last event is its Probe.

        Raises SessionError for an action that cannot be taken.
        """


def require_available(action: int, available: BoolArray) -> None:
    """Raise SessionError unless an action is one of those offered and available (A,)."""
    if not 0 <= action < len(available):
        raise SessionError(
            f"action {action} does not exist; accepted: 0 to {len(available) - 1}, as offered"
        )
    if not available[action]:
        raise SessionError(f"action {action} was taken before; accepted: those available")
