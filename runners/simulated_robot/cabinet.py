"""The cabinet, the room around it, and where the depth camera looks in from."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import compose
from runners.sensors.rig import BoxRig

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
