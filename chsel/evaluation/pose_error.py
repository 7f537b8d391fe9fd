"""How far hypotheses are from a known true pose."""

from __future__ import annotations

import numpy as np

from chsel.arrays import FloatArray
from chsel.pose import inverse, rotation_angle


def pose_errors(
    object_from_world: FloatArray, world_from_object: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Position errors (B,) in metres and rotation errors (B,) in radians.

    Of hypotheses object_from_world (B, 4, 4) to the true world_from_object (4, 4): distance
    between the object's origins, and angle of the rotation between the two.
    """
    estimated = inverse(object_from_world)
    offset = estimated[:, :3, 3] - world_from_object[:3, 3]
    relative = np.einsum("bij,jk->bik", object_from_world[:, :3, :3], world_from_object[:3, :3])
    return np.sqrt((offset**2).sum(axis=1)), rotation_angle(relative)
