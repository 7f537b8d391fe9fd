"""The other form of the free term: points inside the object that must not lie in free voxels."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np

from chsel.cost.cost_settings import CostSettings
from chsel.errors import SettingError
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.problem.sdf_grid import SdfGrid

FEW_INTERIOR_POINTS = 25  # fewer are worth a warning
_MAX_NODES = 10_000_000  # of the lattice over the SDF grid


@dataclass(frozen=True)
class InteriorPoints:
    """Points inside an object, on a lattice."""

    points: FloatArray  # (M, 3), object frame
    depth: FloatArray  # (M,) > 0, metres
    normals: FloatArray  # (M, 3), gradients of the SDF
    spacing: float  # of the lattice, metres

    def in_order(self, order: IntArray) -> InteriorPoints:
        """The points in an order (M,) of their indices."""
        points, depth, normals = self.points[order], self.depth[order], self.normals[order]
        return InteriorPoints(points, depth, normals, self.spacing)

    def weights(self, settings: CostSettings, free_resolution: float) -> FloatArray:
        """What each point (M,) costs in a free voxel."""
        scale = settings.free_scale
        if settings.volume_normalise:
            scale *= (self.spacing / free_resolution) ** 3
        return scale * self.depth


def interior_points(sdf: SdfGrid, settings: CostSettings) -> InteriorPoints:
    """The nodes of a lattice over the grid that are deeper than alpha."""
    alpha = settings.alpha
    spacing = settings.interior_spacing or max(-alpha, sdf.resolution / 4)
    lower, upper = sdf.bounds
    counts = np.floor((upper - lower) / spacing).astype(int) + 1
    if not math.prod(counts.tolist()) <= _MAX_NODES:
        raise SettingError(
            f"interior_spacing {spacing} m makes {math.prod(counts.tolist()):.1e} nodes; "
            f"accepted: at most {_MAX_NODES:.0e}, so a coarser interior_spacing"
        )
    nodes = lower + np.indices(counts).reshape(3, -1).T * spacing
    s, n = sdf.at(nodes, lookup=settings.lookup, outside=settings.outside)
    inside = s < alpha
    if not bool(inside.any()):
        raise SettingError(
            f"free_term interior finds no point deeper than {-alpha} m; accepted: "
            "a penetration_tolerance nearer to 0, or free_term direct"
        )
    if int(inside.sum()) < FEW_INTERIOR_POINTS:
        warnings.warn(
            f"free_term interior uses {int(inside.sum())} points; a finer interior_spacing "
            f"than {spacing} m describes the object better",
            stacklevel=3,
        )
    return InteriorPoints(nodes[inside], -s[inside], n[inside], spacing)
