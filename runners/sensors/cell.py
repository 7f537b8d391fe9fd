"""What all sensors of a robot cell share: where things are, what is free, warnings."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import sqrt

import numpy as np
from scipy.spatial import cKDTree

from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.points import Workspace
from chsel.sensing.free_space import FreeGrid
from runners.sensors.log.transforms import TransformError, TransformTree
from runners.sensors.rig import GateRig
from runners.sensors.session_report import Counts, LogWarnings

_NONE = np.zeros((0, 3))


class FreeMap:
    """The voxels of the workspace that are known to be free."""

    def __init__(self, workspace: Workspace, spacing: float) -> None:
        self.workspace = workspace
        self.grid = FreeGrid(workspace, spacing)
        self._reported = np.zeros(self.grid.shape, dtype=bool)

    @contextmanager
    def by(self, counts: Counts) -> Iterator[FreeGrid]:
        """The grid to mark in; what becomes free within is counted as the counts'."""
        before = self.grid.count
        yield self.grid
        counts.free += self.grid.count - before

    def new(self, contacts: FloatArray = _NONE, normals: FloatArray = _NONE) -> FloatArray:
        """Centres (N, 3) of the voxels that became free since the last call.

        Left out are those less than a voxel's diagonal from contacts (C, 3) with a rigid hand, and
        behind them by the object's outward normals (C, 3): the hand passed such a voxel, but not
        its centre.
        """
        centres = self.grid.new()
        if len(contacts) and len(centres):
            reach = sqrt(3.0) * self.grid.lattice.spacing
            away, nearest = cKDTree(contacts).query(centres, distance_upper_bound=reach)
            near = np.flatnonzero(away <= reach)
            beside = nearest[near]
            ahead = ((centres[near] - contacts[beside]) * normals[beside]).sum(axis=1)
            centres = np.delete(centres, near[ahead < 0.0], axis=0)
        self._reported[tuple(self.grid.lattice.voxels(centres).T)] = True
        return centres

    def holds(self, points: FloatArray) -> BoolArray:
        """Which of points (N, 3) lie in voxels that `new` has given."""
        voxels = self.grid.lattice.voxels(points)
        inside = ((voxels >= 0) & (voxels < self.grid.shape)).all(axis=1)
        held = np.zeros(len(points), dtype=bool)
        held[inside] = self._reported[tuple(voxels[inside].T)]
        return held

    def within(self, points: FloatArray) -> BoolArray:
        """Which of points (N, 3) lie in the workspace, or less than a voxel beside it."""
        margin = self.grid.lattice.spacing
        lower, upper = self.workspace.bounds
        return ((points >= lower - margin) & (points <= upper + margin)).all(axis=1)


@dataclass(frozen=True)
class RobotCell:
    """The frames, the free space, and what holds for all sensors."""

    world: str  # the frame of all known points
    tree: TransformTree
    gap: float  # seconds over which no pose is interpolated
    free: FreeMap
    warnings: LogWarnings
    gate: GateRig = field(default_factory=GateRig)
    diameter: float | None = None  # of the object, metres; None: not known

    @property
    def spacing(self) -> float:
        """Side of a free voxel, metres."""
        return self.free.grid.lattice.spacing

    def world_from(self, frame: str, time: int, sensor: str) -> FloatArray | None:
        """Pose (4, 4) of a frame at a time in nanoseconds; None, with a warning, where unknown."""
        try:
            return self.tree.lookup(self.world, frame, time, gap_s=self.gap)
        except TransformError:
            self.warnings.warn(f"{sensor}: left out, as the pose of {frame} is not known then")
            return None
