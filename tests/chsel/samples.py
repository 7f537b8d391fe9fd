"""Grids, poses and results that tests share."""

from __future__ import annotations

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import compose, random_rotations
from chsel.problem.registration_problem import Hypotheses
from chsel.problem.sdf_grid import SdfGrid


def ball_grid(radius: float, resolution: float, half: int) -> SdfGrid:
    """The exact distance to a ball around the origin, `half` nodes to every side of it."""
    nodes = np.moveaxis(np.indices((2 * half + 1,) * 3), 0, -1) * resolution - half * resolution
    distance = np.sqrt((nodes**2).sum(axis=-1))
    safe = np.where(distance > 0.0, distance, 1.0)[..., None]
    gradient = np.where(distance[..., None] > 0.0, nodes / safe, [1.0, 0.0, 0.0])
    return SdfGrid(np.full(3, -half * resolution), resolution, distance - radius, gradient)


def box_distance(points: FloatArray, sides: FloatArray) -> FloatArray:
    """Signed distances (...) of points (..., 3) to a box around the origin."""
    beyond = np.abs(points) - 0.5 * sides
    outside = np.sqrt((np.maximum(beyond, 0.0) ** 2).sum(axis=-1))
    distance: FloatArray = outside + np.minimum(beyond.max(axis=-1), 0.0)
    return distance


def random_poses(stream: np.random.Generator, count: int, reach: float) -> FloatArray:
    """Transforms (count, 4, 4) of any rotation, translated by at most `reach` along each axis."""
    rotations = random_rotations(stream, count)
    return compose(rotations, stream.uniform(-reach, reach, (count, 3)))


def hypotheses_at(object_from_world: FloatArray, duplicate: list[bool] | None = None) -> Hypotheses:
    """A result of poses (B, 4, 4) at the costs 0, 1, 2, ..., from no archive."""
    count = len(object_from_world)
    return Hypotheses(
        object_from_world=object_from_world,
        cost=np.arange(float(count)),
        duplicate=np.zeros(count, bool) if duplicate is None else np.array(duplicate, bool),
        cell=np.full(count, -1),
        elites=object_from_world,
    )
