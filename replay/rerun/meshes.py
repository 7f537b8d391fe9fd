"""Meshes in the scene: how they are drawn, at which poses, and the hand of a robot session."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from chsel.numerics.arrays import FloatArray
from replay.colors import HAND
from replay.events import Probe

if TYPE_CHECKING:
    import trimesh

    from chsel.next_probe.decision_problem import HandShape

DISPLAY_FACES = 6000
"""Meshes with more faces are coarsened for display."""
HIDDEN = np.zeros((1, 4, 4))
"""A pose that shows nothing: without any, the viewer draws the mesh once, at the origin."""
_HAND_ALPHA = 80


def bare_mesh(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Vertices and faces alone, as an MCAP file keeps them; normals follow from these."""
    import trimesh

    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def display_mesh(
    mesh: trimesh.Trimesh, color: tuple[int, int, int, int] | None = None
) -> rr.Mesh3D:
    """A mesh for the viewer, float32, smoothly shaded; None leaves its one colour open."""
    return rr.Mesh3D(
        vertex_positions=np.asarray(mesh.vertices, dtype=np.float32),
        triangle_indices=np.asarray(mesh.faces, dtype=np.uint32),
        vertex_normals=np.asarray(mesh.vertex_normals, dtype=np.float32),
        albedo_factor=color,
    )


def mesh_poses(world_from_mesh: FloatArray) -> rr.InstancePoses3D:
    """Where the mesh of an entity is drawn, once at each pose (N, 4, 4)."""
    return rr.InstancePoses3D(
        translations=world_from_mesh[:, :3, 3].astype(np.float32),
        mat3x3=world_from_mesh[:, :3, :3].astype(np.float32),
    )


def coarsened(mesh: trimesh.Trimesh, most_faces: int) -> trimesh.Trimesh:
    """A mesh of roughly `most_faces` faces for the eye alone: vertices of a cell become one.

    The cell is doubled in number of faces it swallows until few enough are left.
    """
    import trimesh

    faces, vertices = np.asarray(mesh.faces), np.asarray(mesh.vertices)
    cell = float(np.sqrt(mesh.area / max(most_faces, 1)))
    coarse = mesh
    while len(coarse.faces) > most_faces:
        _, group = np.unique(np.rint(vertices / cell), axis=0, return_inverse=True)
        group = group.reshape(-1)
        count = np.bincount(group)
        centres = [np.bincount(group, vertices[:, axis]) / count for axis in range(3)]
        a, b, c = group[faces].T
        kept = (a != b) & (b != c) & (c != a)
        coarse = trimesh.Trimesh(np.stack(centres, axis=1), group[faces][kept], process=False)
        cell *= 1.2
    return coarse


def hand_mesh(hand: HandShape) -> trimesh.Trimesh:
    """The mesh of the hand that takes actions, in its frame."""
    import trimesh

    return trimesh.Trimesh(hand.vertices, hand.faces, process=False)


class HandMesh:
    """Draws the hand at one entity: the mesh is stored once, with a pose a probe."""

    def __init__(self, stream: rr.RecordingStream, entity: str = "scene/hand") -> None:
        self._stream = stream
        self._entity = entity
        self._drawn = False

    def set_up(self, hand: trimesh.Trimesh) -> None:
        """Store the mesh, and show none yet."""
        coarse = coarsened(bare_mesh(hand), DISPLAY_FACES)
        self._stream.log(self._entity, display_mesh(coarse, (*HAND, _HAND_ALPHA)), static=True)
        self._drawn = True
        self._put(HIDDEN)

    def draw(self, probe: Probe) -> None:
        """The hand where the probe is deepest; none if it has no path."""
        if self._drawn:
            path = probe.gripper_path
            self._put(path[None, deepest(path)] if len(path) else HIDDEN)

    def _put(self, world_from_hand: FloatArray) -> None:
        self._stream.log(self._entity, mesh_poses(world_from_hand))


def deepest(gripper_path: FloatArray) -> int:
    """Index of the pose (P, 4, 4) that is furthest forward: along z of the first, the approach."""
    advance = (gripper_path[:, :3, 3] - gripper_path[0, :3, 3]) @ gripper_path[0, :3, 2]
    return int(np.argmax(advance))
