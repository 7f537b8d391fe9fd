"""The cabinet: what it is made of, how objects stand in it, and where they are probed."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np
import trimesh

from chsel.errors import SessionError
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import Workspace
from chsel.problem.poses import apply, compose
from runners.sensors.rig import BoxRig
from runners.sessions.configurations import Configuration
from runners.sessions.placement import laid_down

Bounds = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]

# The inside is the workspace and 2 cm to its sides; the shelf is the workspace's lower face. The
# side wall towards the camera and the front lip hide a part of the inside from it.
CABINET: dict[str, Bounds] = {
    "shelf": ((0.66, 1.14), (-0.24, 0.24), (0.29, 0.31)),
    "ceiling": ((0.66, 1.14), (-0.24, 0.24), (0.62, 0.64)),
    "back": ((1.12, 1.14), (-0.24, 0.24), (0.31, 0.62)),
    "left_wall": ((0.66, 1.14), (0.22, 0.24), (0.31, 0.62)),
    "right_wall": ((0.66, 1.14), (-0.24, -0.22), (0.31, 0.62)),
    "front_lip": ((0.64, 0.66), (-0.24, 0.24), (0.27, 0.335)),
}
ROOM: dict[str, Bounds] = {
    "floor": ((-1.0, 2.2), (-1.5, 1.6), (-0.05, 0.0)),
    "far_wall": ((2.1, 2.2), (-1.5, 1.6), (0.0, 2.5)),
    "other_wall": ((-1.0, 2.1), (1.5, 1.6), (0.0, 2.5)),
}

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
        name, name.split("_")[1], y, z, (*place, SHELF), (0.0, 0.0, yaw), CABINET_WORKSPACE
    )
    for name, y, z, place, yaw in _ALL
}
"""How an object stands on the shelf, and the grid of its probes (methods, Sec. 10.1).

y, z: the wrist's offsets from its rest position, metres.
"""

CAMERA_POSITION = (0.39, -0.40, 0.60)  # m: outside, beside the robot
CAMERA_TARGET = (0.86, 0.02, 0.44)  # m: what is in the middle of its image


def boxes(*groups: dict[str, Bounds]) -> trimesh.Trimesh:
    """The boxes of groups such as CABINET as one mesh, in the world."""
    parts = []
    for bounds in (bounds for group in groups for bounds in group.values()):
        lower, upper = np.array(bounds).T
        part = trimesh.creation.box(upper - lower)
        parts.append(part.apply_translation((lower + upper) / 2.0))
    joined: Any = trimesh.util.concatenate(parts)
    return joined


def solids() -> tuple[BoxRig, ...]:
    """The boxes of CABINET, each by its size and centre, in the world."""
    parts = []
    for bounds in CABINET.values():
        size = [upper - lower for lower, upper in bounds]
        centre = [(upper + lower) / 2.0 for lower, upper in bounds]
        parts.append(
            BoxRig(size=(size[0], size[1], size[2]), position=(centre[0], centre[1], centre[2]))
        )
    return tuple(parts)


def world_from_camera() -> FloatArray:
    """Pose (4, 4) of the depth camera's optical frame; its image is level."""
    position = np.array(CAMERA_POSITION)
    forward = np.array(CAMERA_TARGET) - position
    forward /= np.sqrt(forward @ forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.sqrt(right @ right)
    return compose(np.stack([right, np.cross(forward, right), forward], axis=1), position)


def stood_on_shelf(mesh: trimesh.Trimesh, configuration: Configuration) -> FloatArray:
    """The pose world_from_object (4, 4) in which a mesh in metres stands in the cabinet.

    Raises SessionError if it reaches out of the workspace.
    """
    world_from_object = laid_down(mesh, configuration)
    world_from_object[2, 3] += SHELF
    placed = apply(world_from_object, np.asarray(mesh.vertices))
    box, slack = configuration.workspace, 1e-6
    if (placed.min(axis=0) < np.array(box.lower) - slack).any() or (
        placed.max(axis=0) > np.array(box.upper) + slack
    ).any():
        size = " x ".join(f"{side:.3g}" for side in np.ptp(placed, axis=0))
        room = " x ".join(f"{side:.3g}" for side in np.subtract(box.upper, box.lower))
        raise SessionError(
            f"the object takes {size} m where {configuration.name} puts it, more than the cabinet "
            f"has; accepted: an object of real size (object.scale=1) that fits in {room} m"
        )
    return world_from_object
