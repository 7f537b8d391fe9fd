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

    free_term: "direct" sums over free points as Eq. 8 does; "interior" sums over points inside
    the object that lie in free voxels, as the authors' experiments did. gradient: "defined" is
    violation times normal (Eqs. 8 to 10); "exact" is the derivative of the value.
    """

    penetration_tolerance: float = -0.01  # alpha, the level that free points may reach, metres
    free_scale: float = 20.0  # lambda
    occupied_scale: float = 20.0  # lambda
    known_scale: float = 1.0  # weight of known-SDF points
    free_term: str = "direct"
    interior_spacing: float | None = None  # of interior points, metres; by default |alpha|
    volume_normalise: bool = False  # weigh interior points by their share of a free voxel
    known_tolerance: float = 0.0  # dead band of known-SDF points, metres
    lookup: str = "trilinear"  # how the SDF grid is read, see SdfGrid.query
    outside: str = "surface_point"  # and beyond its box
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
