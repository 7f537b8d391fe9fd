"""What a viewer draws of a session without our help: the object, the hypotheses, all points.

Foxglove draws the meshes. Rerun passes them by and draws the clouds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TriangleListPrimitive_pb2 import TriangleListPrimitive

from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints
from chsel.problem.poses import inverse, quaternions
from chsel.problem.registration_problem import Hypotheses
from replay.events import Event, HypothesesFound, Probe, SessionStarted
from replay.lost_attachment import is_lost
from replay.mcap.cumulative_points import CumulativePoints
from replay.mcap.foxglove_messages import (
    OBJECT,
    POINT_CLASSES,
    VIEWS,
    WORLD,
    object_in_world,
    poses_in_world,
    set_pose,
    set_stamp,
)
from replay.mcap.simple_mesh import SimpleMesh, simple_mesh
from replay.rerun.colors import CONTACT, FREE, OCCUPIED, ColorArray, cost_colors
from replay.rerun.colors import OBJECT as OBJECT_COLOR

POINT_COLORS: Mapping[str, ColorArray] = {
    "free": np.array(FREE, np.uint8),
    "occupied": np.array(OCCUPIED, np.uint8),
    "known": np.array(CONTACT, np.uint8),
}
STARTING_EMPTY = tuple(
    name for name in VIEWS if name.startswith("/all_points/") or name == "/hypothesis_surfaces"
)
"""Topics of clouds that come later. Rerun reports an error for those that have no message yet."""

_OBJECT_OPACITY = 0.6
_BEST_OPACITY, _OTHER_OPACITY = 0.9, 0.25
_SURFACE_POINTS = 100  # of each hypothesis
_POINT = np.dtype([("position", "<f4", 3), ("color", "u1", 4)])


View = tuple[str, Callable[[int], bytes]]
"""A topic, and what makes its message of the log time, nanoseconds."""


class Views:
    """Makes the messages for viewers that follow those of an event."""

    def __init__(self) -> None:
        self._points = {name: CumulativePoints() for name in POINT_CLASSES}
        self._scene: SceneMessages | None = None

    def after(self, event: Event) -> Iterator[View]:
        """Messages in their order; each is made when it is written."""
        match event:
            case SessionStarted():
                self._scene = (
                    None if is_lost(event.mesh) else SceneMessages(simple_mesh(event.mesh))
                )
                yield from self._all_points(event.initial_points)
                if event.world_from_object is not None:
                    yield "/object_pose", partial(object_in_world, event.world_from_object)
                    if self._scene is not None:
                        yield "/object_mesh", self._scene.object_mesh
                        yield "/object_surface", self._scene.object_surface
            case Probe():
                yield from self._all_points(event.new_points)
                if len(event.gripper_path) > 0:
                    yield "/gripper_path", partial(poses_in_world, event.gripper_path)
            case HypothesesFound() if len(event.hypotheses.object_from_world) > 0:
                found = event.hypotheses
                yield "/hypothesis_poses", partial(poses_in_world, inverse(found.object_from_world))
                if self._scene is not None:
                    yield "/hypothesis_meshes", partial(self._scene.hypothesis_meshes, found)
                    yield "/hypothesis_surfaces", partial(self._scene.hypothesis_surfaces, found)

    def _all_points(self, new: KnownPoints) -> Iterator[View]:
        """The clouds of all points so far that change with new ones."""
        for name, cumulative in self._points.items():
            points = getattr(new, name)
            for level, cloud in cumulative.add(points).items() if len(points) else ():
                topic = f"/all_points/{name}/{level}"
                yield topic, partial(colored_cloud, cloud, POINT_COLORS[name])


class SceneMessages:
    """Makes the messages of one object."""

    def __init__(self, mesh: SimpleMesh) -> None:
        self._mesh = mesh
        step = -(-len(mesh.vertices) // _SURFACE_POINTS)
        self._surface = mesh.vertices[::step]  # (S, 3)
        self._triangles = TriangleListPrimitive(indices=mesh.faces.ravel().tolist())
        for x, y, z in mesh.vertices.tolist():
            self._triangles.points.add(x=x, y=y, z=z)

    def object_mesh(self, time: int) -> bytes:
        """The object where the frame "object" is."""
        return self._scene("object", OBJECT, [np.eye(4)], [(*OBJECT_COLOR, _OBJECT_OPACITY)], time)

    def object_surface(self, time: int) -> bytes:
        """Vertices of the object where the frame "object" is."""
        color = np.array(OBJECT_COLOR, np.uint8)
        return colored_cloud(self._mesh.vertices, color, time, frame=OBJECT)

    def hypothesis_meshes(self, found: Hypotheses, time: int) -> bytes:
        """The object at each distinct hypothesis, the best one bright."""
        poses, colors = _shown(found)
        opacities = [_BEST_OPACITY, *[_OTHER_OPACITY] * len(poses)]
        shown = [(*color, a) for color, a in zip(colors.tolist(), opacities, strict=False)]
        return self._scene("hypotheses", WORLD, poses, shown, time)

    def hypothesis_surfaces(self, found: Hypotheses, time: int) -> bytes:
        """The same as points of the surface."""
        poses, colors = _shown(found)
        points = self._surface @ poses[:, :3, :3].swapaxes(-1, -2) + poses[:, None, :3, 3]
        return colored_cloud(
            points.reshape(-1, 3), np.repeat(colors, len(self._surface), axis=0), time
        )

    def _scene(self, name: str, frame: str, poses: Any, colors: Any, time: int) -> bytes:
        message = SceneUpdate()
        entity = message.entities.add(id=name, frame_id=frame, frame_locked=True)
        set_stamp(entity.timestamp, time)
        poses = np.asarray(poses)
        turned = quaternions(poses[:, :3, :3]).tolist()
        rows = zip(poses[:, :3, 3].tolist(), turned, colors, strict=True)
        for position, quaternion, (r, g, b, a) in rows:
            triangles = entity.triangles.add()
            triangles.CopyFrom(self._triangles)
            set_pose(triangles.pose, position, quaternion)
            color = triangles.color
            color.r, color.g, color.b, color.a = r / 255.0, g / 255.0, b / 255.0, a
        return message.SerializeToString(deterministic=True)


def colored_cloud(points: FloatArray, color: ColorArray, time: int, frame: str = WORLD) -> bytes:
    """Points (N, 3), rounded to float32, in one color (3,) or a color each (N, 3)."""
    data = np.zeros(len(points), _POINT)
    with np.errstate(over="ignore"):
        data["position"] = points
    data["color"][:, :3] = color
    data["color"][:, 3] = 255
    message = PointCloud(frame_id=frame, point_stride=_POINT.itemsize, data=data.tobytes())
    for index, name in enumerate(("x", "y", "z")):
        message.fields.add(name=name, offset=4 * index, type=PackedElementField.FLOAT32)
    for index, name in enumerate(("red", "green", "blue", "alpha")):
        message.fields.add(name=name, offset=12 + index, type=PackedElementField.UINT8)
    message.pose.orientation.w = 1.0
    set_stamp(message.timestamp, time)
    return message.SerializeToString(deterministic=True)


def empty_cloud(time: int) -> bytes:
    """A cloud of no points."""
    return colored_cloud(np.zeros((0, 3)), np.zeros(3, np.uint8), time)


def _shown(found: Hypotheses) -> tuple[FloatArray, ColorArray]:
    """world_from_object (D, 4, 4) of distinct hypotheses, best first, and colors (D, 3) by rank."""
    kept = ~found.duplicate & np.isfinite(found.object_from_world).all(axis=(1, 2))
    poses = inverse(found.object_from_world[kept])
    return poses, cost_colors(np.arange(len(poses)) / max(1, len(poses) - 1))
