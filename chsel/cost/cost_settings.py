"""Settings of the relaxed cost, and the interior points that its free term may sum over."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np

from chsel.errors import SettingError
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.problem.sdf_grid import LOOKUPS, OUTSIDE, SdfGrid
from chsel.problem.settings import CheckedSettings, Presets, not_negative, one_of, positive

FREE_TERMS = ("direct", "interior")
GRADIENTS = ("defined", "exact")
FEW_INTERIOR_POINTS = 25  # fewer are worth a warning
_MAX_NODES = 10_000_000  # of the lattice over the SDF grid


@dataclass(frozen=True)
class CostSettings(CheckedSettings):
    """Settings of the relaxed cost, with the paper's symbols."""

    # alpha, the level that free points may reach, metres; None: a quarter of a voxel of free space,
    # or half of the object's greatest depth where that is less.
    penetration_tolerance: float | None = None
    free_scale: Annotated[float, not_negative] = 20.0  # lambda
    occupied_scale: Annotated[float, not_negative] = 20.0  # lambda
    known_scale: Annotated[float, not_negative] = 1.0  # weight of known-SDF points
    # "direct" sums over free points as Eq. 8 does; "interior" over points inside the object that
    # lie in free voxels, as the authors' experiments did.
    free_term: Annotated[str, one_of(*FREE_TERMS)] = "direct"
    interior_spacing: Annotated[float | None, positive] = None  # metres; by default |alpha|
    volume_normalise: bool = False  # weigh interior points by their share of a free voxel
    known_tolerance: Annotated[float, not_negative] = 0.0  # dead band of known-SDF points, metres
    lookup: Annotated[str, one_of(*LOOKUPS)] = "trilinear"  # how the SDF is read, see SdfGrid.at
    outside: Annotated[str, one_of(*OUTSIDE)] = "surface_point"  # and beyond its box
    # "defined" is violation times normal (Eqs. 8 to 10), "exact" the derivative of the value.
    gradient: Annotated[str, one_of(*GRADIENTS)] = "defined"

    presets: ClassVar[Presets] = {
        "paper": {"penetration_tolerance": -0.01, "lookup": "nearest"},
        "reference": {
            "penetration_tolerance": -0.01,
            "free_term": "interior",
            "occupied_scale": 0.0,
            "lookup": "nearest",
            "outside": "bounding_box",
        },
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        alpha = self.penetration_tolerance
        if alpha is not None and not -10.0 < alpha <= 0.0:
            raise SettingError(
                f"penetration_tolerance is {alpha}; accepted: at most 0 (m), or null"
            )
        if self.free_term == "interior" and self.gradient == "exact":
            raise SettingError(
                "gradient is exact with free_term interior, whose value is piecewise constant; "
                "accepted: gradient defined, or free_term direct"
            )

    def of_object(self, sdf: SdfGrid, free_resolution: float) -> CostSettings:
        """Return the settings with alpha for an object, and free voxels of that side in metres."""
        if self.penetration_tolerance is not None:
            return self
        return replace(self, penetration_tolerance=-uncertain_depth(sdf, 0.25 * free_resolution))

    @property
    def alpha(self) -> float:
        """The level that free points may reach, metres; see of_object."""
        assert self.penetration_tolerance is not None
        return self.penetration_tolerance


def uncertain_depth(sdf: SdfGrid, depth: float) -> float:
    """Return a depth that free points may have, metres, at most half of the object's greatest.

    So free points still matter to a thin object.
    """
    return min(depth, 0.5 * max(-float(sdf.values.min()), 0.0))


def warn_if_too_deep(sdf: SdfGrid, free: FloatArray, *, alpha: float) -> None:
    """Warn if there are free points, and nothing of the object is as deep as they may be."""
    if len(free) and not (sdf.values < alpha).any():
        text = f"no node of the SDF is deeper than {-alpha} m: free points cannot be violated; "
        warnings.warn(text + "use a smaller penetration_tolerance", stacklevel=5)


@dataclass(frozen=True)
class InteriorPoints:
    """Points inside an object, on a lattice."""

    points: FloatArray  # (M, 3), object frame
    depth: FloatArray  # (M,) > 0, metres
    normals: FloatArray  # (M, 3), gradients of the SDF
    spacing: float  # of the lattice, metres

    def in_order(self, order: IntArray) -> InteriorPoints:
        """Return the points in an order (M,) of their indices."""
        points = self.points[order]
        depth = self.depth[order]
        normals = self.normals[order]
        return InteriorPoints(points, depth, normals=normals, spacing=self.spacing)

    def weights(self, settings: CostSettings, free_resolution: float) -> FloatArray:
        """Return the costs (M,) of points in a free voxel."""
        scale = settings.free_scale
        if settings.volume_normalise:
            scale *= (self.spacing / free_resolution) ** 3
        return scale * self.depth


def interior_points(sdf: SdfGrid, settings: CostSettings) -> InteriorPoints:
    """Return the nodes of a lattice over the grid that are deeper than alpha."""
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
    return InteriorPoints(nodes[inside], -s[inside], normals=n[inside], spacing=spacing)
