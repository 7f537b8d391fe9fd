"""The gripper: a Franka hand with closed fingers, as two convex solids of the same outer size."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from chsel.numerics.arrays import FloatArray
from runners.sessions.probing_hand import ROTATION, ProbingHand

if TYPE_CHECKING:
    import trimesh

# Rings (z, half width along x, half width along y) in metres, in the hand frame. The real hand is
# flat where these solids bulge by a few millimetres, so that they meet a flat object at one point.
_PALM = (
    (-0.0260, 0.0060, 0.0600),
    (-0.0150, 0.0170, 0.0900),
    (0.0050, 0.0316, 0.1020),
    (0.0450, 0.0232, 0.1010),
    (0.0490, 0.0218, 0.0988),
    (0.0525, 0.0202, 0.0954),
    (0.0555, 0.0184, 0.0904),
    (0.0580, 0.0165, 0.0836),
    (0.0605, 0.0140, 0.0730),
    (0.0630, 0.0106, 0.0560),
    (0.0650, 0.0062, 0.0320),
    (0.0658, 0.0030, 0.0150),
    (0.0660, 0.0, 0.0),
)
_FINGERS = (
    (0.0584, 0.0105, 0.0263),
    (0.0770, 0.0103, 0.0253),
    (0.0970, 0.0093, 0.0185),
    (0.1020, 0.0086, 0.0155),
    (0.1060, 0.0075, 0.0123),
    (0.1090, 0.0059, 0.0091),
    (0.1110, 0.0039, 0.0058),
    (0.1120, 0.0019, 0.0027),
    (0.1123, 0.0, 0.0),
)
_CORNERS = 36  # of a ring
_ROUNDNESS = 2.5  # exponent of a ring's superellipse: 2 is an ellipse, infinity is a rectangle


@cache
def panda_hand() -> ProbingHand:
    """Palm and closed fingers."""
    return ProbingHand([_solid(rings) for rings in (_PALM, _FINGERS)])


def _solid(rings: tuple[tuple[float, float, float], ...]) -> trimesh.Trimesh:
    import trimesh

    vertices = np.concatenate([_ring(*ring) for ring in rings]) @ ROTATION.T
    return trimesh.convex.convex_hull(vertices)


def _ring(z: float, half_x: float, half_y: float) -> FloatArray:
    """Corners of one cross-section (C, 3) in the hand frame; a single point where it is closed."""
    if half_x == 0.0:
        return np.array([[0.0, 0.0, z]])
    angle = 2.0 * np.pi * np.arange(_CORNERS) / _CORNERS
    x, y = (np.sign(w) * np.abs(w) ** (2.0 / _ROUNDNESS) for w in (np.cos(angle), np.sin(angle)))
    return np.stack([half_x * x, half_y * y, np.full(_CORNERS, z)], axis=1)
