"""Sources that probe with a gripper, in a physics engine or by plain geometry."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from chsel.errors import MeshWarning, SettingError
from chsel.events import Probe, Start
from chsel.next_probe.action_lattice import (
    ActionSettings,
    around_actions,
    forward_actions,
    straight_actions,
)
from chsel.next_probe.decision_problem import Actions, HandShape
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.points import FreeVoxels, KnownPoints, Lattice, Workspace
from chsel.problem.pose_prior import prior_from_settings
from chsel.problem.poses import apply, axis_angle, compose, inverse
from chsel.problem.sdf_grid import mesh_sdf
from chsel.problem.streams import Purpose, StreamKey, normals
from runners.objects.loader import FITTED, ObjectModel
from runners.sessions.configurations import (
    WORKSPACE,
    Configuration,
    find_configuration,
)
from runners.sessions.faults import CLEAN, Faults, FaultSettings, probed_mesh
from runners.sessions.fitted import fitted_configuration
from runners.sessions.gripper import X_REST, Engine, SimulatedGripper
from runners.sessions.physics_engine import default_engine
from runners.sessions.placement import centre_of_mass, laid_down, on_stand
from runners.sessions.probing_hand import (
    ROTATION,
    ProbingHand,
    open_hand,
    turned_from_forward,
    world_from_gripper,
)
from runners.sessions.probing_settings import ProbingSettings, expected_moves
from runners.sessions.source import ObjectOrigin, SourceKind, Steerable, require_available

if TYPE_CHECKING:
    import trimesh

SLAB_MARGIN = 0.15  # m: by which the floor slab is wider than the object
SLAB_LAYERS = 2
_TURN = 0.7  # standard deviation: the turn of an object pushed, by its way in diameters


def _physics_engine(  # noqa: PLR0917
    mesh: trimesh.Trimesh,
    configuration: Configuration,
    settings: ProbingSettings,
    hand: ProbingHand,
) -> Engine:
    if (settings.engine or default_engine()) == "mujoco":
        from runners.sessions.mujoco_engine import MuJoCoEngine

        if settings.collision_mesh != "visual":
            raise SettingError(
                f"collision_mesh is {settings.collision_mesh}; accepted in mujoco: visual, as it "
                "touches the faces of the mesh itself"
            )
        return MuJoCoEngine(mesh, configuration, settings=settings, hand=hand)
    from runners.sessions.pybullet_engine import PyBulletEngine

    return PyBulletEngine(mesh, configuration, settings=settings, hand=hand)


def _kinematic_engine(  # noqa: PLR0917
    mesh: trimesh.Trimesh,
    configuration: Configuration,
    settings: ProbingSettings,
    hand: ProbingHand,
) -> Engine:
    from runners.sessions.kinematic import KinematicEngine

    laid = on_stand(laid_down(mesh, configuration), configuration)
    return KinematicEngine(probed_mesh(mesh, settings.faults), laid, settings=settings, hand=hand)


ENGINES: Mapping[str, Callable[..., Engine]] = {
    "simulated": _physics_engine,
    "kinematic": _kinematic_engine,
}
"""Openers of the engines by the kinds of their sources, imported when they are used."""


def open_probing(
    kind: str,
    mesh: trimesh.Trimesh,
    *,
    configuration_name: str,
    settings: ProbingSettings,
    seed: int,
) -> ProbingSource:
    """Open a source of a kind of ENGINES; mesh in its own frame, metres.

    Raise SettingError for an unknown configuration, SessionError where the engine is not installed.
    """
    hand = open_hand(settings.hand)
    if configuration_name == FITTED:
        configuration = fitted_configuration(mesh, hand)
    else:
        configuration = find_configuration(configuration_name)
    engine = ENGINES[kind](mesh, configuration, settings, hand)
    return ProbingSource(
        engine, mesh, configuration=configuration, settings=settings, seed=seed, hand=hand
    )


def _open_for_object(  # noqa: PLR0917
    kind: str, settings: ProbingSettings, object_model: ObjectModel | None, seed: int
) -> ProbingSource:
    """Open a source for an object. Raise SettingError if the configuration is another object's."""
    assert object_model is not None
    configuration = settings.configuration or object_model.configuration
    if configuration != FITTED:
        find_configuration(configuration, object_model.name)
        if not object_model.of_paper:
            text = (
                f"configuration {configuration} is laid out for an object of the paper's size, and "
                "its probes may miss this one; configuration=fitted is for any size"
            )
            warnings.warn(MeshWarning("other_size", text), stacklevel=2)
    return open_probing(
        kind, object_model.mesh, configuration_name=configuration, settings=settings, seed=seed
    )


PROBING: Mapping[str, SourceKind] = {
    kind: SourceKind(
        ProbingSettings,
        partial(_open_for_object, kind),
        object=ObjectOrigin.PLACED,
        keys={"configuration": "${configuration}"},  # of the top file, for short commands
        groups=({"faults": CLEAN},),
    )
    for kind in ENGINES
}
"""The kinds of sources that probe with a gripper, by name."""


class ProbingSource(Steerable):
    """Probes one configuration with a gripper in either engine; see `ProbeSource`."""

    def __init__(
        self,
        engine: Engine,
        mesh: trimesh.Trimesh,
        *,
        configuration: Configuration,
        settings: ProbingSettings,
        seed: int,
        hand: ProbingHand,
    ) -> None:
        """Make the source of a registered mesh, in its frame, metres; hand: that of the engine.

        Raise SettingError if nothing of the hand is deep enough to sweep.
        """
        self.configuration = configuration
        self.settings = settings
        self.workspace = choose_workspace(configuration, settings)
        self.free_resolution = settings.free_resolution or configuration.free_resolution
        self.world_from_object: FloatArray | None = engine.world_from_object
        self.count = len(configuration.grid)
        self.start = Start(contacts=settings.start_contacts, step=settings.start_probe)
        self.push_distance = expected_moves(vars(settings))
        self.prior = prior_from_settings("session.prior", settings.prior)
        self._seed = seed
        self._voxels = FreeVoxels(Lattice(self.workspace.lower, self.free_resolution))
        self.initial_points = KnownPoints(
            free=self._voxels.add(self._boundary(mesh, engine.world_from_object))
        )
        self._hand = hand
        self._interior = hand.interior_points(settings.interior_spacing, settings.interior_depth)
        if len(self._interior) == 0:
            raise SettingError(
                f"the hand has no interior point {settings.interior_depth:g} m deep; accepted: a "
                "smaller session.interior_depth, or a finer session.interior_spacing"
            )
        self._centre = centre_of_mass(mesh)
        self._diameter = float(np.linalg.norm(mesh.extents))
        self._offered: Actions | None = None
        self._available = np.zeros(0, dtype=bool)
        self._engine = engine
        self._gripper = SimulatedGripper(engine, settings, seed=seed)
        self._faults: Faults | None = None
        if settings.faults != FaultSettings():
            probed = probed_mesh(mesh, settings.faults)
            pose = engine.world_from_object
            self._faults = Faults(
                settings.faults,
                probed,
                world_from_object=pose,
                free=self._voxels,
                workspace=self.workspace,
                seed=seed,
            )

    @property
    def hand(self) -> HandShape:
        """The hand in its frame, where it probes along z."""
        return self._hand.shape

    def probes(self) -> Iterator[Probe]:
        """Move before the object, push, return; once for every point of the grid."""
        for step, (y, z) in enumerate(self.configuration.grid):
            self._gripper.forget()
            self._gripper.move_to(y, z)
            self._gripper.push()
            self._gripper.withdraw()
            yield self._probe(step)

    def offer(self, settings: ActionSettings) -> Actions:
        """Return the probes that can be chosen from; see `Steerable`."""
        push = self.settings.push_steps * self.settings.step_length
        if settings.choice == "around":
            offered = around_actions(
                settings, self.workspace, hand=self.hand, diameter=self._diameter
            )
        elif settings.choice == "forward":
            offered = forward_actions(
                settings,
                self.workspace,
                hand=self.hand,
                rotation=ROTATION,
                start=X_REST,
                length=push,
                diameter=self._diameter,
            )
        else:
            starts = np.array([(X_REST, y, z) for y, z in self.configuration.grid])
            poses = world_from_gripper(starts)
            offered = straight_actions(settings, poses, length=np.full(len(starts), push))
        self._offered = offered
        self._available = np.ones(len(offered), dtype=bool)
        return offered

    def available(self) -> BoolArray:
        """Return the actions (A,) that were not taken yet; repeated, they show nothing new."""
        return self._available.copy()

    def take(self, step: int, action: int) -> Iterator[Probe]:
        """Probe from an action's start along its z axis, and return to it; see `Steerable`."""
        require_available(action, self._available)
        assert self._offered is not None
        self._available[action] = False
        pose = self._offered.world_from_hand[action]
        self._gripper.probe_along(pose, float(self._offered.length[action]))
        yield self._probe(step, pose[:3, :3])

    def close(self) -> None:
        """Release the engine."""
        self._engine.close()

    def _probe(self, step: int, rotation: FloatArray = ROTATION) -> Probe:
        """Return what the gripper has done since `forget`, turned by a rotation world_from_hand."""
        done = self._gripper
        ends = np.array(done.ends)
        contacts = np.array(done.contacts).reshape(-1, 3)
        normals = np.array(done.normals).reshape(-1, 3)
        swept = np.array(done.path) if self.settings.sweep == "mini_steps" else ends
        interior = self._interior @ turned_from_forward(rotation).T
        free = self._voxels.add(swept_voxels(self._voxels.lattice, interior, positions=swept))
        if self._faults is not None:
            free = np.concatenate([free, self._faults.wrongly_free(step, free)])
            contacts, normals = self._faults.reported(step, contacts, normals_out=normals)
        probe = Probe(
            step=step,
            outcome="contact" if len(contacts) else "free",
            new_points=self._points(free, contacts=contacts, normals=normals),
            gripper_path=world_from_gripper(ends, rotation),
            contacts=contacts,
            contact_normals=normals,
        )
        return probe if probe.push is None else self._pushed(probe, probe.push)

    def _points(
        self, free: FloatArray, *, contacts: FloatArray, normals: FloatArray
    ) -> KnownPoints:
        """Return free points (N, 3) and contacts (C, 3), with normals (C, 3) if they are reported.

        Normals of 0 are not known.
        """
        stated = self.settings.faults.normals
        if stated is None:
            return KnownPoints(free=free, known=contacts)
        noise = np.where((normals != 0.0).any(axis=1), stated, 0.0)
        return KnownPoints(free=free, known=contacts, normals=normals, normal_noise=noise)

    def _pushed(self, probe: Probe, direction: FloatArray) -> Probe:
        """Move the object in a direction (3,), unless it stands; return the probe with its pose."""
        if self.push_distance > 0.0:
            self._voxels.forget()  # what was free before has moved with the object
        if self.settings.moves == 0.0:
            return probe
        stream = StreamKey(self._seed, probe.step).stream(Purpose.PUSHES)
        angle = _TURN * self.settings.moves / self._diameter * float(normals(stream, 1)[0])
        pose = self._engine.world_from_object
        turn = axis_angle(np.eye(3)[2], angle)
        pivot = apply(pose, self._centre[None])[0]
        moved = pivot + self.settings.moves * direction + turn @ (pose[:3, 3] - pivot)
        pose = self.world_from_object = compose(turn @ pose[:3, :3], moved)
        self._engine.move(pose)
        if self._faults is not None:
            self._faults.object_from_world = inverse(pose)
        return replace(probe, world_from_object=pose)

    def _boundary(self, mesh: trimesh.Trimesh, world_from_object: FloatArray) -> FloatArray:
        """Return centres (N, 3) of the voxels where the object is known not to be."""
        lattice, chosen = self._voxels.lattice, self.settings.boundary
        vertices = apply(world_from_object, np.asarray(mesh.vertices))
        parts = {"box_shell": box_shell(lattice, self.workspace)}
        parts["floor_slab"] = floor_slab(lattice, vertices)
        points = np.concatenate([part for name, part in parts.items() if chosen in (name, "both")])
        # Some configurations reach out of their workspace; free points within the object would lie.
        return points[mesh_sdf(mesh, apply(inverse(world_from_object), points))[0] > 0.0]


def choose_workspace(configuration: Configuration, settings: ProbingSettings) -> Workspace:
    """Return the box in which the object is sought."""
    if settings.workspace == "paper" and configuration.name != FITTED:
        return WORKSPACE
    return configuration.workspace


def floor_slab(lattice: Lattice, vertices: FloatArray) -> FloatArray:
    """Return centres of the lattice's lowest layers, under and around vertices (V, 3)."""
    low = lattice.voxels(vertices.min(axis=0, keepdims=True) - SLAB_MARGIN)[0]
    high = lattice.voxels(vertices.max(axis=0, keepdims=True) + SLAB_MARGIN)[0]
    low[2], high[2] = 0, SLAB_LAYERS - 1
    return lattice.centres(low + np.argwhere(np.ones(high - low + 1, dtype=bool)))


def box_shell(lattice: Lattice, workspace: Workspace) -> FloatArray:
    """Return centres of one layer of voxels on the six faces of the workspace."""
    last = lattice.voxels(workspace.bounds[1:])[0]
    shell = np.ones(last + 1, dtype=bool)
    shell[1:-1, 1:-1, 1:-1] = False
    return lattice.centres(np.argwhere(shell))


def swept_voxels(lattice: Lattice, interior: FloatArray, *, positions: FloatArray) -> FloatArray:
    """Return centres of the voxels that interior (M, 3) meets at one of positions (P, 3)."""
    bounds = np.array([positions.min(axis=0), positions.max(axis=0)])
    bounds += [interior.min(axis=0), interior.max(axis=0)]
    low, high = lattice.voxels(bounds)
    met = np.zeros(high - low + 1, dtype=bool)
    for position in np.unique(positions, axis=0):
        met[tuple((lattice.voxels(interior + position) - low).T)] = True
    return lattice.centres(low + np.argwhere(met))
