"""Probe sessions in PyBullet: an object settled under gravity, and a hand that pushes at it."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from chsel.errors import SessionError
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import compose
from runners.sessions.configurations import Configuration
from runners.sessions.faults import probed_mesh
from runners.sessions.gripper import START, Touch
from runners.sessions.mesh_surface import MeshSurface
from runners.sessions.physics_engine import connect, silent
from runners.sessions.placement import laid_down, on_stand
from runners.sessions.probing_hand import ProbingHand, turned_from_forward
from runners.sessions.probing_settings import ProbingSettings
from runners.sessions.settling import (
    FLOOR_FRICTION,
    FLOOR_SPINNING_FRICTION,
    GRAVITY,
    OBJECT_MASS,
    SETTLING_STEPS,
    settled_mesh,
    settling_body,
)
from runners.sessions.touch_readings import (
    HAND_MASS,
    MINI_STEP,
    TIME_STEP,
    Reading,
    TouchReadings,
)

if TYPE_CHECKING:
    import trimesh

FINGER_FRICTION = 2.0


class PyBulletEngine:
    """The hand is drawn along by a fixed constraint of limited force, and cannot turn."""

    def __init__(
        self,
        mesh: trimesh.Trimesh,
        configuration: Configuration,
        *,
        settings: ProbingSettings,
        hand: ProbingHand,
    ) -> None:
        """Settle the object of a configuration, fix it, and put the hand at its start.

        Raise SessionError where PyBullet is not installed, or cannot hold the mesh.
        """
        self._max_force = settings.max_force
        self._readings = TouchReadings()
        self._world: Any = connect()
        # Every access to a function of the client makes it; these are called most.
        self._step, self._contacts = self._world.stepSimulation, self._world.getContactPoints
        try:
            _set_up(self._world)
            with tempfile.TemporaryDirectory() as folder:
                laid = laid_down(mesh, configuration)
                with silent():  # of a mesh that it cannot hold, the engine prints a line
                    settled = _settle(self._world, mesh, laid=laid)
                self.world_from_object = on_stand(settled, configuration)
                probed = probed_mesh(mesh, settings.faults)
                file = _collision_file(
                    self._world, probed, folder=Path(folder), kind=settings.collision_mesh
                )
                concave = settings.collision_mesh == "visual"
                self._mesh = probed
                self._surface = MeshSurface(probed, self.world_from_object)
                self._object = _fixed_object(
                    self._world, file, world_from_object=self.world_from_object, concave=concave
                )
                self._hand = _hand(self._world, hand, folder=Path(folder))
        except self._world.error as error:
            self.close()
            raise SessionError(
                f"PyBullet cannot hold the object's mesh of {len(mesh.faces)} faces ({error}); "
                "accepted: fewer faces, session.engine=mujoco or session=kinematic"
            ) from None
        except BaseException:
            self.close()
            raise
        self._holder = self._world.createConstraint(
            self._hand, -1, -1, -1, self._world.JOINT_FIXED, [0, 0, 0], [0, 0, 0], START
        )

    def advance(self, target: FloatArray) -> Touch:
        """Draw the hand towards target (3,) for the time of one mini-step."""
        world = self._world
        world.changeConstraint(self._holder, target.tolist(), maxForce=self._max_force)
        for step in range(MINI_STEP):
            self._step()
            self._readings.add(step, self._read(), surface=self._surface)
        return self._readings.touch(np.array(world.getBasePositionAndOrientation(self._hand)[0]))

    def place(self, pose: FloatArray) -> bool:
        """Put the hand at a pose (4, 4); False, and not to be used, if the object is there."""
        from scipy.spatial.transform import Rotation

        world = self._world
        position = pose[:3, 3].tolist()
        quaternion = Rotation.from_matrix(turned_from_forward(pose[:3, :3])).as_quat().tolist()
        world.resetBasePositionAndOrientation(self._hand, position, quaternion)
        world.changeConstraint(self._holder, position, quaternion, maxForce=self._max_force)
        self._readings.clear()
        near = world.getClosestPoints(self._hand, self._object, 0.0)
        # Nothing of a surface touches a hand that is all inside of it.
        inside = self._surface.encloses(pose[:3, 3])
        return not inside and not any(record[_DISTANCE] < 0.0 for record in near)

    def move(self, world_from_object: FloatArray) -> None:
        """Put the object at a pose (4, 4)."""
        self.world_from_object = world_from_object
        self._surface = MeshSurface(self._mesh, world_from_object)
        position, quaternion = _placed(world_from_object).values()
        self._world.resetBasePositionAndOrientation(self._object, position, quaternion)

    def close(self) -> None:
        """Disconnect from the engine."""
        if self._world.isConnected():
            self._world.disconnect()

    def _read(self) -> Reading | None:
        """Return the contact between hand and object after a step, where it presses hardest."""
        touching = self._contacts(self._hand, self._object)
        records = [record for record in touching if record[_FORCE] > 0.0]
        if not records:
            return None
        forces = [record[_FORCE] * np.array(record[_NORMAL_ON_B]) for record in records]
        total = np.sum(forces, axis=0)
        hardest = max(records, key=lambda record: record[_FORCE])
        contact, normal = np.array(hardest[_POINT_ON_B]), np.array(hardest[_NORMAL_ON_B])
        return Reading(contact, normal, force=float(np.sqrt(total @ total)))


# Where a contact record of PyBullet has what; B is the object.
_POINT_ON_B = 6
_NORMAL_ON_B = 7
_DISTANCE = 8
_FORCE = 9


def _set_up(world: Any) -> None:
    """Set time steps and the floor of a new world."""
    world.setPhysicsEngineParameter(deterministicOverlappingPairs=1)
    world.setTimeStep(TIME_STEP)
    floor = world.createMultiBody(0, world.createCollisionShape(world.GEOM_PLANE))
    world.changeDynamics(
        floor, -1, lateralFriction=FLOOR_FRICTION, spinningFriction=FLOOR_SPINNING_FRICTION
    )


def _settle(world: Any, mesh: trimesh.Trimesh, *, laid: FloatArray) -> FloatArray:
    """Return the pose (4, 4) at which the mesh has settled under gravity from pose `laid`."""
    settling = settling_body(mesh, laid)
    body = world.createMultiBody(
        OBJECT_MASS,
        world.createCollisionShape(world.GEOM_MESH, vertices=settling.vertices.tolist()),
        **_placed(settling.world_from_inertial),
    )
    world.changeDynamics(body, -1, localInertiaDiagonal=settling.inertia.tolist())
    world.setGravity(0.0, 0.0, GRAVITY)
    for _ in range(SETTLING_STEPS):
        world.stepSimulation()
    position, quaternion = world.getBasePositionAndOrientation(body)
    world.removeBody(body)
    # From here on only the hand moves, and what holds it carries its weight.
    world.setGravity(0.0, 0.0, 0.0)
    rotation = np.array(world.getMatrixFromQuaternion(quaternion)).reshape(3, 3)
    return settled_mesh(mesh, settling, world_from_inertial=compose(rotation, np.array(position)))


def _collision_file(world: Any, mesh: trimesh.Trimesh, *, folder: Path, kind: str) -> Path:
    """Return a file with the mesh, or with its convex parts."""
    whole, parts = folder / "object.obj", folder / "parts.obj"
    _write_obj(whole, [mesh])
    if kind == "visual":
        return whole
    with silent():
        world.vhacd(str(whole), str(parts), str(folder / "log.txt"))
    return parts


def _fixed_object(world: Any, file: Path, *, world_from_object: FloatArray, concave: bool) -> int:
    flags = world.GEOM_FORCE_CONCAVE_TRIMESH if concave else 0
    shape = world.createCollisionShape(world.GEOM_MESH, fileName=str(file), flags=flags)
    body: int = world.createMultiBody(0, shape, **_placed(world_from_object))
    world.changeDynamics(body, -1, collisionMargin=0.0)
    return body


def _hand(world: Any, hand: ProbingHand, *, folder: Path) -> int:
    """Return the hand, put at its start; without inertia the engine keeps its orientation."""
    _write_obj(folder / "hand.obj", list(hand.solids))
    shape = world.createCollisionShape(world.GEOM_MESH, fileName=str(folder / "hand.obj"))
    body: int = world.createMultiBody(HAND_MASS, shape, basePosition=START)
    world.changeDynamics(
        body,
        -1,
        lateralFriction=FINGER_FRICTION,
        localInertiaDiagonal=[0.0, 0.0, 0.0],
        collisionMargin=0.0,
    )
    return body


def _placed(pose: FloatArray) -> dict[str, list[float]]:
    """Return arguments of createMultiBody that put a body at a pose (4, 4)."""
    from scipy.spatial.transform import Rotation

    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return {"basePosition": pose[:3, 3].tolist(), "baseOrientation": quaternion.tolist()}


def _write_obj(path: Path, meshes: list[trimesh.Trimesh]) -> None:
    """Write meshes as separate objects of one file; PyBullet makes each one's hull a part."""
    lines, first = [], 1
    for number, mesh in enumerate(meshes):
        lines.append(f"o part{number}")
        lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + first).tolist()]
        first += len(mesh.vertices)
    path.write_text("\n".join(lines) + "\n")
