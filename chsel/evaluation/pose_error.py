"""How far hypotheses are from a known true pose."""

from __future__ import annotations

import numpy as np

from chsel.arrays import FloatArray
from chsel.evaluation.symmetry import ObjectSymmetry
from chsel.pose import inverse, product, rotated


def pose_errors(
    object_from_world: FloatArray, world_from_object: FloatArray, symmetry: ObjectSymmetry
) -> tuple[FloatArray, FloatArray]:
    """Position errors (B,) in metres and rotation errors (B,) in radians, modulo symmetries.

    Of hypotheses object_from_world (B, 4, 4) to the true world_from_object (4, 4): the distance
    between the places of the object's centre, and the smallest angle of a rotation between the two
    poses if a symmetry of the object is applied first.
    """
    estimated = inverse(object_from_world)
    centres = rotated(estimated[:, :3, :3], symmetry.centre) + estimated[:, :3, 3]
    centre = rotated(world_from_object[:3, :3], symmetry.centre) + world_from_object[:3, 3]
    relative = product(object_from_world[:, :3, :3], world_from_object[:3, :3])
    distance = np.sqrt(((centres - centre) ** 2).sum(axis=1))
    return distance, symmetry.rotation_errors(relative)
