"""Which pixels of a depth image can be believed."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from chsel.arrays import BoolArray, FloatArray


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
    size = 2 * reach + 1
    nearest = minimum_filter(np.where(valid, depth, np.inf), size, mode="nearest")
    furthest = maximum_filter(np.where(valid, depth, -np.inf), size, mode="nearest")
    own = np.where(valid, depth, 0.0)
    return valid & ((furthest - own > jump) | (own - nearest > jump))
