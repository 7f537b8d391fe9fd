"""The hand's way through the workspace, and what it sweeps."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.problem.points import Lattice
from chsel.problem.poses import apply, inverse
from chsel.sensing.free_space import interior_lattice, poses_between
from runners.sensors.cell import RobotCell
from runners.sensors.contacts import PushEnd
from runners.sensors.hand import HandModel
from runners.sensors.log.probe_windows import ProbeWindow
from runners.sensors.log.transforms import JointHistory
from runners.sensors.rig import HandRig
from runners.sensors.session_report import Counts

if TYPE_CHECKING:
    import trimesh

MOST_POSES = 200  # of a probe's path, as it is shown
_BATCH = 50_000  # poses looked up at once

# The reference's sweep (methods, Sec. 10.3): a box of nodes between the pads, a little behind
# their foremost point, and the ways back, in metres.
_FILLING_DEPTH = np.linspace(-0.010, -0.005, 10)
_FILLING_NODES = 30
_BACKWARDS = np.linspace(0.02, 0.15, 10)


class HandPath:
    """Where the hand was, probe by probe, and the free space that follows."""

    def __init__(
        self, rig: HandRig, model: HandModel, joints: JointHistory, times: IntArray, cell: RobotCell
    ) -> None:
        """times (T,): of all transforms, nanoseconds, ascending."""
        self._rig, self._model, self._joints, self._times = rig, model, joints, times
        self._cell = cell
        self._filled_parts: dict[int, tuple[FloatArray, FloatArray]] = {}

    def follow(self, window: ProbeWindow, counts: Counts) -> FloatArray:
        """Sweep the hand along the path of a probe; some of its poses (P, 4, 4), in their order."""
        shown = [np.zeros((0, 4, 4))]
        states = self._joints.during(window.opens, window.closes)
        ends = [time for time, _ in states[1:]] + [window.closes]
        for (begin, joints), end in zip(states, ends, strict=True):
            interior = self._interior(joints)
            for poses in self._runs(begin, end, counts):
                dense = self._dense(poses, interior)
                if self._rig.sweep == "path" and len(interior):
                    with self._cell.free.by(counts) as grid:
                        grid.at(interior, poses=dense)
                shown.append(dense)
        path = np.concatenate(shown)
        count = min(len(path), MOST_POSES)
        return path[np.linspace(0, len(path) - 1, count).astype(int)]

    def backwards(self, push_end: PushEnd, counts: Counts) -> None:
        """Sweep the pads' points and what is between them back along the hand's z axis."""
        world_from_hand = push_end.world_from_hand
        points = apply(inverse(world_from_hand), push_end.membranes)
        low, high = points.min(axis=0), points.max(axis=0)
        axes = [np.linspace(low[i], high[i], _FILLING_NODES) for i in (0, 1)]
        axes.append(high[2] + _FILLING_DEPTH)
        filling = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        points = np.concatenate([points, filling])
        with self._cell.free.by(counts) as grid:
            for offset in _BACKWARDS:
                grid.at(apply(world_from_hand, points - [0.0, 0.0, offset]))

    def _runs(self, begin: int, end: int, counts: Counts) -> Iterator[FloatArray]:
        """Poses (P, 4, 4) from a time to before another, cut where they are not known for long."""
        times = self._times[np.searchsorted(self._times, begin) : np.searchsorted(self._times, end)]
        for start in range(0, len(times), _BATCH):
            # One pose of the batch before, so that nothing is missing between them.
            stamps = times[max(start - 1, 0) : start + _BATCH]
            poses, known = self._cell.tree.lookups(
                self._cell.world, self._rig.frame, stamps, gap_s=self._cell.gap
            )
            counts.images += len(stamps)
            counts.used += int(known.sum())
            counts.lost += int(len(stamps) - known.sum())
            poses, stamps = poses[known], stamps[known]
            cuts = np.flatnonzero(np.diff(stamps) > self._cell.gap * 1e9) + 1
            yield from (run for run in np.split(poses, cuts) if len(run))

    def _dense(self, poses: FloatArray, interior: FloatArray) -> FloatArray:
        """Poses so close that no interior point moves by more than half a voxel in between."""
        reach = float(np.sqrt((interior**2).sum(axis=1).max(initial=0.0)))
        return poses_between(poses, step=0.5 * self._cell.spacing, radius=reach)

    def _interior(self, joints: dict[str, float]) -> FloatArray:
        """Points (M, 3) in the hand, dense enough to miss no voxel."""
        parts = enumerate(self._model.parts(joints))
        points = np.concatenate([np.zeros((0, 3)), *(self._nodes(*part) for part in parts)])
        lattice = Lattice((0.0, 0.0, 0.0), 0.5 * self._cell.spacing)
        return lattice.centres(np.unique(lattice.voxels(points), axis=0))

    def _nodes(self, number: int, part: trimesh.Trimesh) -> FloatArray:
        """Points (M, 3) in a part; found again only once it has moved in the hand."""
        vertices = np.array(part.vertices)
        known = self._filled_parts.get(number)
        if known is None or not np.array_equal(known[0], vertices):
            known = vertices, interior_lattice(part, 0.5 * self._cell.spacing)
            self._filled_parts[number] = known
        return known[1]
