"""The probes of a recording as actions: a full grid answers any policy that chooses among them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from chsel.errors import SessionError
from chsel.next_probe.action_lattice import ActionSettings, straight_actions
from chsel.next_probe.decision_problem import Actions, HandShape
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.points import KnownPoints, Lattice, Workspace
from chsel.problem.poses import apply, nearest_rigid
from chsel.problem.sdf_grid import mesh_sdf
from chsel.sensing.free_space import interior_lattice, poses_between
from replay.events import Probe

_ASIDE = 0.010  # m: from the line of a push, what is before it
_AT_START = 0.002  # m: within which a push has not begun
_SHORTEST = 0.010  # m: of the longest push of a recording
_FINE = 5.0  # of a voxel's side: steps in which a path is swept
_NODES = 3.0  # of a voxel's side: nodes of the hand's interior
_MOST_VOXELS = 100_000_000
_MOST_NODES = 2e6  # of the hand's interior
_TOGETHER = 200  # poses that are swept at once


class RecordedActions:
    """Probes that can be taken in any order, each once.

    A recording names each voxel of free space once, with the probe that swept it first. A probe
    that is taken out of order sweeps again what earlier ones of the recording had swept: so much
    of its path is free.
    """

    def __init__(
        self,
        probes: Sequence[Probe],
        hand: HandShape,
        workspace: Workspace,
        free_resolution: float,
        *,
        depth: float,
    ) -> None:
        """free_resolution: side of a voxel, metres. depth: of the hand's interior that sweeps.

        Raises SessionError for probes without a push along the hand's z axis.
        """
        self._probes, self._resolution = list(probes), free_resolution
        pushes = [_push(probe) for probe in self._probes]
        self._length = max((length for _, length in pushes), default=0.0)
        if self._length < _SHORTEST:
            raise SessionError(
                f"no probe goes {_SHORTEST:g} m along the z axis of the hand, "
                f"the farthest {self._length:.3g} m; accepted: straight pushes"
            )
        self._starts = np.array([start for start, _ in pushes])  # (A, 4, 4)
        self.available: BoolArray = np.ones(len(self._probes), dtype=bool)
        self._interior = _interior(hand, free_resolution / _NODES, depth)  # (M, 3), hand frame
        self._radius = float(np.sqrt((np.asarray(hand.vertices) ** 2).sum(axis=1)).max())
        free = [probe.new_points.free for probe in self._probes]
        self._free = np.concatenate(free)  # (N, 3), in the order of the recording
        self._first = np.repeat(np.arange(len(free)), [len(points) for points in free])  # (N,)
        self._given = np.zeros(len(self._free), dtype=bool)
        self._lattice = Lattice(workspace.lower, free_resolution)
        self._voxels = self._lattice.voxels(self._free)  # (N, 3)

    def offer(self, settings: ActionSettings) -> Actions:
        """An action for each probe, as long as the longest push of them; reach does not matter."""
        length = np.full(len(self._starts), self._length)
        return straight_actions(replace(settings, reach=None), self._starts, length)

    def take(self, step: int, action: int) -> Probe:
        """The probe of an action, as the one of this step."""
        probe = self._probes[action]
        self.available[action] = False
        chosen = ~self._given & (self._first <= action)
        earlier = np.flatnonzero(chosen & (self._first < action))
        chosen[earlier] = self._swept(self._voxels[earlier], probe.gripper_path)
        self._given |= chosen
        points = probe.new_points
        new = KnownPoints(self._free[chosen], points.occupied, points.known, points.known_sdf)
        return replace(probe, step=step, new_points=new)

    def _swept(self, voxels: np.ndarray, path: FloatArray) -> BoolArray:
        """Which of voxels (N, 3) the hand's interior meets on a path (P, 4, 4)."""
        if len(voxels) == 0 or len(self._interior) == 0:
            return np.zeros(len(voxels), dtype=bool)
        low, high = voxels.min(axis=0), voxels.max(axis=0)
        shape = high - low + 1
        if np.prod(shape, dtype=float) > _MOST_VOXELS:
            raise SessionError(
                f"free points span more than {_MOST_VOXELS} voxels of "
                f"{self._resolution:g} m; accepted: fewer"
            )
        met = np.zeros(shape, dtype=bool)
        poses = poses_between(path, step=self._resolution / _FINE, radius=self._radius)
        for first in range(0, len(poses), _TOGETHER):
            places = apply(poses[first : first + _TOGETHER], self._interior).reshape(-1, 3)
            at = self._lattice.voxels(places) - low
            at = at[((at >= 0) & (at < shape)).all(axis=1)]
            met[tuple(at.T)] = True
        swept: BoolArray = met[tuple((voxels - low).T)]
        return swept


def _push(probe: Probe) -> tuple[FloatArray, float]:
    """Where the push of a probe begins, a pose (4, 4), and how far it goes, metres."""
    path = probe.gripper_path
    if len(path) < 2:
        raise SessionError(
            f"probe {probe.step} has {len(path)} poses of the hand; accepted: the path of its "
            "push, at least 2"
        )
    path = nearest_rigid(f"the hand's path in probe {probe.step}", path)
    z = path[:, :3, 2]
    furthest = int(np.argmax((path[:, :3, 3] * z[0]).sum(axis=1)))
    way = path[: furthest + 1, :3, 3] - path[furthest, :3, 3]
    along = (way * z[furthest]).sum(axis=1)  # not positive, but for curved paths
    aside = np.sqrt(((way - along[:, None] * z[furthest]) ** 2).sum(axis=1))
    off = np.flatnonzero(aside > _ASIDE)
    begin = int(off[-1]) + 1 if len(off) else 0
    waiting = np.flatnonzero(along[begin:] <= along[begin:].min() + _AT_START)
    start = begin + int(waiting[-1])
    return path[start], max(-float(along[start]), 0.0)


def _interior(hand: HandShape, spacing: float, depth: float) -> FloatArray:
    """Points (M, 3) in the hand, deeper than `depth` in one of its bodies, in its frame."""
    import trimesh

    mesh = trimesh.Trimesh(hand.vertices, hand.faces, process=False)
    bodies = [body for body in mesh.split(only_watertight=False) if body.is_watertight]
    count = sum(float(np.prod(body.extents)) for body in bodies) / spacing**3
    if count > _MOST_NODES:
        raise SessionError(
            f"the hand is {count:.3g} times as large as {spacing:.3g} m cubed; "
            f"accepted: at most {_MOST_NODES:g} times"
        )
    deep = [np.zeros((0, 3))]
    for body in bodies:
        nodes = interior_lattice(body, spacing)
        deep.append(nodes[mesh_sdf(body, nodes)[0] < -depth])
    return np.concatenate(deep)
