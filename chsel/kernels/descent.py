"""Adam on many starts, each from its first to its last step in one go."""

from __future__ import annotations

import numpy as np

from chsel.kernels.adam import BETA1, BETA2, EPSILON, adam_step
from chsel.kernels.compiler import compiled
from chsel.kernels.cost import MOST_SLACK, evaluate, forget
from chsel.kernels.pose import decode, pull_back


@compiled
def descend(model, space, vectors, rate, divisor, iterations, first, last, work):  # type: ignore[no-untyped-def]
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
