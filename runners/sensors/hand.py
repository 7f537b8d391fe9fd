"""The hand: its solid parts, boxes of the rig and links of a URDF, and what they sweep."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from chsel.errors import SettingError
from chsel.numerics.arrays import FloatArray, IntArray, refuse_special_file
from chsel.problem.mesh_parts import outer_surface
from chsel.problem.points import Lattice
from chsel.problem.poses import compose, roll_pitch_yaw
from chsel.sensing.free_space import interior_lattice, poses_between
from runners.sensors.cell import RobotCell
from runners.sensors.log.probe_windows import ProbeWindow
from runners.sensors.log.transforms import JointHistory
from runners.sensors.rig import BoxRig, HandRig
from runners.sensors.session_report import Counts
from runners.sensors.urdf import urdf_class

if TYPE_CHECKING:
    import trimesh

HAND = "hand"
"""Name under which the hand is counted."""
MOST_POSES = 200  # of a probe's path, as it is shown
_BATCH = 50_000  # poses looked up at once
_MOVING = ("revolute", "continuous", "prismatic")


class HandModel:
    """The solids of a hand, read once, placed as often as joints move."""

    frame: str
    """Frame of the hand in the log."""

    joint_names: tuple[str, ...]
    """Joints whose values move any of the solids."""

    sliding: frozenset[str]
    """Names of the joints that are prismatic."""

    warnings: list[str]
    """Warnings of how the solids were read."""

    def __init__(self, rig: HandRig) -> None:
        """Read the solids. Raise SettingError for a URDF that cannot be used."""
        self.frame = rig.frame
        self.joint_names = ()
        self.sliding = frozenset()
        self.warnings = []
        self._boxes = [box_mesh(box) for box in rig.boxes]
        self._links: list[tuple[str, trimesh.Trimesh]] = []  # nodes of the scene, with their solids
        if rig.urdf is not None:
            self._read_urdf(Path(rig.urdf), rig.root)

    def parts(self, joints: Mapping[str, float] | None = None) -> list[trimesh.Trimesh]:
        """Return closed solids in the hand's frame, metres; they may overlap.

        joints: values by name, radians or metres. Those of other joints do not matter, missing
        ones are 0.
        """
        if not self._links:
            return list(self._boxes)
        values = {name: (joints or {}).get(name, 0.0) for name in self.joint_names}
        self._robot.update_cfg(values)
        graph = self._robot.collision_scene.graph
        return self._boxes + [
            solid.copy().apply_transform(graph.get(node, frame_from=self._root)[0])
            for node, solid in self._links
        ]

    def solids(self, joints: Mapping[str, float] | None = None) -> trimesh.Trimesh | None:
        """Return all parts as one mesh of closed bodies; None if the rig describes none."""
        import trimesh

        parts = self.parts(joints)
        joined: Any = trimesh.util.concatenate(parts) if parts else None
        return joined

    def _read_urdf(self, path: Path, root: str | None) -> None:
        """Read the links at and below `root`, which move with it, by yourdfpy."""
        where = f"hand.urdf {path}"
        self._robot = robot = _robot(path.expanduser(), where)
        scene = robot.collision_scene
        self._root = root or scene.graph.base_frame
        if self._root not in robot.link_map:
            names = ", ".join(robot.link_map)
            raise SettingError(f"hand.root {root!r} is not one of {where}; accepted: {names}")
        below = scene.graph.transforms.successors(self._root)
        joints = [j for j in robot.robot.joints if j.parent in below and j.type in _MOVING]
        drivers = (joint.mimic.joint if joint.mimic else joint.name for joint in joints)
        self.joint_names = tuple(dict.fromkeys(drivers))
        kinds = {joint.name: joint.type for joint in robot.robot.joints}
        self.sliding = frozenset(n for n in self.joint_names if kinds[n] == "prismatic")
        for node in scene.graph.nodes_geometry:
            if node in below:
                link = scene.graph.transforms.parents[node]
                mesh = scene.geometry[scene.graph.get(node)[1]]
                self._links.append((node, self._solid(mesh, f"{where}: a mesh of link {link}")))
        if not self._links:
            raise SettingError(
                f"{where} has no collision shape at or below link {self._root}; accepted: one"
            )

    def _solid(self, mesh: Any, name: str) -> trimesh.Trimesh:
        """Return a closed solid, turned outward: a mesh, or its convex hull if it is open."""
        import trimesh

        if mesh.units not in (None, "meters"):
            self.warnings.append(f"{name} states its unit ({mesh.units}), but is taken in metres")
        solid, found = outer_surface(trimesh.Trimesh(mesh.vertices, mesh.faces), name)
        self.warnings += [str(warning) for warning in found]
        if not (solid.is_watertight and solid.is_winding_consistent and solid.volume != 0.0):
            self.warnings.append(f"{name} is open; its convex hull is used")
            solid = solid.convex_hull
        if solid.volume < 0.0:
            solid.invert()
        return solid


def box_mesh(box: BoxRig) -> trimesh.Trimesh:
    """Return a closed box in the frame of its position, metres."""
    import trimesh

    hand_from_box = compose(roll_pitch_yaw(np.array(box.rotation)), np.array(box.position))
    return trimesh.creation.box(box.size, hand_from_box)


def _robot(path: Path, where: str) -> Any:
    """Return the model of a URDF, with the meshes of its collision shapes."""
    reader = urdf_class(path, where)
    content = path.read_bytes()
    if b"<xacro:" in content:
        raise SettingError(f"{where} holds xacro macros; accepted: what the tool xacro makes")
    try:
        ElementTree.fromstring(content)  # yourdfpy logs what is wrong, and goes on
        robot = reader.load(str(path), build_scene_graph=False, load_meshes=False).robot
        leaders = {j.name for j in robot.joints if j.type in _MOVING and j.mimic is None}
        for joint in robot.joints:
            if joint.mimic is not None and joint.mimic.joint not in leaders:
                raise ValueError(
                    f"joint {joint.name} mimics {joint.mimic.joint}, which no value has"
                )
            if joint.type not in _MOVING:  # planar and floating ones would shift others' values
                joint.type = "fixed"
            joint.axis = joint.axis / np.sqrt((joint.axis**2).sum())
        return reader(
            robot,
            build_scene_graph=False,
            build_collision_scene_graph=True,
            load_meshes=False,
            load_collision_meshes=True,
            force_collision_mesh=False,
            filename_handler=partial(_mesh_file, folder=path.resolve().parent),
        )
    except Exception as error:  # it raises whatever it stumbles over
        reason = " ".join(str(error).split())[:200]
        raise SettingError(
            f"{where} cannot be read ({type(error).__name__}: {reason}); accepted: a URDF, a tree "
            "of links and joints with all their attributes, and its meshes"
        ) from None


def _mesh_file(fname: str, folder: Path) -> str:
    """Return the path of a mesh; a package is one of the folders above the URDF, or in one."""
    name = fname.rpartition("://")[2]
    for parent in (folder, *folder.parents):
        for path in (parent / name, parent / name.partition("/")[2]):
            if path.is_file():
                refuse_special_file(f"mesh {path}", path, error=SettingError)
                return str(path)
    raise FileNotFoundError(f"mesh {fname} does not exist in or above {folder}")


class HandPath:
    """The path of the hand, probe by probe, and the free space that follows."""

    def __init__(
        self,
        rig: HandRig,
        model: HandModel,
        *,
        joints: JointHistory,
        times: IntArray,
        cell: RobotCell,
    ) -> None:
        """Make the path of a hand; times (T,): of all transforms, nanoseconds, ascending."""
        self._frame = rig.frame
        self._model = model
        self._joints = joints
        self._times = times
        self._cell = cell
        self._reaches = False  # whether its solids reach the workspace
        self._filled: dict[bytes, FloatArray] = {}  # points in each part, by its vertices

    def follow(self, window: ProbeWindow, counts: Counts) -> FloatArray:
        """Sweep the hand along the path of a probe; some of its poses (P, 4, 4), in their order."""
        shown = [np.zeros((0, 4, 4))]
        states = self._joints.during(window.opens, window.closes)
        ends = [time for time, _ in states[1:]] + [window.closes]
        for (begin, joints), end in zip(states, ends, strict=True):
            if joints is None:
                unknown = int(np.diff(np.searchsorted(self._times, (begin, end)))[0])
                counts.images += unknown
                counts.lost += unknown
                continue
            interior = self._interior(joints)
            reach = float(np.sqrt((interior**2).sum(axis=1).max(initial=0.0)))
            for poses in self._runs(begin, end, counts=counts):
                # No interior point moves by more than half a voxel from one pose to the next.
                dense = poses_between(poses, step=0.5 * self._cell.spacing, radius=reach)
                if len(interior):
                    self._reaches = self._reaches or self._is_near(dense[:, :3, 3], reach)
                    counts.free += self._cell.free.grid.at(interior, poses=dense)
                shown.append(dense)
        path = np.concatenate(shown)
        count = min(len(path), MOST_POSES)
        return path[np.linspace(0, len(path) - 1, count).astype(int)]

    def remark(self, total: Counts) -> str:
        """Return what is suspicious about all that the hand gave; "" if nothing is."""
        if self._reaches or not total.used or self._model.solids() is None:
            return ""
        return (
            f"none of its {total.used} poses brings it into the workspace; check its frame, the "
            "unit of its poses, and the workspace"
        )

    def _is_near(self, places: FloatArray, reach: float) -> bool:
        """Return whether one of points (P, 3) is less than `reach` metres beside the workspace."""
        lower, upper = self._cell.free.workspace.bounds
        return bool(((places > lower - reach) & (places < upper + reach)).all(axis=1).any())

    def _runs(self, begin: int, end: int, *, counts: Counts) -> Iterator[FloatArray]:
        """Yield poses (P, 4, 4) from a time to before another, cut at gaps and jumps."""
        times = self._times[slice(*np.searchsorted(self._times, (begin, end)))]
        cell = self._cell
        jumps = cell.tree.jumps(cell.world, self._frame) if len(times) else times
        for start in range(0, len(times), _BATCH):
            # One pose of the batch before, so that nothing is missing between them.
            stamps = times[max(start - 1, 0) : start + _BATCH]
            poses, known = cell.tree.lookups(
                cell.world, self._frame, stamps_ns=stamps, gap_s=cell.gap
            )
            counts.images += len(stamps)
            counts.used += int(known.sum())
            counts.lost += int(len(stamps) - known.sum())
            jumped = np.searchsorted(jumps, stamps[known], side="right")
            unknown = (np.diff(stamps[known]) > cell.gap * 1e9) | (np.diff(jumped) > 0)
            cuts = np.flatnonzero(unknown) + 1
            yield from (run for run in np.split(poses[known], cuts) if len(run))

    def _interior(self, joints: dict[str, float]) -> FloatArray:
        """Return points (M, 3) in the hand, dense enough to miss no voxel."""
        before, self._filled = self._filled, {}
        side = 0.5 * self._cell.spacing
        for part in self._model.parts(joints):
            place = np.asarray(part.vertices).tobytes()
            known = before.get(place)
            self._filled[place] = interior_lattice(part, side) if known is None else known
        nodes = np.concatenate([np.zeros((0, 3)), *self._filled.values()])
        lattice = Lattice((0.0, 0.0, 0.0), side)
        return lattice.centres(np.unique(lattice.voxels(nodes), axis=0))
