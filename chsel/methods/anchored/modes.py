"""Whether a search found poses that are unlike those it had."""

from __future__ import annotations

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import Poses
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.subset import farthest_points, surface_descriptors

_FAR = 0.01  # metres between outlines of different modes, at least


def has_new_mode(sdf: SdfGrid, old: Poses, new: Poses, wanted: int) -> bool:
    """Whether any of new poses is far from all old ones.

    Far is farther apart than as many old ones as are wanted, spread as far as can be.
    """
    if len(old) == 0:
        return True
    outlines = surface_descriptors(sdf, Poses.joined([old, new]))
    outlines, new_outlines = outlines[: len(old)], outlines[len(old) :]
    chosen = farthest_points(outlines, wanted)
    spacing = _apart(outlines[chosen[:-1]], outlines[chosen[-1:]]) if len(chosen) > 1 else 0.0
    return _apart(outlines, new_outlines) > max(spacing, _FAR)


def _apart(outlines: FloatArray, others: FloatArray) -> float:
    """The largest distance (m) of other outlines (M, D) from the nearest of outlines (N, D)."""
    nearest = [((outlines - other) ** 2).mean(axis=1).min() for other in others]
    return float(np.sqrt(max(nearest)))
