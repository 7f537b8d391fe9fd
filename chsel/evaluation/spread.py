"""How far the hypotheses of a set are from each other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.arrays import FloatArray
from chsel.pose import apply, inverse, rotation_angle
from chsel.problem import Hypotheses


class Spread(NamedTuple):
    """position: metres. rotation: radians."""

    position: float
    rotation: float


def spread(hypotheses: Hypotheses, centre: FloatArray) -> Spread | None:
    """Spread of the hypotheses that repeat no other; None if there is none.

    position: the root mean square distance of the object's centres from their mean; `centre` (3,)
    is in the object's frame, metres. rotation: the mean angle between the orientation of the best
    hypothesis, the first, and those of the others, symmetries of the object not considered; 0
    without others.
    """
    object_from_world = hypotheses.object_from_world[~hypotheses.duplicate]  # (B, 4, 4)
    if len(object_from_world) == 0:
        return None
    centres = np.stack([apply(pose, centre[None])[0] for pose in inverse(object_from_world)])
    distances = np.linalg.norm(centres - centres.mean(axis=0), axis=1)
    rotations = object_from_world[:, :3, :3]
    angles = rotation_angle(rotations[1:] @ rotations[0].T)
    rotation = float(angles.mean()) if len(angles) else 0.0
    return Spread(float(np.sqrt(np.mean(distances**2))), rotation)
