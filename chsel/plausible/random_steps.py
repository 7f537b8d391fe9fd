"""Poses moved by small steps, many at a time."""

from __future__ import annotations

from functools import partial

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import compiled
from chsel.numerics.elementary import sine_cosine
from chsel.numerics.pose_tuples import turned
from chsel.numerics.threads import spread
from chsel.problem.poses import Poses

_POSES_PER_THREAD = 1000


def stepped(
    world_from_object: FloatArray, steps: FloatArray, position: float, angle: float
) -> tuple[FloatArray, Poses]:
    """Poses (N, 4, 4) after steps (N, 6) of so many metres and, turned about, radians.

    The latter three numbers of a step are a rotation vector, about the axes of the world. Returns
    the poses (N, 4, 4), world_from_object, and the same as object_from_world.
    """
    moved, numbers = np.empty((len(steps), 4, 4)), np.empty((len(steps), 12))
    run = partial(_step, world_from_object, steps, position, angle, moved, numbers)
    spread(run, len(steps), lambda: None, least=_POSES_PER_THREAD)
    return moved, Poses(numbers)


@compiled
def _step(
    poses: FloatArray,
    steps: FloatArray,
    position: float,
    angle: float,
    moved: FloatArray,
    numbers: FloatArray,
    first: int,
    last: int,
    _: None,
) -> None:
    """Fill moved (N, 4, 4) and its inverse numbers (N, 12), from `first` to before `last`."""
    for n in range(first, last):
        u, v, w = angle * steps[n, 3], angle * steps[n, 4], angle * steps[n, 5]
        length = np.sqrt(u * u + v * v + w * w)
        if length > 0.0:
            u, v, w = u / length, v / length, w / length
        else:
            u, v, w = 1.0, 0.0, 0.0
        sine, cosine = sine_cosine(length)
        back = 1.0 - cosine
        turn = (
            cosine + back * (u * u),
            sine * -w + back * (u * v),
            sine * v + back * (u * w),
            sine * w + back * (v * u),
            cosine + back * (v * v),
            sine * -u + back * (v * w),
            sine * -v + back * (w * u),
            sine * u + back * (w * v),
            cosine + back * (w * w),
        )
        for j in range(3):
            x, y, z = turned(turn, poses[n, 0, j], poses[n, 1, j], poses[n, 2, j])
            moved[n, 0, j], moved[n, 1, j], moved[n, 2, j] = x, y, z
            numbers[n, 3 * j], numbers[n, 3 * j + 1], numbers[n, 3 * j + 2] = x, y, z
            moved[n, j, 3] = poses[n, j, 3] + position * steps[n, j]
            moved[n, 3, j] = 0.0
        moved[n, 3, 3] = 1.0
        x, y, z = moved[n, 0, 3], moved[n, 1, 3], moved[n, 2, 3]
        for j in range(3):
            along = numbers[n, 3 * j] * x + numbers[n, 3 * j + 1] * y + numbers[n, 3 * j + 2] * z
            numbers[n, 9 + j] = -along
