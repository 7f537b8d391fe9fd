"""The robot cell in PyBullet: what its cameras see by the engine's renderer, and what touches."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import inverse
from runners.sensors.rig import BoxRig
from runners.sessions.physics_engine import connect, silent
from runners.simulated_robot import cabinet
from runners.simulated_robot.scene import AWAY
from runners.simulated_robot.settings import RenderedCamera

_DEPTH = 3  # in the answer of getCameraImage
_DISTANCE = 8  # in a record of getClosestPoints


class PyBulletScene:
    """The scene in PyBullet; see `Scene`."""

    def __init__(self, mesh: trimesh.Trimesh, world_from_object: FloatArray) -> None:
        """Make the scene of a mesh in its frame, metres. Raise SessionError without PyBullet."""
        self._world = connect()
        surroundings = cabinet.mesh_of(cabinet.CABINET + cabinet.ROOM)
        with tempfile.TemporaryDirectory() as folder, silent():
            looks = {"object": mesh, "cabinet": surroundings, "hand": cabinet.whole_mesh()}
            look = {name: self._look(Path(folder) / f"{name}.obj", looks[name]) for name in looks}
            solid = self._world.createCollisionShape(
                self._world.GEOM_MESH,
                fileName=f"{folder}/object.obj",
                flags=self._world.GEOM_FORCE_CONCAVE_TRIMESH,  # no two of these touch each other
            )
            self._fixed = [
                self._body(solid, look["object"], pose=world_from_object),
                self._body(self._boxes(cabinet.CABINET), look["cabinet"], pose=np.eye(4)),
            ]
            self._hand = self._body(self._boxes(cabinet.rigid_parts()), look["hand"], pose=AWAY)

    def depth(
        self,
        camera: RenderedCamera,
        world_from_camera: FloatArray,
        *,
        world_from_wrist: FloatArray = AWAY,
    ) -> FloatArray:
        """Return depth (H, W) along z, metres, camera.far for nothing; without a wrist, no hand.

        Nothing nearer than camera.near is seen. Accurate to some micrometres.
        """
        self._place(self._hand, world_from_wrist)
        # The engine's cameras look along -z, with y up.
        view = np.diag([1.0, -1.0, -1.0, 1.0]) @ inverse(world_from_camera)
        image = self._world.getCameraImage(
            camera.width,
            camera.height,
            view.T.ravel().tolist(),
            _projection(camera).T.ravel().tolist(),
            shadow=0,
            renderer=self._world.ER_TINY_RENDERER,
            flags=self._world.ER_NO_SEGMENTATION_MASK,
        )
        buffer = np.asarray(image[_DEPTH], dtype=np.float64).reshape(camera.height, camera.width)
        return camera.near * camera.far / (camera.far - (camera.far - camera.near) * buffer)

    def is_blocked(self, world_from_wrist: FloatArray) -> bool:
        """Return whether the hand's rigid parts touch the object or the cabinet."""
        self._place(self._hand, world_from_wrist)
        return any(
            record[_DISTANCE] <= 0.0
            for body in self._fixed
            for record in self._world.getClosestPoints(self._hand, body, 0.0)
        )

    def close(self) -> None:
        """Disconnect from the engine."""
        self._world.disconnect()

    def _look(self, file: Path, mesh: trimesh.Trimesh) -> int:
        """Return the engine's shape of what a mesh looks like, by way of a file."""
        mesh.export(file)
        return int(self._world.createVisualShape(self._world.GEOM_MESH, fileName=str(file)))

    def _boxes(self, boxes: Sequence[BoxRig]) -> int:
        """Return the engine's shape of boxes as one body."""
        turns = [Rotation.from_euler("xyz", box.rotation).as_quat().tolist() for box in boxes]
        return int(
            self._world.createCollisionShapeArray(
                shapeTypes=[self._world.GEOM_BOX] * len(boxes),
                halfExtents=[[side / 2.0 for side in box.size] for box in boxes],
                collisionFramePositions=[list(box.position) for box in boxes],
                collisionFrameOrientations=turns,
            )
        )

    def _body(self, solid: int, look: int, *, pose: FloatArray) -> int:
        body: int = self._world.createMultiBody(0, solid, look)
        self._world.changeDynamics(body, -1, collisionMargin=0.0)
        self._place(body, pose)
        return body

    def _place(self, body: int, pose: FloatArray) -> None:
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        self._world.resetBasePositionAndOrientation(body, pose[:3, 3].tolist(), quaternion)


def _projection(camera: RenderedCamera) -> FloatArray:
    """Return the engine's projection matrix, through the lower left corner of every pixel."""
    cx = camera.cx
    cy = camera.cy
    near = camera.near
    far = camera.far
    projection = np.zeros((4, 4))
    projection[0, 0] = 2.0 * camera.fx / camera.width
    projection[0, 2] = 1.0 - 2.0 * cx / camera.width
    projection[1, 1] = 2.0 * camera.fx / camera.height
    projection[1, 2] = 2.0 * (cy + 1.0) / camera.height - 1.0
    projection[2, 2] = -(far + near) / (far - near)
    projection[2, 3] = -2.0 * far * near / (far - near)
    projection[3, 2] = -1.0
    return projection
