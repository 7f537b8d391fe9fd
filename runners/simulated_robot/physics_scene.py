"""The robot cell in PyBullet: what its cameras see by the engine's renderer, and what touches."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import compose, inverse
from runners.sensors.rig import BoxRig
from runners.sessions.physics_engine import connect, silent
from runners.simulated_robot import cabinet, wrist
from runners.simulated_robot.settings import RenderedCamera

NEAR = 0.02  # m: how far around the hand contacts are looked for
_AWAY = compose(np.eye(3), np.array([0.0, 0.0, -100.0]))  # the hand, where no camera sees it


class PhysicsScene:
    """An object at its pose in the cabinet, and the hand, which goes wherever it is put."""

    def __init__(self, mesh: trimesh.Trimesh, world_from_object: FloatArray) -> None:
        """mesh: in its own frame, metres. Raises SessionError where PyBullet is not installed."""
        self._world = connect("logs that it simulated can be read without it")
        try:
            with tempfile.TemporaryDirectory() as folder:
                surroundings = cabinet.boxes(cabinet.CABINET, cabinet.ROOM)
                looks = {"object": mesh, "cabinet": surroundings, "hand": wrist.whole_mesh()}
                look = {name: self._look(Path(folder), name, seen) for name, seen in looks.items()}
                solid = self._concave(Path(folder) / "object.obj")
                self._fixed = [
                    self._body(solid, look["object"], world_from_object),
                    self._body(self._boxes(cabinet.solids()), look["cabinet"], np.eye(4)),
                ]
                self._hand = self._body(self._boxes(wrist.rigid_parts()), look["hand"], _AWAY)
        except BaseException:
            self.close()
            raise

    def depth(
        self,
        camera: RenderedCamera,
        world_from_camera: FloatArray,
        world_from_wrist: FloatArray | None = None,
    ) -> FloatArray:
        """Depth (H, W) along z in metres, camera.far where nothing is; without a wrist, no hand.

        Nothing nearer than camera.near is seen. Accurate to some micrometres.
        """
        _place(self._world, self._hand, _AWAY if world_from_wrist is None else world_from_wrist)
        image = self._world.getCameraImage(
            camera.width,
            camera.height,
            _view(world_from_camera),
            _projection(camera),
            shadow=0,
            renderer=self._world.ER_TINY_RENDERER,
            flags=self._world.ER_NO_SEGMENTATION_MASK,
        )
        buffer = np.asarray(image[_DEPTH], dtype=np.float64).reshape(camera.height, camera.width)
        return camera.near * camera.far / (camera.far - (camera.far - camera.near) * buffer)

    def clearance(self, world_from_wrist: FloatArray) -> float:
        """Metres between the hand's rigid parts and anything, below 0 inside; NEAR at most."""
        _place(self._world, self._hand, world_from_wrist)
        nearest = [
            record[_DISTANCE]
            for body in self._fixed
            for record in self._world.getClosestPoints(self._hand, body, NEAR)
        ]
        return float(min(nearest, default=NEAR))

    def close(self) -> None:
        """Disconnect from the engine."""
        if self._world.isConnected():
            self._world.disconnect()

    def _look(self, folder: Path, name: str, mesh: trimesh.Trimesh) -> int:
        """What a mesh looks like; a file of it stays in the folder."""
        file = folder / f"{name}.obj"
        mesh.export(file)
        with silent():
            return int(self._world.createVisualShape(self._world.GEOM_MESH, fileName=str(file)))

    def _concave(self, file: Path) -> int:
        """A mesh in a file as what others touch; the engine knows no contact of two of them."""
        with silent():
            shape = self._world.createCollisionShape(
                self._world.GEOM_MESH,
                fileName=str(file),
                flags=self._world.GEOM_FORCE_CONCAVE_TRIMESH,
            )
        return int(shape)

    def _boxes(self, boxes: Sequence[BoxRig]) -> int:
        """Boxes as one thing to touch."""
        return int(
            self._world.createCollisionShapeArray(
                shapeTypes=[self._world.GEOM_BOX] * len(boxes),
                halfExtents=[[side / 2.0 for side in box.size] for box in boxes],
                collisionFramePositions=[list(box.position) for box in boxes],
                collisionFrameOrientations=[
                    Rotation.from_euler("xyz", box.rotation).as_quat().tolist() for box in boxes
                ],
            )
        )

    def _body(self, solid: int, look: int, pose: FloatArray) -> int:
        body: int = self._world.createMultiBody(0, solid, look)
        self._world.changeDynamics(body, -1, collisionMargin=0.0)
        _place(self._world, body, pose)
        return body


_DEPTH = 3  # in the answer of getCameraImage
_DISTANCE = 8  # in a record of getClosestPoints


def _place(world: Any, body: int, pose: FloatArray) -> None:
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
    world.resetBasePositionAndOrientation(body, pose[:3, 3].tolist(), quaternion.tolist())


def _view(world_from_camera: FloatArray) -> list[float]:
    """The engine's view matrix; its cameras look along -z, with y up."""
    view = np.diag([1.0, -1.0, -1.0, 1.0]) @ inverse(world_from_camera)
    return view.T.ravel().tolist()


def _projection(camera: RenderedCamera) -> list[float]:
    """The engine's projection matrix. It looks through the lower left corner of every pixel."""
    cx, cy, near, far = camera.cx, camera.cy, camera.near, camera.far
    projection = np.zeros((4, 4))
    projection[0, 0] = 2.0 * camera.fx / camera.width
    projection[0, 2] = 1.0 - 2.0 * cx / camera.width
    projection[1, 1] = 2.0 * camera.fx / camera.height
    projection[1, 2] = 2.0 * (cy + 1.0) / camera.height - 1.0
    projection[2, 2] = -(far + near) / (far - near)
    projection[2, 3] = -2.0 * far * near / (far - near)
    projection[3, 2] = -1.0
    return projection.T.ravel().tolist()
