"""Probe sessions in MuJoCo: an object settled under gravity, and a hand that pushes at it."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from chsel.errors import MeshWarning
from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import compose
from runners.sessions.configurations import Configuration
from runners.sessions.faults import probed_mesh
from runners.sessions.gripper import START, Touch
from runners.sessions.mesh_surface import MeshSurface
from runners.sessions.physics_engine import import_mujoco
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

FRICTION = 1.0  # between hand and object, as the product of PyBullet's
STIFFNESS = 100.0  # rad/s: natural frequency of the hand's holder, critically damped
_MANY_FACES = 100_000
_SURE = 0.001  # m: no part of the hand is as far from the points on it
RADIUS = 1e-6  # m: half the thickness of the object's faces, which the engine wants above 0
# The stiffest contact that is stable at this time step: 30 N press the hand in by some 0.02 mm.
_SOLREF = (2.0 * TIME_STEP, 1.0)
_SOLIMP = (0.99, 0.999, 1e-4, 0.5, 2.0)


class MuJoCoEngine:
    """The hand is drawn along by a spring and a damper of limited force, and cannot turn.

    The object is a rigid surface of triangles, so that the hand touches it where it is concave.
    """

    def __init__(
        self,
        mesh: trimesh.Trimesh,
        configuration: Configuration,
        *,
        settings: ProbingSettings,
        hand: ProbingHand,
    ) -> None:
        """Settle the object of a configuration, fix it, and put the hand at its start.

        Raise SessionError where MuJoCo is not installed.
        """
        self._mujoco = mujoco = import_mujoco()
        if len(mesh.faces) > _MANY_FACES:
            text = (
                f"the mesh has {len(mesh.faces)} faces, for which MuJoCo takes about a minute a "
                "session for each 100 000; a coarser mesh is faster"
            )
            warnings.warn(MeshWarning("many_faces", text), stacklevel=2)
        settled = _settle(mujoco, mesh, laid=laid_down(mesh, configuration))
        self._mesh = probed_mesh(mesh, settings.faults)
        self._readings = TouchReadings()
        self._model = _model(mujoco, self._mesh, hand=hand, max_force=settings.max_force)
        self._data = mujoco.MjData(self._model)
        # The hand alone moves as it does beside the object, twenty times as fast.
        self._alone = _model(mujoco, None, hand=hand, max_force=settings.max_force)
        self._data_alone = mujoco.MjData(self._alone)
        self._patches = self._forward = hand.patches()
        self._clearance = 0.0  # metres from the hand to the object, at least
        self._object = self._model.body("object").id
        self._hand = self._model.body("hand").id
        self._data.qpos[:] = START
        self._target = np.array(START)
        self.move(on_stand(settled, configuration))

    def advance(self, target: FloatArray) -> Touch:
        """Draw the hand evenly towards target (3,) for the time of one mini-step."""
        way = target - self._target
        # The holder's damper acts on the velocity against that of its target.
        ahead = 2.0 / STIFFNESS * way / (MINI_STEP * TIME_STEP)
        shares = np.arange(1.0, MINI_STEP + 1.0)[:, None] / MINI_STEP
        drawn = self._target + shares * way + ahead
        self._target = target
        if not self._advances_alone(drawn):
            data = self._data
            start = data.qpos.copy()
            for step, held in enumerate(drawn):
                data.ctrl[:] = held
                self._mujoco.mj_step(self._model, data)
                self._readings.add(step, self._read(), surface=self._surface)
            self._clearance -= float(np.sqrt(((data.qpos - start) ** 2).sum()))
        return self._readings.touch(self._data.qpos.copy())

    def _advances_alone(self, drawn: FloatArray) -> bool:
        """Return whether the hand, held at points (MINI_STEP, 3), is out of the object's reach.

        If so, it has moved.
        """
        data, alone = self._data, self._data_alone
        if self._clearance <= np.sqrt(((drawn[-1] - data.qpos) ** 2).sum()):
            centres = self._patches.centres + data.qpos
            nearest = self._surface.distance(centres) - self._patches.radii
            self._clearance = float(nearest.min()) - _SURE
        if self._clearance <= 0.0:
            return False
        alone.qpos[:], alone.qvel[:] = data.qpos, data.qvel
        furthest = 0.0
        for held in drawn:
            alone.ctrl[:] = held
            self._mujoco.mj_step(self._alone, alone)
            furthest = max(furthest, float(((alone.qpos - data.qpos) ** 2).sum()))
        if np.sqrt(furthest) >= self._clearance:
            return False
        self._clearance -= float(np.sqrt(furthest))
        data.qpos[:], data.qvel[:] = alone.qpos, alone.qvel
        for step in range(MINI_STEP):
            self._readings.add(step, None, surface=self._surface)
        return True

    def place(self, pose: FloatArray) -> bool:
        """Put the hand at a pose (4, 4); False, and not to be used, if the object is there."""
        data = self._data
        turn = turned_from_forward(pose[:3, :3])
        self._model.body_quat[self._hand] = _quaternion(turn)
        self._patches = self._forward.turned(turn)
        self._clearance = 0.0
        data.qpos[:] = pose[:3, 3]
        data.qvel[:] = 0.0
        self._target = pose[:3, 3].copy()
        self._readings.clear()
        self._mujoco.mj_forward(self._model, data)
        # Nothing of a surface touches a hand that is all inside of it.
        return data.ncon == 0 and not self._surface.encloses(pose[:3, 3])

    def move(self, world_from_object: FloatArray) -> None:
        """Put the object at a pose (4, 4)."""
        self.world_from_object = world_from_object
        self._clearance = 0.0
        self._surface = MeshSurface(self._mesh, world_from_object)
        self._model.body_pos[self._object] = world_from_object[:3, 3]
        self._model.body_quat[self._object] = _quaternion(world_from_object[:3, :3])

    def close(self) -> None:
        """Release nothing, as the engine's memory goes with this object."""

    def _read(self) -> Reading | None:
        """Return the contact between hand and object in a step, where it presses hardest."""
        data = self._data
        if data.ncon == 0:
            return None
        contacts = data.contact
        force = np.zeros(6)
        forces = np.zeros(data.ncon)
        for index in np.flatnonzero(contacts.efc_address >= 0):
            self._mujoco.mj_contactForce(self._model, data, index, force)
            forces[index] = force[0]
        if not (forces > 0.0).any():
            return None
        # From the first of the two to the second, of which one is the hand, and has a geom.
        normals = contacts.frame[:, :3] * np.where(contacts.geom[:, :1] >= 0, -1.0, 1.0)
        total = forces @ normals
        hardest = int(np.argmax(forces))
        # The engine's point is in the middle between both surfaces.
        normal = normals[hardest].copy()
        contact = contacts.pos[hardest] - 0.5 * contacts.dist[hardest] * normal
        return Reading(contact, normal, force=float(np.sqrt(total @ total)))


def _settle(mujoco: Any, mesh: trimesh.Trimesh, *, laid: FloatArray) -> FloatArray:
    """Return the pose (4, 4) at which the mesh has settled under gravity from pose `laid`."""
    settling = settling_body(mesh, laid)
    spec = _new_spec(mujoco)
    spec.option.gravity = [0.0, 0.0, GRAVITY]
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[1.0, 1.0, 1.0],
        condim=4,
        solref=_SOLREF,  # with the engine's, the object tilts by up to 1 mm at its far end
        solimp=_SOLIMP,
        friction=[FLOOR_FRICTION, FLOOR_SPINNING_FRICTION, 0.0],
    )
    body = spec.worldbody.add_body(
        name="object", mass=OBJECT_MASS, inertia=settling.inertia, explicitinertial=True
    )
    body.add_freejoint()
    _add_hull(spec, body, name="object", vertices=settling.vertices)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:3] = settling.world_from_inertial[:3, 3]
    data.qpos[3:] = _quaternion(settling.world_from_inertial[:3, :3])
    mujoco.mj_step(model, data, SETTLING_STEPS)
    mujoco.mj_kinematics(model, data)
    rotation = data.body("object").xmat.reshape(3, 3)
    position = data.body("object").xpos
    return settled_mesh(mesh, settling, world_from_inertial=compose(rotation, position))


def _model(
    mujoco: Any, mesh: trimesh.Trimesh | None, *, hand: ProbingHand, max_force: float
) -> Any:
    """Return a model of the hand, which slides along x, y, z, and of an object at the origin."""
    spec = _new_spec(mujoco)
    if mesh is not None:
        _add_surface(spec, mesh)
    slider = spec.worldbody.add_body(name="slider")
    for axis, name in zip(np.eye(3), "xyz", strict=True):
        slider.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        actuator = spec.add_actuator(name=name, target=name)
        actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        spring = HAND_MASS * STIFFNESS**2
        actuator.gainprm[0] = spring
        actuator.biasprm[1:3] = [-spring, -2.0 * HAND_MASS * STIFFNESS]
        actuator.forcerange = [-max_force, max_force]
        actuator.forcelimited = True
    body = slider.add_body(
        name="hand", mass=HAND_MASS, inertia=np.full(3, HAND_MASS), explicitinertial=True
    )
    for number, solid in enumerate(hand.solids):
        _add_hull(spec, body, name=f"hand{number}", vertices=np.asarray(solid.vertices))
    return spec.compile()


def _add_surface(spec: Any, mesh: trimesh.Trimesh) -> None:
    """Add a body whose surface is a rigid mesh."""
    spec.worldbody.add_body(name="object")
    flex = spec.add_flex()
    flex.name = "object"
    flex.dim = 2
    flex.radius = RADIUS
    flex.vertbody = ["object"]
    flex.vert = np.asarray(mesh.vertices).ravel()
    flex.elem = np.asarray(mesh.faces).ravel()
    flex.friction = [FRICTION, 0.0, 0.0]
    flex.solref = _SOLREF
    flex.solimp = _SOLIMP


def _new_spec(mujoco: Any) -> Any:
    spec = mujoco.MjSpec()
    spec.option.timestep = TIME_STEP
    spec.option.gravity = [0.0, 0.0, 0.0]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return spec


def _add_hull(spec: Any, body: Any, *, name: str, vertices: FloatArray) -> None:
    """Add the convex hull of vertices (V, 3) to a body."""
    spec.add_mesh(name=name, uservert=vertices.ravel())
    geom = body.add_geom(type=import_mujoco().mjtGeom.mjGEOM_MESH, meshname=name)
    geom.friction = [FRICTION, 0.0, 0.0]
    geom.solref = _SOLREF
    geom.solimp = _SOLIMP


def _quaternion(rotation: FloatArray) -> FloatArray:
    """Return the quaternion (4,), w first, of a rotation (3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)
