"""What every session offers, wherever its points come from."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from chsel.arrays import FloatArray
from chsel.points import KnownPoints, Workspace
from replay.events import Probe


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

    def probes(self) -> Iterator[Probe]:
        """Do, or read, one probe after the other."""

    def close(self) -> None:
        """Let go of engines and files."""
