"""A topic of points: rays that are free, or the object's surface."""

from __future__ import annotations

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.points import Lattice
from chsel.problem.poses import apply
from chsel.sensing.depth_camera import main_regions, point_regions
from runners.sensors.cell import RobotCell, is_entered
from runners.sensors.first_pass import FirstPass, SensorTopic
from runners.sensors.log.messages import CloudMessage
from runners.sensors.rig import CloudRig
from runners.sensors.sensor import Sensed, without_normals
from runners.sensors.session_report import Counts

_MOST_OUTSIDE = 0.99  # of its points: more are no object's
FARTHEST = 100.0  # m: no robot that probes an object measures rays of this length


class Cloud:
    """A sensor that sends points: the ends of free rays, the object's surface, or contacts."""

    _cell: RobotCell
    _lattice: Lattice

    def __init__(self, rig: CloudRig, resolution: float) -> None:
        """Make the sensor; of surface points one a voxel of side `resolution`, metres, is kept."""
        self.name = rig.topic
        self.topics = (SensorTopic(rig.topic, CloudMessage, use="points"),)
        self.frame = None
        self._rig = rig
        self._resolution = resolution
        self._touches = rig.role == "contacts"
        self._seen: set[tuple[int, int, int]] = set()
        self._new: list[FloatArray] = []
        self._middle: FloatArray | None = None  # (3,), of the first message's points, world
        self._reaches = rig.role != "rays"  # whether its rays reach the workspace

    def prepare(self, first_pass: FirstPass, cell: RobotCell) -> None:
        """Keep the cell."""
        self._cell = cell
        self._lattice = Lattice(cell.free.workspace.lower, self._resolution)

    def take(self, time: int, message: CloudMessage, *, counts: Counts, within: bool) -> None:
        """Use the points of one message of the current probe."""
        counts.images += 1
        if self._touches and not within:
            counts.spared += 1
            return
        pose = self._cell.world_from(message.frame, time, sensor=self._rig.topic)
        if pose is None:
            counts.lost += 1
            return
        points = message.points[np.isfinite(message.points).all(axis=1)]
        counts.pixels += len(message.points)
        counts.invalid += len(message.points) - len(points)
        counts.used += 1
        points = apply(pose, points)
        origin = pose[:3, 3]
        free = self._cell.free
        if self._middle is None and len(points):
            self._middle = np.median(points, axis=0)
        if self._rig.role == "rays":
            reached = ((points - origin) ** 2).sum(axis=1) <= FARTHEST**2
            ends = origin + self._rig.fraction * (points[reached] - origin)
            counts.free += free.grid.along_rays(origin, ends)
            self._reaches = self._reaches or is_entered(free.workspace, origin, ends=ends)
        else:
            reached = free.within(points)
            self._new.append(self._unseen(points[reached], counts))
        counts.outside += int((~reached).sum())

    def finish(self, step: int, counts: Counts) -> Sensed:
        """Return the points on the object that came in a probe."""
        points = without_normals(np.concatenate([np.zeros((0, 3)), *self._new]))
        self._new = []
        return Sensed(contacts=points) if self._touches else Sensed(surface=points)

    def remark(self, total: Counts) -> str:
        """Return what is suspicious about all that it gave; "" if nothing is."""
        measured = total.pixels - total.invalid
        if total.used and not measured:
            return f"its {total.used} messages have no point that is finite"
        if self._middle is None:
            return ""
        middle = ", ".join(f"{value:.4g}" for value in self._middle)
        where = f"in the first message around [{middle}] m in the world"
        if total.outside > _MOST_OUTSIDE * measured:
            reach = "out of the workspace"
            if self._rig.role == "rays":
                reach = f"over {FARTHEST:g} m away"
            share = "all" if total.outside == measured else f"of {measured} points"
            text = f"{share} {total.outside} points are {reach}, {where}"
        elif not self._reaches:
            text = f"its rays miss the workspace, their points are {where}"
        else:
            return ""
        return f"{text}; check its unit and frame, and the workspace"

    def _unseen(self, points: FloatArray, counts: Counts) -> FloatArray:
        """Return the first point of every voxel that had none, of those that are the object's."""
        _, first = np.unique(self._lattice.voxels(points), axis=0, return_index=True)
        points = points[np.sort(first)]
        gate = self._cell.gate
        found = main_regions(
            point_regions(points, gate.gap),
            part=gate.part,
            points=points,
            diameter=self._cell.diameter,
        )
        counts.small += found.small
        counts.far += found.far
        points = points[found.kept]
        voxels = [tuple(voxel) for voxel in self._lattice.voxels(points).tolist()]
        new = [voxel not in self._seen for voxel in voxels]
        self._seen.update(voxels)
        return points[np.array(new, dtype=bool)]
