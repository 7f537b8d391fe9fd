"""The robot cell in MuJoCo: what its cameras see by rays, and what touches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import rotated
from runners.sensors.rig import BoxRig
from runners.sessions.physics_engine import import_mujoco
from runners.simulated_robot import cabinet
from runners.simulated_robot.scene import AWAY
from runners.simulated_robot.settings import RenderedCamera

_LOOKS, _UNSEEN = 0, 1  # groups of geoms: what cameras see, and what they do not
_SEEN = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)
_RADIUS = 1e-6  # m: half the thickness of the object's faces, which the engine wants above 0


class MuJoCoScene:
    """The scene in MuJoCo; see `Scene`. The object is a surface of triangles, as it is concave."""

    def __init__(self, mesh: trimesh.Trimesh, world_from_object: FloatArray) -> None:
        """Make the scene of a mesh in its frame, metres. Raise SessionError without MuJoCo."""
        self._mujoco = mujoco = import_mujoco()
        spec = mujoco.MjSpec()
        thing = spec.worldbody.add_body(
            name="object",
            pos=world_from_object[:3, 3],
            quat=_quaternion(world_from_object[:3, :3]),
        )
        self._add_look(spec, thing, name="object", mesh=mesh)
        flex = spec.add_flex()
        flex.name = "object"
        flex.dim = 2
        flex.radius = _RADIUS
        flex.vertbody = ["object"]
        flex.vert = np.asarray(mesh.vertices).ravel()
        flex.elem = np.asarray(mesh.faces).ravel()
        self._add_boxes(spec.worldbody, cabinet.CABINET, group=_LOOKS)
        self._add_boxes(spec.worldbody, cabinet.ROOM, group=_LOOKS)
        hand = spec.worldbody.add_body(name="hand", mass=1.0, inertia=np.ones(3))
        hand.explicitinertial = True
        hand.add_freejoint()
        self._add_look(spec, hand, name="hand", mesh=cabinet.whole_mesh())
        self._add_boxes(hand, cabinet.rigid_parts(), group=_UNSEEN)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)

    def depth(
        self,
        camera: RenderedCamera,
        world_from_camera: FloatArray,
        *,
        world_from_wrist: FloatArray = AWAY,
    ) -> FloatArray:
        """Return what the rays of all pixels meet; nothing is nearer than the near plane."""
        self._place(world_from_wrist)
        directions = camera.directions().reshape(-1, 3)
        rays = rotated(world_from_camera[:3, :3], directions)
        depth = np.full(len(rays), camera.far)
        found = np.empty(len(rays))
        self._mujoco.mj_multiRay(
            self._model,
            self._data,
            world_from_camera[:3, 3],
            rays.ravel(),
            _SEEN,
            True,
            -1,
            np.empty(len(rays), dtype=np.int32),
            found,
            None,
            len(rays),
            camera.far * float(np.sqrt((directions**2).sum(axis=1)).max()),
        )
        met = (found >= camera.near) & (found < camera.far)
        depth[met] = found[met]
        return depth.reshape(camera.height, camera.width)

    def is_blocked(self, world_from_wrist: FloatArray) -> bool:
        """Return whether there is a contact, which is always of the hand."""
        self._place(world_from_wrist)
        self._mujoco.mj_collision(self._model, self._data)
        return bool((self._data.contact.dist <= 0.0).any())

    def close(self) -> None:
        """Release nothing, as the engine's memory goes with this object."""

    def _place(self, world_from_wrist: FloatArray) -> None:
        self._data.qpos[:3] = world_from_wrist[:3, 3]
        self._data.qpos[3:] = _quaternion(world_from_wrist[:3, :3])
        self._mujoco.mj_fwdPosition(self._model, self._data)

    def _add_look(self, spec: Any, body: Any, *, name: str, mesh: trimesh.Trimesh) -> None:
        """Add to a body what it looks like, which touches nothing."""
        look = spec.add_mesh(
            name=name,
            uservert=np.asarray(mesh.vertices, dtype=np.float64).ravel(),
            userface=np.asarray(mesh.faces, dtype=np.int32).ravel(),
        )
        look.inertia = self._mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        body.add_geom(
            type=self._mujoco.mjtGeom.mjGEOM_MESH,
            meshname=name,
            group=_LOOKS,
            contype=0,
            conaffinity=0,
        )

    def _add_boxes(self, body: Any, boxes: Sequence[BoxRig], *, group: int) -> None:
        """Add solid boxes to a body."""
        for box in boxes:
            body.add_geom(
                type=self._mujoco.mjtGeom.mjGEOM_BOX,
                size=[side / 2.0 for side in box.size],
                pos=list(box.position),
                quat=Rotation.from_euler("xyz", box.rotation).as_quat(scalar_first=True),
                group=group,
            )


def _quaternion(rotation: FloatArray) -> FloatArray:
    """Return the quaternion (4,), w first, of a rotation (3, 3)."""
    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)
