"""Probe sessions with a gripper: what the physics engine and plain geometry have in common."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np

from chsel.errors import require_choice, require_positive
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import FreeVoxels, KnownPoints, Lattice, Workspace
from chsel.problem.poses import apply, inverse
from chsel.problem.sdf_grid import mesh_sdf
from chsel.problem.settings import Presets
from chsel.problem.streams import Purpose, StreamKey
from replay.events import Probe
from runners.sessions import panda_hand as hand
from runners.sessions.configurations import WORKSPACE, Configuration
from runners.sessions.faults import Faults, FaultSettings, probed_mesh
from runners.sessions.free_space import box_shell, floor_slab, swept_voxels

if TYPE_CHECKING:
    import trimesh

BOUNDARIES = ("floor_slab", "box_shell", "both")
SWEEPS = ("mini_steps", "control_steps")
COLLISION_MESHES = ("visual", "vhacd")
WORKSPACES = ("reference", "paper")

MINI_STEPS = 15  # of a control step
X_REST = -0.05  # m: where the gripper moves sideways, before the object
START = (X_REST, 0.0, 0.2)  # m: where it is before the first probe
GAIN = 30.0  # command per metre of error
TOLERANCE = 3e-4  # m: what counts as arrived
MOST_STEPS = 60  # control steps after which a move that something blocks is given up
NOISE_ROWS = 5000  # of the table that all methods share


@dataclass(frozen=True)
class ProbingSettings:
    """How the gripper probes, and what is written down of it."""

    configuration: str | None = None  # name of one of the 17; None: the object's own
    boundary: str = "floor_slab"
    """Voxels free from the start: two layers below the floor, the workspace's faces, or both."""
    workspace: str = "reference"  # in which the hammer's is larger; in "paper" all are alike
    sweep: str = "mini_steps"  # where free space is swept, or only where control steps end
    collision_mesh: str = "visual"  # of PyBullet: the mesh itself, or its convex parts
    free_resolution: float = 0.025  # side of a free voxel, m
    object_resolution: float = 0.010  # of the object's SDF grid, m
    object_padding: float = 0.05  # of the object's SDF grid, m
    interior_spacing: float = 0.005  # of the hand's interior points, m
    interior_depth: float = 0.010  # of the hand's interior points, m
    start_contacts: int = 4  # registration begins when there are so many contacts
    start_probe: int = 4  # and after the probe of this index
    step_length: float = 0.03  # of a control step at full command, m
    push_steps: int = 10  # most control steps of a push
    stop_force: float = 5.0  # ends a push, N
    max_force: float = 30.0  # of the hand's holder, N
    noise: float = 0.005  # standard deviation, of a command between -1 and 1
    faults: FaultSettings = field(default_factory=FaultSettings)
    """Of what is reported, and of the registered mesh."""

    presets: ClassVar[Presets] = {
        "paper": {
            "boundary": "box_shell",
            "workspace": "paper",
            "start_contacts": 0,
            "start_probe": 0,
        },
        "reference": {"sweep": "control_steps", "collision_mesh": "vhacd"},
    }

    def __post_init__(self) -> None:
        require_choice("boundary", self.boundary, BOUNDARIES)
        require_choice("workspace", self.workspace, WORKSPACES)
        require_choice("sweep", self.sweep, SWEEPS)
        require_choice("collision_mesh", self.collision_mesh, COLLISION_MESHES)
        for name in (
            "free_resolution",
            "object_resolution",
            "object_padding",
            "interior_spacing",
            "interior_depth",
            "step_length",
            "push_steps",
            "stop_force",
            "max_force",
        ):
            require_positive(name, getattr(self, name))
        for name in ("start_contacts", "start_probe", "noise"):
            require_positive(name, getattr(self, name), zero=True)


@dataclass(frozen=True, eq=False)
class Touch:
    """What a gripper sees and feels at the end of a mini-step.

    position (3,): of the hand, in the world. force: on the object, newtons. contact (3,) on the
    object's surface, and its normal (3,) out of the object, where the hand is in contact.
    """

    position: FloatArray
    force: float = 0.0
    contact: FloatArray | None = None
    normal: FloatArray | None = None


class Engine(Protocol):
    """A world with a fixed object and a gripper that starts at START."""

    world_from_object: FloatArray
    """Pose (4, 4) of the mesh."""

    def advance(self, target: FloatArray) -> Touch:
        """Move the hand towards target (3,), a mini-step away, as far as it goes."""

    def close(self) -> None:
        """End the world. Ending twice is ending once."""


class ProbingSession:
    """Probes one configuration with a gripper in either engine; see `Session`."""

    def __init__(
        self,
        engine: Engine,
        mesh: trimesh.Trimesh,
        configuration: Configuration,
        settings: ProbingSettings,
        seed: int,
    ) -> None:
        """mesh: the registered one, in its frame, metres. seed: of noise and faults."""
        self.configuration = configuration
        self.settings = settings
        self.workspace = choose_workspace(configuration, settings)
        self.free_resolution = settings.free_resolution
        self.world_from_object: FloatArray | None = engine.world_from_object
        self.count = len(configuration.grid)
        self._voxels = FreeVoxels(Lattice(self.workspace.lower, settings.free_resolution))
        self.initial_points = KnownPoints(
            free=self._voxels.add(self._boundary(mesh, engine.world_from_object))
        )
        self._interior = hand.interior_points(settings.interior_spacing, settings.interior_depth)
        self._gripper = _Gripper(engine, settings, seed)
        self._engine = engine
        self._faults: Faults | None = None
        if settings.faults != FaultSettings():
            self._faults = Faults(
                settings.faults,
                probed_mesh(mesh, settings.faults),
                engine.world_from_object,
                self._voxels,
                self.workspace,
                seed,
            )

    def probes(self) -> Iterator[Probe]:
        """Move before the object, push, return; once for every point of the grid."""
        for step, (y, z) in enumerate(self.configuration.grid):
            self._gripper.forget()
            self._gripper.move_to(y, z)
            self._gripper.push()
            self._gripper.withdraw()
            yield self._probe(step)

    def close(self) -> None:
        """Let go of the engine."""
        self._engine.close()

    def _probe(self, step: int) -> Probe:
        """What the gripper has done since it last forgot."""
        path = np.array(self._gripper.path)
        ends = np.array(self._gripper.ends)
        contacts = np.array(self._gripper.contacts).reshape(-1, 3)
        normals = np.array(self._gripper.normals).reshape(-1, 3)
        swept = path if self.settings.sweep == "mini_steps" else ends
        free = self._voxels.add(swept_voxels(self._voxels.lattice, self._interior, swept))
        if self._faults is not None:
            free = np.concatenate([free, self._faults.wrongly_free(step, free)])
            contacts, normals = self._faults.reported(step, contacts, normals)
        return Probe(
            step=step,
            outcome="contact" if len(contacts) else "free",
            new_points=KnownPoints(free=free, known=contacts),
            gripper_path=hand.world_from_gripper(ends),
            contacts=contacts,
            contact_normals=normals,
        )

    def _boundary(self, mesh: trimesh.Trimesh, world_from_object: FloatArray) -> FloatArray:
        """Centres (N, 3) of the voxels where the object is known not to be."""
        lattice, chosen = self._voxels.lattice, self.settings.boundary
        points = np.zeros((0, 3))
        if chosen in ("box_shell", "both"):
            points = np.concatenate([points, box_shell(lattice, self.workspace)])
        if chosen in ("floor_slab", "both"):
            vertices = apply(world_from_object, np.asarray(mesh.vertices))
            points = np.concatenate([points, floor_slab(lattice, vertices)])
        # Some configurations reach out of their workspace; free points within the object would lie.
        in_object = apply(inverse(world_from_object), points)
        lower, upper = np.asarray(mesh.bounds)
        beside = ((in_object < lower) | (in_object > upper)).any(axis=1)
        asked = ~beside if mesh.is_watertight else np.ones(len(points), dtype=bool)
        inside = np.zeros(len(points), dtype=bool)
        inside[asked] = mesh_sdf(mesh, in_object[asked])[0] <= 0.0
        return points[~inside]


class _Gripper:
    """The hand's control: proportional, noisy, in control steps of MINI_STEPS mini-steps."""

    def __init__(self, engine: Engine, settings: ProbingSettings, seed: int) -> None:
        self._engine = engine
        self._settings = settings
        stream = StreamKey(seed, 0).stream(Purpose.CONTROL_NOISE)
        self._noise = settings.noise * stream.standard_normal((NOISE_ROWS, 3))
        self._steps = 0
        self._position = np.array(START)
        self.path: list[FloatArray] = [self._position]
        self.forget()

    def forget(self) -> None:
        """Begin to write down positions and contacts anew."""
        self.path = self.path[-1:]
        self.ends = self.path[-1:]
        self.contacts: list[FloatArray] = []
        self.normals: list[FloatArray] = []

    def move_to(self, y: float, z: float) -> None:
        """Go sideways to y and z, metres."""
        for _ in range(MOST_STEPS):
            error = np.array([0.0, y, z]) - self._position * [0.0, 1.0, 1.0]
            if np.sqrt(error @ error) < TOLERANCE:
                return
            self._control_step(GAIN * error)

    def push(self) -> None:
        """Go forward until something resists, or for so many control steps."""
        for _ in range(self._settings.push_steps):
            if self._control_step(np.array([1.0, 0.0, 0.0])) > self._settings.stop_force:
                return

    def withdraw(self) -> None:
        """Go back before the object."""
        for _ in range(MOST_STEPS):
            error = X_REST - float(self._position[0])
            if abs(error) < TOLERANCE:
                return
            self._control_step(np.array([GAIN * error, 0.0, 0.0]))

    def _control_step(self, command: FloatArray) -> float:
        """Follow a command (3,) within [-1, 1]; the median force over mini-steps, newtons."""
        noisy = np.clip(command + self._noise[self._steps % NOISE_ROWS], -1.0, 1.0)
        self._steps += 1
        start, displacement = self._position, self._settings.step_length * noisy
        forces = []
        for mini_step in range(MINI_STEPS):
            fraction = (mini_step + 1) / MINI_STEPS
            touch = self._engine.advance(start + fraction * displacement)
            self.path.append(touch.position)
            forces.append(touch.force)
        self._position = touch.position
        self.ends.append(touch.position)
        if touch.contact is not None and touch.normal is not None:
            self.contacts.append(touch.contact)
            self.normals.append(touch.normal)
        return float(np.median(forces))


def choose_workspace(configuration: Configuration, settings: ProbingSettings) -> Workspace:
    """The box in which the object is sought."""
    return WORKSPACE if settings.workspace == "paper" else configuration.workspace
