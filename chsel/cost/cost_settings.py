"""Settings of the relaxed cost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from chsel.errors import SettingError, require_choice, require_positive
from chsel.problem.sdf_grid import LOOKUPS, OUTSIDE
from chsel.problem.settings import Presets

FREE_TERMS = ("direct", "interior")
GRADIENTS = ("defined", "exact")


@dataclass(frozen=True)
class CostSettings:
    """Settings of the relaxed cost, with the paper's symbols.

    penetration_tolerance: alpha, the level (metres, negative) that free points may reach.
    free_scale, occupied_scale: lambda. known_scale: weight of known-SDF points.
    free_term: "direct" sums over free points as Eq. 8 does; "interior" sums over points inside
    the object that fall into free voxels, as the authors' experiments did.
    interior_spacing: of those points, metres; by default |alpha|. volume_normalise: weigh them by
    the volume they stand for in free voxels. known_tolerance: dead band of known-SDF points,
    metres. lookup, outside: how the SDF grid is read, see SdfGrid.query. gradient: "defined"
    is violation times normal (Eqs. 8 to 10); "exact" is the derivative of the value.
    """

    penetration_tolerance: float = -0.01
    free_scale: float = 20.0
    occupied_scale: float = 20.0
    known_scale: float = 1.0
    free_term: str = "direct"
    interior_spacing: float | None = None
    volume_normalise: bool = False
    known_tolerance: float = 0.0
    lookup: str = "trilinear"
    outside: str = "surface_point"
    gradient: str = "defined"

    presets: ClassVar[Presets] = {
        "paper": {"lookup": "nearest"},
        "reference": {
            "free_term": "interior",
            "occupied_scale": 0.0,
            "lookup": "nearest",
            "outside": "bounding_box",
        },
    }

    def __post_init__(self) -> None:
        if not -10.0 < self.penetration_tolerance <= 0.0:
            raise SettingError(
                f"penetration_tolerance is {self.penetration_tolerance}; accepted: at most 0 (m)"
            )
        for name in ("free_scale", "occupied_scale", "known_scale", "known_tolerance"):
            require_positive(name, getattr(self, name), zero=True)
        if self.interior_spacing is not None:
            require_positive("interior_spacing", self.interior_spacing)
        require_choice("free_term", self.free_term, FREE_TERMS)
        require_choice("lookup", self.lookup, LOOKUPS)
        require_choice("outside", self.outside, OUTSIDE)
        require_choice("gradient", self.gradient, GRADIENTS)
        if self.free_term == "interior" and self.gradient == "exact":
            raise SettingError(
                "gradient is exact with free_term interior, whose value is piecewise constant; "
                "accepted: gradient defined, or free_term direct"
            )
