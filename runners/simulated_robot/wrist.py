"""The hand: a wrist with two soft-bubble pads that point forward, side by side.

Its frame `wrist` has z forward, along world +x; x points down and y to the left.
"""

from __future__ import annotations

from math import cos, pi, sin
from typing import Any

import numpy as np
import trimesh

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import axis_angle, compose
from runners.sensors.rig import BoxRig

ROTATION = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])

PADS = ("left", "right")
CAP = (0.042, 0.031, 0.022)  # m: semi-axes of a membrane, half an ellipsoid; x, y, z of its camera
CAP_BASE = 0.055  # m: how far before the camera its rigid base is
TILT = pi * 8.0 / 180.0  # rad: how far each pad is turned outward
PAD_SIDE = 0.037  # m: from the middle of the hand to that of a pad's rigid base
PAD_FRONT = 0.150  # m: how far before the wrist it is
_HOUSING = (0.086, 0.064, 0.080)  # m: the box behind the membrane


def world_from_wrist(position: FloatArray) -> FloatArray:
    """Pose (4, 4) of the wrist at position (3,); its orientation never changes."""
    return compose(ROTATION, position)


def wrist_from_bubble_camera(pad: str) -> FloatArray:
    """Pose (4, 4) of the camera that looks at a pad's membrane from inside, optical frame."""
    rotation, base = _pad(pad)
    return compose(rotation, base - CAP_BASE * rotation[:, 2])


def rigid_parts() -> tuple[BoxRig, ...]:
    """The solid parts of the hand, in its frame: arm, palm, and the pads without membranes."""
    return (
        BoxRig(size=(0.08, 0.08, 0.30), position=(0.0, 0.0, -0.22)),
        BoxRig(size=(0.09, 0.09, 0.10), position=(0.0, 0.0, -0.03)),
        BoxRig(size=(0.086, 0.15, 0.05), position=(0.0, 0.0, 0.045)),
        *(_housing(pad) for pad in PADS),
    )


def rigid_mesh() -> trimesh.Trimesh:
    """The solid parts as one mesh, in the wrist's frame, metres."""
    joined: Any = trimesh.util.concatenate([_box(part) for part in rigid_parts()])
    return joined


def whole_mesh() -> trimesh.Trimesh:
    """The hand with its membranes untouched, in the wrist's frame, metres."""
    caps = []
    for pad in PADS:
        rotation, base = _pad(pad)
        cap = trimesh.creation.icosphere(subdivisions=3).apply_scale(CAP)
        caps.append(cap.apply_transform(compose(rotation, base)))
    joined: Any = trimesh.util.concatenate([rigid_mesh(), *caps])
    return joined


def _pad(pad: str) -> tuple[FloatArray, FloatArray]:
    """Rotation (3, 3) of a pad, z outward, and the middle (3,) of its base, in the hand."""
    side = 1.0 if pad == "left" else -1.0
    rotation = axis_angle(np.array([1.0, 0.0, 0.0]), -side * TILT)
    return rotation, np.array([0.0, side * PAD_SIDE, PAD_FRONT])


def _housing(pad: str) -> BoxRig:
    side, half = (1.0 if pad == "left" else -1.0), _HOUSING[2] / 2.0
    y, z = side * (PAD_SIDE - half * sin(TILT)), PAD_FRONT - half * cos(TILT)
    return BoxRig(size=_HOUSING, position=(0.0, y, z), rotation=(-side * TILT, 0.0, 0.0))


def _box(part: BoxRig) -> trimesh.Trimesh:
    roll = axis_angle(np.array([1.0, 0.0, 0.0]), part.rotation[0])  # no part has more than that
    return trimesh.creation.box(part.size).apply_transform(compose(roll, np.array(part.position)))
