"""The cabinet with its objects, and the hand that probes them.

The hand is a wrist with two soft-bubble pads that point forward, side by side. Its frame `wrist`
has z forward, along world +x; x points down and y to the left.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, pi, sin
from typing import Any

import numpy as np
import trimesh

from chsel.errors import SessionError
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import Workspace
from chsel.problem.poses import apply, axis_angle, compose
from runners.sensors.hand import box_mesh
from runners.sensors.rig import BoxRig
from runners.sessions.configurations import Configuration
from runners.sessions.placement import laid_down
from runners.sessions.probing_hand import ROTATION


def _box(x: Sequence[float], y: Sequence[float], z: Sequence[float]) -> BoxRig:  # noqa: PLR0917
    """Return a box by its bounds along the world's axes."""
    lower, upper = np.array([x, y, z]).T
    (sx, sy, sz) = (upper - lower).tolist()
    (px, py, pz) = ((upper + lower) / 2.0).tolist()
    return BoxRig((sx, sy, sz), (px, py, pz))


# The inside is the workspace and 2 cm to its sides; the shelf is the workspace's lower face. The
# side wall towards the camera and the front lip hide a part of the inside from it.
CABINET = (
    _box((0.66, 1.14), (-0.24, 0.24), (0.29, 0.31)),  # shelf
    _box((0.66, 1.14), (-0.24, 0.24), (0.62, 0.64)),  # ceiling
    _box((1.12, 1.14), (-0.24, 0.24), (0.31, 0.62)),  # back
    _box((0.66, 1.14), (0.22, 0.24), (0.31, 0.62)),  # left wall
    _box((0.66, 1.14), (-0.24, -0.22), (0.31, 0.62)),  # right wall
    _box((0.64, 0.66), (-0.24, 0.24), (0.27, 0.335)),  # front lip
)
ROOM = (
    _box((-1.0, 2.2), (-1.5, 1.6), (-0.05, 0.0)),  # floor
    _box((2.1, 2.2), (-1.5, 1.6), (0.0, 2.5)),  # far wall
    _box((-1.0, 2.1), (1.5, 1.6), (0.0, 2.5)),  # other wall
)

CABINET_WORKSPACE = Workspace((0.7, -0.2, 0.31), (1.1, 0.2, 0.6))
SHELF = 0.31  # m: height of its upper side
REST = (0.53, 0.0, 0.433)  # m: where the wrist is before a push, and what probes are relative to

_ALL = (
    ("cabinet_drill", (0.05, -0.08), (0.0, 0.05, 0.12), (0.93, 0.0), 0.0),
    ("cabinet_drill_opposite", (0.07, -0.11), (-0.03, 0.05, 0.13), (0.90, -0.015), pi + 0.8),
    ("cabinet_mustard", (0.0, 0.05), (-0.02, 0.04, 0.13), (0.93, 0.01), 0.0),
    ("cabinet_mustard_sideways", (0.05, 0.12), (-0.02, 0.04, 0.13), (0.93, 0.06), pi / 2.0),
)
CABINET_CONFIGURATIONS = {
    name: Configuration(
        name,
        name.split("_")[1],
        y=y,
        z=z,
        position=(*place, SHELF),
        rotation=(0.0, 0.0, yaw),
        workspace=CABINET_WORKSPACE,
    )
    for name, y, z, place, yaw in _ALL
}
"""The objects on the shelf, and the grids of their probes (methods, Sec. 10.1).

y, z: the wrist's offsets from its rest position, metres.
"""

CAMERA_POSITION = (0.39, -0.40, 0.60)  # m: outside, beside the robot
CAMERA_TARGET = (0.86, 0.02, 0.44)  # m: what is in the middle of its image


def mesh_of(boxes: Sequence[BoxRig]) -> trimesh.Trimesh:
    """Return boxes as one mesh, metres."""
    joined: Any = trimesh.util.concatenate([box_mesh(box) for box in boxes])
    return joined


def world_from_camera() -> FloatArray:
    """Return pose (4, 4) of the depth camera's optical frame; its image is level."""
    position = np.array(CAMERA_POSITION)
    forward = np.array(CAMERA_TARGET) - position
    forward /= np.sqrt(forward @ forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.sqrt(right @ right)
    return compose(np.stack([right, np.cross(forward, right), forward], axis=1), position)


def stood_on_shelf(mesh: trimesh.Trimesh, configuration: Configuration) -> FloatArray:
    """Return the pose world_from_object (4, 4) in which a mesh in metres stands in the cabinet.

    Raise SessionError if it reaches out of the workspace.
    """
    world_from_object = laid_down(mesh, configuration)
    world_from_object[2, 3] += SHELF
    placed = apply(world_from_object, np.asarray(mesh.vertices))
    lower, upper = np.add(configuration.workspace.bounds, [[-1e-6], [1e-6]])
    if not ((placed >= lower) & (placed <= upper)).all():
        size = " x ".join(f"{side:.3g}" for side in np.ptp(placed, axis=0))
        room = " x ".join(f"{side:.3g}" for side in upper - lower)
        raise SessionError(
            f"the object takes {size} m where {configuration.name} puts it, more than the cabinet "
            f"has; accepted: an object of real size (object.scale=1) that fits in {room} m"
        )
    return world_from_object


PADS = {"left": 1.0, "right": -1.0}  # on which side of the hand
CAP = (0.042, 0.031, 0.022)  # m: semi-axes of a membrane, half an ellipsoid; x, y, z of its camera
CAP_BASE = 0.055  # m: how far before the camera its rigid base is
TILT = pi * 8.0 / 180.0  # rad: how far each pad is turned outward
PAD_SIDE = 0.037  # m: from the middle of the hand to that of a pad's rigid base
PAD_FRONT = 0.150  # m: how far before the wrist it is
_HOUSING = (0.086, 0.064, 0.080)  # m: the box behind the membrane


def world_from_wrist(position: FloatArray) -> FloatArray:
    """Return pose (4, 4) of the wrist at position (3,); its orientation never changes."""
    return compose(ROTATION, position)


def wrist_from_bubble_camera(pad: str) -> FloatArray:
    """Return the pose (4, 4) of the camera that sees a pad's membrane from inside."""
    rotation, base = _pad(PADS[pad])
    return compose(rotation, base - CAP_BASE * rotation[:, 2])


def rigid_parts() -> tuple[BoxRig, ...]:
    """Return the solid parts of the hand, in its frame: arm, palm, pads without membranes."""
    behind = _HOUSING[2] / 2.0
    y, z = PAD_SIDE - behind * sin(TILT), PAD_FRONT - behind * cos(TILT)
    return (
        BoxRig(size=(0.08, 0.08, 0.30), position=(0.0, 0.0, -0.22)),
        BoxRig(size=(0.09, 0.09, 0.10), position=(0.0, 0.0, -0.03)),
        BoxRig(size=(0.086, 0.15, 0.05), position=(0.0, 0.0, 0.045)),
        *(BoxRig(_HOUSING, (0.0, s * y, z), rotation=(-s * TILT, 0.0, 0.0)) for s in PADS.values()),
    )


def whole_mesh() -> trimesh.Trimesh:
    """Return the hand with its membranes untouched, in the wrist's frame, metres."""
    meshes = [mesh_of(rigid_parts())]
    for side in PADS.values():
        cap = trimesh.creation.icosphere(subdivisions=3).apply_scale(CAP)
        rotation, base = _pad(side)
        meshes.append(cap.apply_transform(compose(rotation, base)))
    joined: Any = trimesh.util.concatenate(meshes)
    return joined


def _pad(side: float) -> tuple[FloatArray, FloatArray]:
    """Return the rotation (3, 3) of a pad, z outward, and the middle (3,) of its base, hand."""
    rotation = axis_angle(np.array([1.0, 0.0, 0.0]), -side * TILT)
    return rotation, np.array([0.0, side * PAD_SIDE, PAD_FRONT])
