"""E_0 of the next pass when a registration is repeated: a Gaussian around the best members."""

from __future__ import annotations

import numpy as np

from chsel.arrays import FloatArray
from chsel.space import SearchSpace, transforms_of
from chsel.streams import normals

_BEST = 0.2


def resampled_around_best(
    estimates: FloatArray, costs: FloatArray, space: SearchSpace, stream: np.random.Generator
) -> FloatArray:
    """Transforms (B, 4, 4) drawn around the best fifth of estimates (B, 4, 4) with costs (B,).

    Mean and deviation (ddof 1) of each coordinate of the search vectors; the best fifth itself
    comes first, unchanged.
    """
    count = len(estimates)
    best = np.argsort(costs, kind="stable")[: max(1, int(_BEST * count))]
    vectors = space.encode(estimates[best])
    deviation = vectors.std(axis=0, ddof=1) if len(best) > 1 else np.zeros(space.dimension)
    drawn = vectors.mean(axis=0) + deviation * normals(stream, (count, space.dimension))
    drawn[: len(best)] = vectors
    return transforms_of(space, drawn)
