"""Where the eye of a 3-D view is, and what it looks at."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import rerun.blueprint as rrb

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import apply, inverse
from chsel.problem.registration_problem import Hypotheses
from replay.events import SessionStarted
from replay.rerun.hypotheses import shown_hypotheses

Bounds = tuple[FloatArray, FloatArray]
"""Lower and upper corner (3,) of a box in the world, metres."""
_DIRECTION = np.array([-0.55, -0.72, 0.42])  # from the box; probes move along +x
_DISTANCE = 1.08  # in diagonals of the box
_LOOK_DOWN = 0.07  # in heights of the box, whose near corner would be cut off
_OUT_OF_SIGHT = 0.05  # of the hypotheses' corners, at either end of each axis


def bounds_in_sight(started: SessionStarted, sets: Iterable[Hypotheses]) -> Bounds | None:
    """What most hypotheses take up of the workspace, with the object if its pose is known.

    None if there are no hypotheses.
    """
    shown = [found.object_from_world[shown_hypotheses(found)] for found in sets]
    poses = inverse(np.concatenate([np.zeros((0, 4, 4)), *shown]))
    if len(poses) == 0:
        return None
    if started.world_from_object is not None:
        poses = np.concatenate([poses, started.world_from_object[None]])
    import trimesh

    corners = trimesh.bounds.corners(started.mesh.bounds)
    places = np.concatenate([apply(pose, corners) for pose in poses])
    ends = np.quantile(places, [_OUT_OF_SIGHT, 1.0 - _OUT_OF_SIGHT], axis=0)
    lower, upper = np.clip(ends, *started.workspace.bounds)
    return lower, upper


def eye_on(in_sight: Bounds) -> rrb.EyeControls3D:
    """An eye that has a box in sight, obliquely from where the probes come from."""
    lower, upper = in_sight
    centre = (lower + upper) / 2
    away = _DIRECTION / np.linalg.norm(_DIRECTION) * np.linalg.norm(upper - lower)
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=centre + _DISTANCE * away,
        look_target=centre - (0.0, 0.0, _LOOK_DOWN * (upper[2] - lower[2])),
        eye_up=(0.0, 0.0, 1.0),
    )
