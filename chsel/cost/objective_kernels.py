"""The relaxed cost as a function of search vectors, its gradient, and its descent by Adam."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.cost.cost_kernels import MOST_SLACK, Model, Neighbours, evaluate, forget, neighbours_of
from chsel.numerics.compiler import compiled, leaf, spliced
from chsel.numerics.pose_tuples import decode, pose_at, pull_back

BETA1, BETA2 = 0.9, 0.999
EPSILON = 1e-8


@leaf
def adam_step(slope, moments, j, powers, rate, epsilon):
    """How far to go down a slope along coordinate j; updates its moments (2, d).

    powers: beta_1 and beta_2 to the power of the steps taken, this one included.
    """
    moments[0, j] = BETA1 * moments[0, j] + (1.0 - BETA1) * slope
    moments[1, j] = BETA2 * moments[1, j] + (1.0 - BETA2) * slope * slope
    step = rate * (moments[0, j] / (1.0 - powers[0]))
    return step / (np.sqrt(moments[1, j] / (1.0 - powers[1])) + epsilon)


class Work(NamedTuple):
    """Scratch of one thread."""

    near: Neighbours


def work_for(model: Model) -> Work:
    """Scratch for one thread."""
    return Work(neighbours_of(model))


@spliced
def cost_of(model, space, vector, work):
    """The cost of a search vector (d,)."""
    return evaluate(model, decode(space, vector), work.near, 0.0)[0]


@spliced
def cost_and_gradient_of(model, space, vector, gradient, work):
    """The cost of a search vector (d,); fills its gradient (d,)."""
    sums = evaluate(model, decode(space, vector), work.near, 0.0)
    pull_back(space, vector, sums[4:13] + sums[1:4], gradient)
    return sums[0]


@compiled
def costs_of_poses(model, poses, out, first, last, work):
    """Fill out (B,) with the costs of poses (B, 12), from `first` to before `last`."""
    for n in range(first, last):
        out[n] = evaluate(model, pose_at(poses, n), work.near, 0.0)[0]


@compiled
def costs_and_gradients(model, space, vectors, out, gradients, first, last, work):
    """Fill out (B,) and gradients (B, d) at search vectors (B, d), from `first` to `last`."""
    for n in range(first, last):
        out[n] = cost_and_gradient_of(model, space, vectors[n], gradients[n], work)


@compiled
def descend(model, space, vectors, rate, divisor, iterations, first, last, work):
    """Move search vectors (B, d), from `first` to before `last`, by Adam.

    divisor: what gradients are divided by.
    """
    dimension = vectors.shape[1]
    near = work.near
    gradient, moments = np.empty(dimension), np.empty((2, dimension))
    for n in range(first, last):
        vector = vectors[n]
        moments[:] = 0.0
        power1 = power2 = 1.0
        forget(near)
        for _ in range(iterations):
            sums = evaluate(model, decode(space, vector), near, MOST_SLACK)
            pull_back(space, vector, sums[4:13] + sums[1:4], gradient)
            power1 *= BETA1
            power2 *= BETA2
            for j in range(dimension):
                slope = gradient[j] / divisor
                vector[j] -= adam_step(slope, moments, j, (power1, power2), rate, EPSILON)
