"""The 3-D scene of a Rerun recording: workspace, object, known points, gripper, hypotheses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints, Workspace
from replay.colors import (
    CONTACT,
    FRAME,
    FREE,
    FREE_FAINT,
    GRIPPER,
    KNOWN,
    OBJECT,
    OCCUPIED,
    PAST,
    Rgb,
)
from replay.events import Probe
from replay.rerun.meshes import display_mesh
from replay.rerun.plane import color_array, on_screen

if TYPE_CHECKING:
    import trimesh

NORMAL_LENGTH = 0.035  # in diagonals of the workspace
CUMULATIVE = ("free", "occupied", "contacts", "contacts/normals", "known", "gripper/past")
"""What each probe adds to: a view shows these over all probes up to the moment."""


class Scene:
    """Draws everything but the hypotheses under the entity `root`."""

    def __init__(self, stream: rr.RecordingStream, root: str = "scene") -> None:
        self._stream = stream
        self._root = root
        self._normal_length = 0.0
        self._empty: set[str] = set()  # entities that show nothing, by what was logged last

    def set_up(
        self, mesh: trimesh.Trimesh, workspace: Workspace, world_from_object: FloatArray | None
    ) -> None:
        """What does not change: the workspace, and the object at its true pose where known."""
        self._log("", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        lower, upper = workspace.bounds
        self._normal_length = NORMAL_LENGTH * float(np.linalg.norm(upper - lower))
        box = rr.Boxes3D(
            mins=[lower],
            sizes=[upper - lower],
            colors=color_array(FRAME),
            radii=on_screen(0.6),
            fill_mode="MajorWireframe",
        )
        self._log("workspace", box, static=True)
        if world_from_object is None:
            return
        pose = rr.Transform3D(
            translation=world_from_object[:3, 3], mat3x3=world_from_object[:3, :3]
        )
        self._log("object", display_mesh(mesh, (*OBJECT, 255)), pose, static=True)

    def add_points(self, points: KnownPoints, *, new: bool) -> None:
        """Points that become known; `new` ones are also shown stronger until the next probe."""
        exact = points.sdf == 0.0
        self._points("free", points.free, FREE_FAINT, size=0.9)
        self._points("occupied", points.occupied, OCCUPIED, size=2.5)
        self._points("known", points.known[~exact], KNOWN, size=3.0)
        self._points("contacts", points.known[exact], CONTACT, size=5.0)
        if new:
            self._points("free/new", points.free, FREE, size=1.4)

    def add_probe(self, probe: Probe) -> None:
        """The gripper's path, what it met, and what became known."""
        self.add_points(probe.new_points, new=True)
        path = probe.gripper_path[:, :3, 3].astype(np.float32)
        self._log("gripper/past", _path(path, PAST, 0.8))
        self._log("gripper/path", _path(path, GRIPPER, 1.6))
        self._points("gripper/end", probe.gripper_path[-1:, :3, 3], GRIPPER, size=4.0)
        self._normals(probe)
        self._points("contacts/new", probe.contacts, CONTACT, size=7.0)

    def _normals(self, probe: Probe) -> None:
        known = np.abs(probe.contact_normals).sum(axis=1) > 0.0
        if self._stays_empty("contacts/normals", not known.any()):
            return
        arrows = rr.Arrows3D(
            origins=probe.contacts[known].astype(np.float32),
            vectors=(self._normal_length * probe.contact_normals[known]).astype(np.float32),
            colors=color_array(CONTACT),
            radii=on_screen(1.4),
        )
        self._log("contacts/normals", arrows)

    def _points(self, name: str, points: FloatArray, color: Rgb, *, size: float) -> None:
        if self._stays_empty(name, len(points) == 0):
            return
        positions = np.ascontiguousarray(points, dtype=np.float32)
        self._log(name, rr.Points3D(positions, colors=color_array(color), radii=on_screen(size)))

    def _stays_empty(self, name: str, empty: bool) -> bool:
        """Whether there is nothing to log about an entity, which was empty and is so now."""
        before = name in self._empty
        (self._empty.add if empty else self._empty.discard)(name)
        return empty and before

    def _log(
        self, name: str, what: rr.AsComponents, *more: rr.AsComponents, static: bool = False
    ) -> None:
        self._stream.log(f"{self._root}/{name}" if name else self._root, what, *more, static=static)


def _path(path: np.ndarray, color: Rgb, width: float) -> rr.LineStrips3D:
    strips = [path] if len(path) > 1 else []
    return rr.LineStrips3D(strips, colors=color_array(color), radii=on_screen(width / 2))
