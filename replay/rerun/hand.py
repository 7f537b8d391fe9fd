"""The hand of a robot session in the scene: its mesh where each probe brought it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from chsel.numerics.arrays import FloatArray
from replay.events import Probe
from replay.rerun.colors import HAND
from replay.rerun.hypotheses import DISPLAY_FACES, coarsened
from replay.rerun.scene import bare_mesh, display_mesh

if TYPE_CHECKING:
    import trimesh

_ALPHA = 80
_HIDDEN = np.zeros((1, 4, 4))  # without any pose, the viewer draws the mesh once, at the origin


class HandMesh:
    """Draws the hand at one entity: the mesh is stored once, with a pose a probe."""

    def __init__(self, stream: rr.RecordingStream, entity: str = "scene/hand") -> None:
        self._stream = stream
        self._entity = entity
        self._drawn = False

    def set_up(self, hand: trimesh.Trimesh) -> None:
        """Store the mesh, and show none yet."""
        coarse = coarsened(bare_mesh(hand), DISPLAY_FACES)
        self._stream.log(self._entity, display_mesh(coarse, (*HAND, _ALPHA)), static=True)
        self._drawn = True
        self._put(_HIDDEN)

    def draw(self, probe: Probe) -> None:
        """The hand where the probe is deepest; none if it has no path."""
        if self._drawn:
            path = probe.gripper_path
            self._put(path[None, deepest(path)] if len(path) else _HIDDEN)

    def _put(self, world_from_hand: FloatArray) -> None:
        poses = rr.InstancePoses3D(
            translations=world_from_hand[:, :3, 3].astype(np.float32),
            mat3x3=world_from_hand[:, :3, :3].astype(np.float32),
        )
        self._stream.log(self._entity, poses)


def deepest(gripper_path: FloatArray) -> int:
    """Index of the pose (P, 4, 4) that is furthest forward: along z of the first, the approach."""
    advance = (gripper_path[:, :3, 3] - gripper_path[0, :3, 3]) @ gripper_path[0, :3, 2]
    return int(np.argmax(advance))
