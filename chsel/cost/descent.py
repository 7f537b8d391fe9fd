"""Descents by Adam (Kingma and Ba, 2015) of search vectors, LANES poses at a time."""

from __future__ import annotations

import numpy as np

from chsel.cost.cost_kernels import evaluate, forget, gradient_of, put_pose
from chsel.cost.free_kernels import MOST_SLACK
from chsel.cost.pose_lanes import LANES, SUMS
from chsel.numerics.compiler import compiled, leaf
from chsel.numerics.pose_tuples import decode, pull_back

BETA1, BETA2 = 0.9, 0.999
EPSILON = 1e-8


@leaf
def adam_step(slope, moments, j, powers, rate, epsilon):
    """The step down a slope along coordinate j; updates moments (2, d).

    powers: beta_1 and beta_2 to the power of the number of steps, this one included.
    """
    moments[0, j] = BETA1 * moments[0, j] + (1.0 - BETA1) * slope
    moments[1, j] = BETA2 * moments[1, j] + (1.0 - BETA2) * slope * slope
    step = rate * (moments[0, j] / (1.0 - powers[0]))
    return step / (np.sqrt(moments[1, j] / (1.0 - powers[1])) + epsilon)


@compiled
def descend(
    model, space, vectors, costs, iterations, rate, divisor, ends_on_poses, first, last, work
):
    """Move search vectors (S, d) from `first` to before `last` by some iterations of Adam.

    divisor: of gradients. ends_on_poses: makes rotations orthonormal again, and fills costs (S,).
    """
    dimension = vectors.shape[1]
    moments, gradient = np.empty((LANES, 2, dimension)), np.empty(dimension)
    for start in range(first, last, LANES):
        count = min(LANES, last - start)
        moments[:] = 0.0
        powers = 1.0, 1.0
        forget(work)
        for _ in range(iterations):
            for lane in range(count):
                put_pose(work.lanes, lane, decode(space, vectors[start + lane]))
            evaluate(model, work, 0, count, MOST_SLACK)
            powers = powers[0] * BETA1, powers[1] * BETA2
            for lane in range(count):
                vector = vectors[start + lane]
                pull_back(space, vector, gradient_of(work.lanes, lane), gradient)
                for j in range(dimension):
                    slope = gradient[j] / divisor
                    vector[j] -= adam_step(slope, moments[lane], j, powers, rate, EPSILON)
        if ends_on_poses:
            for lane in range(count):
                pose = decode(space, vectors[start + lane])
                for j in range(6):
                    vectors[start + lane, j] = pose[j]
                put_pose(work.lanes, lane, decode(space, vectors[start + lane]))
            evaluate(model, work, 0, count, 0.0)
            for lane in range(count):
                costs[start + lane] = work.lanes[SUMS + lane]
