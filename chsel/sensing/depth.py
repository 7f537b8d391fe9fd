"""Which pixels of a depth image can be believed."""

from __future__ import annotations

import numpy as np

from chsel.arrays import BoolArray, FloatArray
from chsel.kernels.windows import window_minimum


def valid_pixels(depth: FloatArray, *, nearest: float, furthest: float) -> BoolArray:
    """Whether pixels (H, W) have a depth from nearest to furthest, metres.

    A camera tells that it could not measure by 0, nan, infinity or a negative number.
    """
    depth = np.asarray(depth)
    return np.isfinite(depth) & (depth > 0.0) & (depth >= nearest) & (depth <= furthest)


def occlusion_edges(
    depth: FloatArray, valid: BoolArray, jump: float, *, reach: int = 1
) -> BoolArray:
    """Pixels (H, W) that a jump of more than `jump` metres parts from one of their neighbours.

    On both sides of the jump, as either may have been measured across it. depth (H, W): metres.
    valid (H, W): pixels that count, and that can be edges. reach: how many pixels away, along rows
    and columns, a neighbour may be; 2 also finds jumps where one pixel between them is invalid.
    """
    own = np.where(valid, depth, 0.0)
    nearest = _least_around(np.where(valid, depth, np.inf), reach)
    furthest = -_least_around(np.where(valid, -own, np.inf), reach)
    return valid & ((furthest - own > jump) | (own - nearest > jump))


def _least_around(image: FloatArray, reach: int) -> FloatArray:
    """The least (H, W) of the pixels up to `reach` away from each, along rows and columns."""
    height, width = image.shape
    padded = np.full((height + 2 * reach, width + 2 * reach), np.inf)
    padded[reach : reach + height, reach : reach + width] = image
    window_minimum(padded, 2 * reach + 1)
    return padded[:height, :width]
