"""The robot cell that all sensors share: transforms, free space, warnings."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import sqrt

import numpy as np

from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.points import Workspace
from chsel.sensing.free_space import FreeGrid
from runners.sensors.log.transforms import TransformError, TransformTree
from runners.sensors.rig import GateRig
from runners.sensors.session_report import LogWarnings
from runners.sensors.surface_points import SurfacePoints

_LEAST_ENTERING = 0.001  # of a sensor's rays: fewer in the workspace are there by chance


class FreeMap:
    """The voxels of the workspace that are known to be free."""

    def __init__(self, workspace: Workspace, spacing: float) -> None:
        self.workspace = workspace
        self.grid = FreeGrid(workspace, spacing)

    def new(self, contacts: SurfacePoints | None = None) -> FloatArray:
        """Return centres (N, 3) of the voxels that became free since the last call.

        Left out are those less than a voxel's diagonal from contacts with a rigid hand, and behind
        them by `contact_normals`: the hand passed such a voxel, but not its centre.
        """
        from scipy.spatial import cKDTree

        centres = self.grid.new()
        if contacts is None or len(contacts) == 0 or len(centres) == 0:
            return centres
        reach = sqrt(3.0) * self.grid.lattice.spacing
        away, nearest = cKDTree(contacts.points).query(centres, distance_upper_bound=reach)
        near = np.flatnonzero(away <= reach)
        beside = contacts.chosen(nearest[near])
        ahead = ((centres[near] - beside.points) * beside.contact_normals).sum(axis=1)
        return np.delete(centres, near[ahead < 0.0], axis=0)

    def within(self, points: FloatArray) -> BoolArray:
        """Return which points (N, 3) lie in the workspace, or less than a voxel beside it."""
        margin = self.grid.lattice.spacing
        lower, upper = self.workspace.bounds
        return ((points >= lower - margin) & (points <= upper + margin)).all(axis=1)


def is_entered(workspace: Workspace, origin: FloatArray, *, ends: FloatArray) -> bool:
    """Return whether over a thousandth of segments from origin (3,) to ends (N, 3) enter it."""
    lower, upper = workspace.bounds
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (lower - origin) / (ends - origin), (upper - origin) / (ends - origin)
    begin = np.fmax(np.fmin(first, second).max(axis=1, initial=0.0), 0.0)
    end = np.fmin(np.fmax(first, second).min(axis=1, initial=1.0), 1.0)
    return bool((begin <= end).sum() > _LEAST_ENTERING * len(ends))


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

    def world_from(self, frame: str, time: int, *, sensor: str) -> FloatArray | None:
        """Return the pose (4, 4) of a frame at a time, ns; None, with a warning, if unknown."""
        try:
            return self.tree.lookup(self.world, frame, stamp_ns=time, gap_s=self.gap)
        except TransformError:
            self.warnings.warn(f"{sensor}: left out, as the pose of {frame} is not known then")
            return None
