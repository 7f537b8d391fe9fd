"""What every session offers, wherever its points come from."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Protocol

from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints, Workspace
from replay.events import Logged, Probe, RigDescribed, SensorImage

SessionEvent = RigDescribed | SensorImage | Logged | Probe
"""What a session yields: probes, and ahead of each what else is to be recorded about it."""

Progress = Callable[[str, int, int], None]
"""Told what is being done, and how much of how much of it is done."""


def unwatched(stage: str, done: int, total: int) -> None:
    """The progress where none is shown."""


class Session(Protocol):
    """A source of known points, probe by probe. The object does not move in a session."""

    workspace: Workspace
    """Where the object can be."""

    free_resolution: float
    """Side in metres of the voxels that free points are merged into."""

    world_from_object: FloatArray | None
    """The true pose (4, 4) of the mesh frame, where known."""

    initial_points: KnownPoints
    """What is known before the first probe."""

    count: int
    """How many probes there will be."""

    def probes(self) -> Iterator[SessionEvent]:
        """Do, or read, one probe after the other; events that are no Probe are to be recorded."""

    def close(self) -> None:
        """Let go of engines and files."""
