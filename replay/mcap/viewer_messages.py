"""Messages that other viewers draw: the object, the hypotheses, all points.

Foxglove draws the meshes. Rerun passes them by and draws the clouds. All of it repeats what other
messages say, rounded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TriangleListPrimitive_pb2 import TriangleListPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3

from chsel.events import Believed, Decided, Event, HypothesesFound, Probe, SessionStarted
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.problem.points import POINT_CLASSES, KnownPoints
from chsel.problem.poses import compose, inverse, quaternions
from chsel.problem.registration_problem import Hypotheses
from replay.colors import CONTACT, FREE, OCCUPIED, SERIES, ColorArray, cost_colors
from replay.colors import OBJECT as OBJECT_COLOR
from replay.mcap.foxglove_messages import (
    LEVELS,
    UNMOVED,
    VIEWS,
    WORLD,
    serialized,
    stamp,
)

if TYPE_CHECKING:
    import trimesh

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
_OBJECT = "object"  # the frame
_ARROW = 0.01  # metres: width of the arrow of the next probe
_MODE_OPACITY = 0.5
_LEAST_SIZE = 5e-4  # metres: half an ellipsoid's, to be seen
_MOST_FACES = 400
_FINEST, _COARSEST = 40, 4  # cells along the longest side of a mesh's bounds
_BLOCKS = 8  # that one level of all points holds before they move to the next
_POINT = np.dtype([("position", "<f4", 3), ("color", "u1", 4)])


View = tuple[str, Callable[[int], bytes]]
"""A topic, and what makes its message of the log time, nanoseconds."""


class Views:
    """The messages for viewers that follow those of an event."""

    def __init__(self) -> None:
        self._points = {name: CumulativePoints() for name in POINT_CLASSES}
        self._scene: SceneMessages | None = None

    def after(self, event: Event) -> Iterator[View]:
        """Yield messages in their order; each is made when it is written."""
        match event:
            case SessionStarted():
                self._scene = SceneMessages(event.mesh)
                yield from self._all_points(event.initial_points)
                if event.world_from_object is not None:
                    yield "/object_pose", partial(object_in_world, event.world_from_object)
                    yield "/object_mesh", self._scene.object_mesh
                    yield "/object_surface", self._scene.object_surface
            case Probe():
                yield from self._all_points(event.new_points)
                if event.world_from_object is not None:
                    yield "/object_pose", partial(object_in_world, event.world_from_object)
                if len(event.gripper_path) > 0:
                    yield "/gripper_path", partial(poses_in_world, event.gripper_path)
            case HypothesesFound() if len(event.hypotheses.object_from_world) > 0:
                found = event.hypotheses
                yield "/hypothesis_poses", partial(poses_in_world, inverse(found.object_from_world))
                assert self._scene is not None
                shown = _shown(found)
                yield "/hypothesis_meshes", partial(self._scene.hypothesis_meshes, *shown)
                yield "/hypothesis_surfaces", partial(self._scene.hypothesis_surfaces, *shown)
            case Decided():
                yield "/next_probe", partial(next_probe, event)
            case Believed():
                yield "/modes", partial(modes, event)

    def _all_points(self, new: KnownPoints) -> Iterator[View]:
        """Yield the clouds of all points so far that change with new ones."""
        for name, cumulative in self._points.items():
            points = getattr(new, name)
            for level, cloud in cumulative.add(points).items() if len(points) else ():
                topic = f"/all_points/{name}/{level}"
                yield topic, partial(colored_cloud, cloud, POINT_COLORS[name])


class SceneMessages:
    """The messages of one object."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self._vertices, faces = simple_mesh(mesh)
        step = -(-len(self._vertices) // _SURFACE_POINTS)
        self._surface = self._vertices[::step]  # (S, 3)
        points = [Point3(x=x, y=y, z=z) for x, y, z in self._vertices.tolist()]
        self._points = serialized(TriangleListPrimitive(points=points))
        self._faces = serialized(TriangleListPrimitive(indices=faces.ravel().tolist()))

    def object_mesh(self, time: int) -> bytes:
        """Return the object where the frame "object" is."""
        color = (*OBJECT_COLOR, _OBJECT_OPACITY)
        return self._scene("object", _OBJECT, poses=np.eye(4)[None], colors=[color], time=time)

    def object_surface(self, time: int) -> bytes:
        """Return vertices of the object where the frame "object" is."""
        color = np.array(OBJECT_COLOR, np.uint8)
        return colored_cloud(self._vertices, color, time=time, frame=_OBJECT)

    def hypothesis_meshes(self, poses: FloatArray, colors: ColorArray, time: int) -> bytes:  # noqa: PLR0917
        """Return the object at each hypothesis (D, 4, 4), in its color (D, 3), the best bright."""
        opacities = [_BEST_OPACITY, *[_OTHER_OPACITY] * len(poses)]
        shown = [(*color, a) for color, a in zip(colors.tolist(), opacities, strict=False)]
        return self._scene("hypotheses", WORLD, poses=poses, colors=shown, time=time)

    def hypothesis_surfaces(self, poses: FloatArray, colors: ColorArray, time: int) -> bytes:  # noqa: PLR0917
        """Return points of the surface of the object at each hypothesis."""
        points = self._surface @ poses[:, :3, :3].swapaxes(-1, -2) + poses[:, None, :3, 3]
        return colored_cloud(
            points.reshape(-1, 3), np.repeat(colors, len(self._surface), axis=0), time=time
        )

    def _scene(
        self,
        name: str,
        frame: str,
        *,
        poses: FloatArray,
        colors: list[tuple[float, ...]],
        time: int,
    ) -> bytes:
        """Return the object at poses (B, 4, 4), each in a color: RGB to 255, opacity to 1.

        A message is the bytes of its fields in their order, so those of the mesh are made once.
        """
        entity = SceneEntity(timestamp=stamp(time), id=name, frame_id=frame, frame_locked=True)
        parts = [serialized(entity)]
        for pose, (r, g, b, a) in zip(_poses(poses), colors, strict=True):
            color = Color(r=r / 255.0, g=g / 255.0, b=b / 255.0, a=a)
            placed = serialized(TriangleListPrimitive(pose=pose))
            colored = serialized(TriangleListPrimitive(color=color))
            data = placed + self._points + colored + self._faces
            parts.append(_field(SceneEntity.TRIANGLES_FIELD_NUMBER, data))
        return _field(SceneUpdate.ENTITIES_FIELD_NUMBER, b"".join(parts))


class CumulativePoints:
    """Points spread over levels: the newest at level 0, each further level 8 times as large.

    The levels together hold all points. A level is written when it changes, so that a point
    is written about 4 times at each level it passes, however long the session. Writing all points
    at every step would take quadratic space.
    """

    def __init__(self) -> None:
        self._levels: list[list[FloatArray]] = [[] for _ in range(LEVELS)]

    def add(self, points: FloatArray) -> dict[int, FloatArray]:
        """Take new points (N, 3); the levels that change, and all points (M, 3) of each."""
        changed: dict[int, FloatArray] = {}
        moving = [points]
        for level, blocks in enumerate(self._levels):
            if len(blocks) < _BLOCKS - 1 or level == LEVELS - 1:
                blocks.append(np.concatenate(moving))
                changed[level] = np.concatenate(blocks)
                break
            moving = [*blocks, *moving]
            blocks.clear()
            changed[level] = np.zeros((0, 3))
        return changed


def poses_in_world(world_from_body: FloatArray, time: int) -> bytes:
    """Return poses (B, 4, 4) as positions and quaternions."""
    poses = _poses(world_from_body)
    return serialized(PosesInFrame(timestamp=stamp(time), frame_id=WORLD, poses=poses))


def next_probe(event: Decided, time: int) -> bytes:
    """Return the chosen action as an arrow along the hand's way; nothing after a stop."""
    entity = SceneEntity(timestamp=stamp(time), id="next probe", frame_id=WORLD)
    chosen, actions = event.decision.chosen, event.problem.actions
    if chosen >= 0:
        start = actions.world_from_hand[chosen]
        along = [start[:3, 2], start[:3, 0], start[:3, 1]]  # an arrow points along its x axis
        pose = start.copy()
        pose[:3, :3] = np.stack(along, axis=1)
        length = float(actions.length[chosen])
        (place,) = _poses(pose[None])
        entity.arrows.add(
            pose=place,
            shaft_length=0.8 * length,
            shaft_diameter=_ARROW,
            head_length=0.2 * length,
            head_diameter=2.5 * _ARROW,
            color=Color(r=CONTACT[0] / 255.0, g=CONTACT[1] / 255.0, b=CONTACT[2] / 255.0, a=1.0),
        )
    return serialized(SceneUpdate(entities=[entity]))


def modes(event: Believed, time: int) -> bytes:
    """Return the ellipsoid of each mode, in a color by its number; nothing without modes."""
    entity = SceneEntity(timestamp=stamp(time), id="modes", frame_id=WORLD)
    places, half_sizes = ellipsoids(event)
    for pose, size, number in zip(_poses(places), 2.0 * half_sizes, event.numbers, strict=True):
        r, g, b = (value / 255.0 for value in SERIES[number % len(SERIES)])
        color = Color(r=r, g=g, b=b, a=_MODE_OPACITY)
        entity.spheres.add(pose=pose, size=Vector3(x=size[0], y=size[1], z=size[2]), color=color)
    return serialized(SceneUpdate(entities=[entity]))


def ellipsoids(event: Believed) -> tuple[FloatArray, FloatArray]:
    """Return ellipsoids of two standard deviations around the object's centre in each mode.

    Poses world_from_ellipsoid (M, 4, 4), along whose axes the half sizes (M, 3) are, metres.
    """
    squares, axes = np.linalg.eigh(event.covariances[:, :3, :3])
    axes[np.linalg.det(axes) < 0.0] *= -1.0
    half_sizes = np.maximum(2.0 * np.sqrt(np.maximum(squares, 0.0)), _LEAST_SIZE)
    return compose(axes, event.centres), half_sizes


def object_in_world(world_from_object: FloatArray, time: int) -> bytes:
    """Return the pose (4, 4) of the object as a transform between frames."""
    (pose,) = _poses(world_from_object[None])
    transform = FrameTransform(
        timestamp=stamp(time),
        parent_frame_id=WORLD,
        child_frame_id=_OBJECT,
        translation=pose.position,
        rotation=pose.orientation,
    )
    return serialized(transform)


def colored_cloud(points: FloatArray, color: ColorArray, time: int, frame: str = WORLD) -> bytes:  # noqa: PLR0917
    """Return points (N, 3), rounded to float32, in one color (3,) or a color each (N, 3)."""
    data = np.zeros(len(points), _POINT)
    with np.errstate(over="ignore"):
        data["position"] = points
    data["color"][:, :3] = color
    data["color"][:, 3] = 255
    cloud = PointCloud(
        timestamp=stamp(time),
        frame_id=frame,
        pose=UNMOVED,
        point_stride=_POINT.itemsize,
        data=data.tobytes(),
    )
    for index, name in enumerate(("x", "y", "z")):
        cloud.fields.add(name=name, offset=4 * index, type=PackedElementField.FLOAT32)
    for index, name in enumerate(("red", "green", "blue", "alpha")):
        cloud.fields.add(name=name, offset=12 + index, type=PackedElementField.UINT8)
    return serialized(cloud)


def empty_cloud(time: int) -> bytes:
    """Return a cloud of no points."""
    return colored_cloud(np.zeros((0, 3)), np.zeros(3, np.uint8), time=time)


def _field(number: int, data: bytes) -> bytes:
    """Return the bytes of a field of a message that is a message of these bytes."""
    numbers = []
    for value in ((number << 3) | 2, len(data)):  # 2: length and bytes follow
        while value > 127:
            numbers.append(value & 127 | 128)
            value >>= 7
        numbers.append(value)
    return bytes(numbers) + data


def _poses(poses: FloatArray) -> list[Pose]:
    """Return poses (B, 4, 4) as positions and quaternions."""
    turned = quaternions(poses[:, :3, :3]).tolist()
    return [
        Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
        for (x, y, z), (qx, qy, qz, qw) in zip(poses[:, :3, 3].tolist(), turned, strict=True)
    ]


def _shown(found: Hypotheses) -> tuple[FloatArray, ColorArray]:
    """Return world_from_object (D, 4, 4) of distinct hypotheses and colors (D, 3), best first."""
    kept = ~found.duplicate & np.isfinite(found.object_from_world).all(axis=(1, 2))
    poses = inverse(found.object_from_world[kept])
    return poses, cost_colors(np.arange(len(poses)) / max(1, len(poses) - 1))


def simple_mesh(mesh: trimesh.Trimesh, most: int = _MOST_FACES) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and at most `most` faces (F, 3) that look like a mesh, in its frame.

    Vertices are joined cell by cell of a grid that becomes coarser until the faces are few enough.
    """
    vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
    cells = _FINEST
    while len(faces) > most and cells >= _COARSEST:
        vertices, faces = _joined(vertices, faces, cells=cells)
        cells -= 1
    used, faces = np.unique(faces[:most], return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _joined(vertices: FloatArray, faces: IntArray, *, cells: int) -> tuple[FloatArray, IntArray]:
    """Return the vertices of each cell as one, their mean; without the faces that vanish."""
    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    side = max(float((upper - lower).max()) / cells, np.finfo(np.float64).tiny)
    place = np.minimum(np.floor((vertices - lower) / side), cells - 1).astype(np.int64)
    cell = (place[:, 0] * cells + place[:, 1]) * cells + place[:, 2]
    _, joined, counts = np.unique(cell, return_inverse=True, return_counts=True)
    sums = [np.bincount(joined, weights=vertices[:, axis]) for axis in range(3)]
    vertices = np.stack(sums, axis=-1) / counts[:, None]
    faces = joined[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return vertices, faces[np.sort(first)]
