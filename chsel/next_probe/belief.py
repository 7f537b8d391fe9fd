"""What a registration leaves plausible, as poses with weights; and before any registration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from chsel.next_probe.decision_problem import Belief
from chsel.numerics.arrays import FloatArray
from chsel.problem.outline import outline_in_world, signed_distances
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import Poses, compose, inverse, random_rotations, rotated
from chsel.problem.registration_problem import Hypotheses
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.settings import CheckedSettings, at_most, positive
from chsel.problem.streams import Purpose, StreamKey, uniforms
from chsel.problem.subset import evenly_spaced
from chsel.problem.surface import object_centre

MOST_POSES = 2000
_DRAWN = 1000  # poses before any registration, of which those that free space allows are kept
_SOME_FREE = 2000  # free points that rule most of these out, before all are compared


@dataclass(frozen=True)
class BeliefSettings(CheckedSettings):
    """Which poses a decision weighs up."""

    poses: Annotated[int, positive, at_most(MOST_POSES)] = 100  # K, at most
    # Height in the world of the floor that the object lies on, metres; None: it may be anywhere.
    floor: float | None = 0.0


def belief_after(hypotheses: Hypotheses, settings: BeliefSettings) -> Belief:
    """The candidates of a registration, or its hypotheses if it has none; all weigh the same."""
    poses = hypotheses.candidates
    if len(poses) == 0:
        poses = hypotheses.object_from_world[~hypotheses.duplicate]
    poses = poses[evenly_spaced(len(poses), settings.poses)]
    return Belief(poses, np.full(len(poses), 1.0 / len(poses)))


def belief_before(
    sdf: SdfGrid,
    points: KnownPoints,
    workspace: Workspace,
    key: StreamKey,
    settings: BeliefSettings,
) -> Belief:
    """Poses with the object's centre in the workspace, turned any way, that free points allow.

    The first of those drawn that free space does not enter by more than its grid's resolution; if
    they are too few, those that it enters least.
    """
    stream = key.stream(Purpose.PRIOR_BELIEF)
    rotation = random_rotations(stream, _DRAWN)  # world_from_object
    centre = uniforms(stream, workspace.lower, workspace.upper, (_DRAWN, 3))
    position = centre - rotated(rotation, object_centre(sdf))
    poses = Poses.of(inverse(compose(rotation, position)))
    if settings.floor is not None:
        position[:, 2] -= heights(sdf, poses, settings.floor)
        poses = Poses.of(inverse(compose(rotation, position)))
    free = points.free
    depth = _depths(sdf, poses, free[evenly_spaced(len(free), _SOME_FREE)])
    missing = settings.poses
    for n in np.flatnonzero(depth <= sdf.resolution):
        if missing == 0:
            break
        depth[n] = _depths(sdf, poses[n : n + 1], free)[0]
        missing -= depth[n] <= sdf.resolution
    order = np.argsort(depth, kind="stable")[: settings.poses]
    return Belief(poses.matrices[order], np.full(len(order), 1.0 / len(order)))


def _depths(sdf: SdfGrid, poses: Poses, free: FloatArray) -> FloatArray:
    """Depth (B,) of the deepest of free points (N, 3), metres, at least the resolution."""
    deepest: FloatArray = -signed_distances(sdf, poses, free).min(axis=1, initial=np.inf)
    return np.maximum(deepest, sdf.resolution)


def heights(sdf: SdfGrid, poses: Poses, floor: float) -> FloatArray:
    """How far the object's lowest point is above the floor (B,) in each pose, metres."""
    lowest: FloatArray = outline_in_world(sdf, poses)[..., 2].min(axis=1) - floor
    return lowest
