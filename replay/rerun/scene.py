"""The 3-D scene of a Rerun recording: object, known points, gripper, hand, hypotheses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from chsel.events import Believed, Probe
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import inverse, quaternions
from chsel.problem.registration_problem import Hypotheses
from replay.colors import (
    CONTACT,
    FRAME,
    FREE,
    FREE_FAINT,
    GRIPPER,
    HAND,
    KNOWN,
    OBJECT,
    OCCUPIED,
    PAST,
    SERIES,
    CostScale,
    Rgb,
    cost_colors,
)
from replay.mcap.viewer_messages import ellipsoids, simple_mesh

if TYPE_CHECKING:
    import trimesh

    from chsel.next_probe.decision_problem import HandShape

NORMAL_LENGTH = 0.035  # in diagonals of the workspace
CUMULATIVE = ("free", "occupied", "contacts", "contacts/normals", "known", "gripper/past")
"""Entities to which each probe adds: a view shows these over all probes so far."""
HIDDEN = np.zeros((1, 4, 4))
"""A pose that shows nothing: without any, the viewer draws the mesh once, at the origin."""
LEVELS = 8
"""Steps of the cost scale; a mesh entity has one colour, so each step is an entity."""
MOST = 200
"""More hypotheses than these are not drawn: the lowest in cost are."""
_ALPHA = (48, 10)  # opacities of the lowest and the highest step, of 255
_BEST_ALPHA = 150
_DISPLAY_FACES = 6000  # meshes with more are coarsened for display
_HAND_ALPHA = 80


class Scene:
    """The entity `scene`: everything but hypotheses and actions."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._normal_length = 0.0
        self._has_hand = False

    def set_up(
        self, mesh: trimesh.Trimesh, workspace: Workspace, *, world_from_object: FloatArray | None
    ) -> None:
        """Draw what does not change: the workspace, and the object at its true pose where known."""
        self._stream.log("scene", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        lower, upper = workspace.bounds
        self._normal_length = NORMAL_LENGTH * float(np.linalg.norm(upper - lower))
        box = rr.Boxes3D(
            mins=[lower], sizes=[upper - lower], colors=[FRAME], radii=on_screen(0.6), fill_mode=1
        )
        self._stream.log("scene/workspace", box, static=True)
        self._first_pose = world_from_object
        if world_from_object is not None:
            self.add_mesh("object", mesh, world_from_mesh=world_from_object, color=(*OBJECT, 255))

    def add_mesh(
        self,
        name: str,
        mesh: trimesh.Trimesh,
        *,
        world_from_mesh: FloatArray,
        color: tuple[int, int, int, int],
    ) -> None:
        """Draw a mesh at one pose (4, 4) all the time."""
        pose = rr.Transform3D(translation=world_from_mesh[:3, 3], mat3x3=world_from_mesh[:3, :3])
        self._stream.log(f"scene/{name}", display_mesh(mesh, color), pose, static=True)

    def add_hand(self, hand: trimesh.Trimesh | HandShape) -> None:
        """Draw the hand, which probes show where they are deepest."""
        drawn = display_mesh(coarsened(hand), (*HAND, _HAND_ALPHA))
        self._stream.log("scene/hand", drawn, static=True)
        self._stream.log("scene/hand", mesh_poses(HIDDEN))
        self._has_hand = True

    def add_points(self, points: KnownPoints) -> None:
        """Draw points that become known."""
        exact = points.sdf == 0.0
        self._points("free", points.free, color=FREE_FAINT, size=0.9)
        self._points("occupied", points.occupied, color=OCCUPIED, size=2.5)
        self._points("known", points.known[~exact], color=KNOWN, size=3.0)
        self._points("contacts", points.known[exact], color=CONTACT, size=5.0)

    def add_probe(self, probe: Probe) -> None:
        """Draw the gripper's path, contacts and new points, stronger for this probe."""
        path = probe.gripper_path
        self.add_points(probe.new_points)
        if probe.world_from_object is not None and self._first_pose is not None:
            since = inverse(self._first_pose) @ probe.world_from_object
            self._stream.log("scene/object", mesh_poses(since[None]))
        self._points("free/new", probe.new_points.free, color=FREE, size=1.4)
        self._points("contacts/new", probe.contacts, color=CONTACT, size=7.0)
        self._points("gripper/end", path[-1:, :3, 3], color=GRIPPER, size=4.0)
        strips = [path[:, :3, 3]] if len(path) > 1 else []
        for name, color, width in (("past", PAST, 0.4), ("path", GRIPPER, 0.8)):
            line = rr.LineStrips3D(strips, colors=[color], radii=on_screen(width))
            self._stream.log(f"scene/gripper/{name}", line)
        known = np.abs(probe.contact_normals).sum(axis=1) > 0.0
        normals = rr.Arrows3D(
            origins=probe.contacts[known],
            vectors=self._normal_length * probe.contact_normals[known],
            colors=[CONTACT],
            radii=on_screen(1.4),
        )
        self._stream.log("scene/contacts/normals", normals)
        if self._has_hand:
            pose = path[None, deepest(path)] if len(path) else HIDDEN
            self._stream.log("scene/hand", mesh_poses(pose))

    def show_modes(self, believed: Believed) -> None:
        """Draw the object's centre in each mode as an ellipsoid of two standard deviations."""
        places, half_sizes = ellipsoids(believed)
        modes = rr.Ellipsoids3D(
            centers=believed.centres,
            half_sizes=half_sizes,
            quaternions=quaternions(places[:, :3, :3]),
            colors=[SERIES[number % len(SERIES)] for number in believed.numbers],
            labels=mode_labels(believed),
            show_labels=False,
        )
        self._stream.log("scene/modes", modes)

    def _points(self, name: str, points: FloatArray, *, color: Rgb, size: float) -> None:
        drawn = rr.Points3D(points, colors=[color], radii=on_screen(size))
        self._stream.log(f"scene/{name}", drawn)


def mode_labels(believed: Believed) -> list[str]:
    """Return the number and weight of each mode."""
    modes = zip(believed.numbers, believed.weights, strict=True)
    return [f"mode {number}: {100.0 * weight:.0f} %" for number, weight in modes]


def on_screen(radius: float) -> np.ndarray:
    """Return a radius in points of the screen, however far away."""
    return np.asarray(rr.Radius.ui_points(radius))


def coarsened(mesh: trimesh.Trimesh | HandShape, most: int = _DISPLAY_FACES) -> trimesh.Trimesh:
    """Return vertices and faces alone, as an MCAP file keeps them, of a mesh for the eye."""
    import trimesh

    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    return whole if len(mesh.faces) <= most else trimesh.Trimesh(*simple_mesh(whole, most))


def display_mesh(
    mesh: trimesh.Trimesh, color: tuple[int, int, int, int] | None = None
) -> rr.Mesh3D:
    """Return a mesh for the viewer, smoothly shaded; None leaves its colour open."""
    return rr.Mesh3D(
        vertex_positions=mesh.vertices,
        triangle_indices=mesh.faces,
        vertex_normals=mesh.vertex_normals,
        albedo_factor=color,
    )


def mesh_poses(world_from_mesh: FloatArray) -> rr.InstancePoses3D:
    """Return the instances of the mesh of an entity, one at each pose (N, 4, 4)."""
    return rr.InstancePoses3D(
        translations=world_from_mesh[:, :3, 3], mat3x3=world_from_mesh[:, :3, :3]
    )


def deepest(gripper_path: FloatArray) -> int:
    """Return the index of the pose (P, 4, 4) furthest along z of the first, the approach."""
    advance = (gripper_path[:, :3, 3] - gripper_path[0, :3, 3]) @ gripper_path[0, :3, 2]
    return int(np.argmax(advance))


class HypothesisMeshes:
    """Sets of hypotheses under the entity `root`: one mesh a step of the scale, and poses."""

    def __init__(self, stream: rr.RecordingStream, root: str = "scene/hypotheses") -> None:
        self._stream = stream
        self._root = root

    def set_up(self, mesh: trimesh.Trimesh) -> None:
        """Store the object's mesh once for each colour, and show none."""
        opacities = np.linspace(*_ALPHA, LEVELS).round().astype(int).tolist()
        for level, opacity in enumerate(opacities):
            drawn = display_mesh(mesh, _color(level, opacity))
            self._stream.log(f"{self._root}/{_name(level)}", drawn, static=True)
        self._stream.log(f"{self._root}/best", display_mesh(mesh), static=True)
        self.hide()

    def draw(self, hypotheses: Hypotheses, scale: CostScale | None = None) -> None:
        """Show the hypotheses that repeat no other, at most MOST; the first is the best.

        scale: of the colours; by default that of the hypotheses shown.
        """
        shown = shown_hypotheses(hypotheses)
        poses = inverse(hypotheses.object_from_world[shown])
        cost = hypotheses.cost[shown]
        levels = cost_levels(cost, scale)
        if len(levels):
            best = rr.Mesh3D.from_fields(albedo_factor=_color(levels[0], _BEST_ALPHA))
            self._stream.log(f"{self._root}/best", best)
        levels[:1] = -1
        self._poses("best", poses[:1], cost=cost[:1])
        for level in range(LEVELS):
            chosen = levels == level
            self._poses(_name(level), poses[chosen], cost=cost[chosen])

    def hide(self) -> None:
        """Show none."""
        for name in ("best", *map(_name, range(LEVELS))):
            self._poses(name, HIDDEN[:0], cost=np.zeros(0))

    def _poses(self, name: str, world_from_object: FloatArray, *, cost: FloatArray) -> None:
        if len(world_from_object) == 0:
            world_from_object = HIDDEN
            cost = np.full(1, np.nan)
        poses = mesh_poses(world_from_object)
        self._stream.log(f"{self._root}/{name}", poses, rr.AnyValues(cost=cost))


def shown_hypotheses(hypotheses: Hypotheses) -> IntArray:
    """Return indices of the hypotheses that are drawn: no duplicates, the lowest in cost."""
    return np.flatnonzero(~hypotheses.duplicate)[:MOST]


def cost_levels(cost: FloatArray, scale: CostScale | None = None) -> IntArray:
    """Return the step of the cost scale, from 0, of each cost (B,); by default among its like."""
    fraction = (scale or CostScale.of(cost)).fraction(cost)
    return np.minimum((fraction * LEVELS).astype(np.int64), LEVELS - 1)


def _name(level: int) -> str:
    return f"cost_step_{level + 1}"


def _color(level: int, opacity: int) -> tuple[int, int, int, int]:
    red, green, blue = cost_colors((level + 0.5) / LEVELS).tolist()
    return red, green, blue, opacity
