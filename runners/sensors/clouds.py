"""A topic of points: rays that are free, or the object's surface."""

from __future__ import annotations

import numpy as np

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.problem.points import Lattice
from chsel.problem.poses import apply, rotated
from chsel.sensing.depth_camera import main_regions, point_regions
from runners.sensors.cell import RobotCell, is_entered
from runners.sensors.first_pass import FirstPass, SensorTopic
from runners.sensors.log.messages import CloudMessage
from runners.sensors.rig import NO_NORMALS, CloudRig
from runners.sensors.sensor import Sensed
from runners.sensors.session_report import Counts
from runners.sensors.surface_points import SurfacePoints

_MOST_OUTSIDE = 0.99  # of its points: more are no object's
_NEAR = 2.0  # resolutions: points up to so far away give the plane of a normal
_LEAST_NEAR = 5  # points: fewer give no plane
_SLENDER = 0.05  # of the largest variance: points with a smaller second one are on a line
_FLAT = 0.2  # of the second variance: points with a larger least one are on no plane
_LEAST_FACING = 0.25  # cosine: planes steeper than 76 degrees do not say which side is seen
_OFF_UNIT = 0.01  # by which the length of a normal that is sent may be off 1
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
        self._new: list[SurfacePoints] = []
        self._towards = self._away = 0  # normals that were sent, by whether they face the origin
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
        finite = np.isfinite(message.points).all(axis=1)
        points = message.points[finite]
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
            points = points[reached]
            kept = self._unseen(points, counts)
            sent = None if message.normals is None else message.normals[finite][reached][kept]
            self._add(points, kept, sent=sent, pose=pose)
        counts.outside += int((~reached).sum())

    def finish(self, step: int, counts: Counts) -> Sensed:
        """Return the points on the object that came in a probe."""
        points = SurfacePoints.joined(self._new)
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
        elif self._away > self._towards:
            return (
                f"{self._away} of {self._away + self._towards} normals point away from the origin "
                "of its frame; accepted: normals out of the object"
            )
        else:
            return ""
        return f"{text}; check its unit and frame, and the workspace"

    def _unseen(self, points: FloatArray, counts: Counts) -> IntArray:
        """Return the index of the first point of every voxel that had none, of the object's."""
        _, first = np.unique(self._lattice.voxels(points), axis=0, return_index=True)
        first = np.sort(first)
        points = points[first]
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
        return first[found.kept][np.array(new, dtype=bool)]

    def _add(
        self, points: FloatArray, kept: IntArray, *, sent: FloatArray | None, pose: FloatArray
    ) -> None:
        """Add those of points (N, 3), world, that are kept (K,), with the normals of the rig.

        sent: their normals (K, 3) in the frame of a pose (4, 4), if the message has some.
        """
        normals = None
        if self._rig.normals != NO_NORMALS and sent is None:
            reach = _NEAR * self._resolution
            normals = neighbour_normals(points, kept, reach=reach, towards=pose[:3, 3])
        elif self._rig.normals != NO_NORMALS and sent is not None:
            normals = self._sent_normals(sent, points[kept], pose=pose)
        self._new.append(
            SurfacePoints.measured(points[kept], normals=normals, degrees=self._rig.normals)
        )

    def _sent_normals(
        self, sent: FloatArray, points: FloatArray, *, pose: FloatArray
    ) -> FloatArray:
        """Return unit normals (N, 3), world, of those sent (N, 3) in the frame of a pose (4, 4).

        0 for those that are 0 or not finite, and, with a warning, for those of another length.
        """
        sent = np.where(np.isfinite(sent).all(axis=1, keepdims=True), sent, 0.0)
        length = np.sqrt((sent**2).sum(axis=1, keepdims=True))
        given = length > 0.0
        unit = given & (np.abs(length - 1.0) <= _OFF_UNIT)
        self._cell.warnings.warn(
            f"{self.name}: a normal left out, as its length is not 1", int((given & ~unit).sum())
        )
        normals = rotated(pose[:3, :3], np.where(unit, sent / np.where(unit, length, 1.0), 0.0))
        facing = (normals * (pose[:3, 3] - points)).sum(axis=1)
        self._towards += int((facing > 0.0).sum())
        self._away += int((facing < 0.0).sum())
        return normals


def neighbour_normals(
    points: FloatArray, chosen: IntArray, *, reach: float, towards: FloatArray
) -> FloatArray:
    """Return unit normals (K, 3) at chosen ones of points (N, 3), on the side of `towards` (3,).

    Those of the planes of least squares through all points up to `reach` away, metres; 0 where
    these are fewer than 5, on a line, on no plane, or on one that is seen from beside it.
    """
    from scipy.spatial import cKDTree

    normals = np.zeros((len(chosen), 3))
    if len(chosen) == 0:
        return normals
    near = cKDTree(points).query_ball_point(points[chosen], reach)
    for n, (point, indices) in enumerate(zip(points[chosen], near, strict=True)):
        if len(indices) < _LEAST_NEAR:
            continue
        around = points[np.sort(indices)]
        around = around - around.mean(axis=0)
        variances, axes = np.linalg.eigh(around.T @ around)
        normal = axes[:, 0]
        back = towards - point
        facing = (normal * back).sum()
        if (
            variances[1] > _SLENDER * variances[2]
            and variances[0] < _FLAT * variances[1]
            and abs(facing) > _LEAST_FACING * np.sqrt((back**2).sum())
        ):
            normals[n] = normal if facing > 0.0 else -normal
    return normals
