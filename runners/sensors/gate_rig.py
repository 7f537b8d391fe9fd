"""Which measurements of an object are left out, as they are not connected with the others."""

from __future__ import annotations

from dataclasses import dataclass

from chsel.errors import SettingError, require_at_most, require_positive

_MOST = 1_000_000  # pixels, metres, shares


@dataclass(frozen=True)
class GateRig:
    """When pixels and points are connected, and which of their regions are left out."""

    jump: float = 0.01
    """Neighbouring pixels are connected unless their depths differ by more than this share of the
    depth, besides what a surface inclined by up to 76 degrees explains."""

    gap: float = 0.02
    """Points of clouds are connected up to this distance, metres, or up to four times the typical
    distance between neighbours where that is more."""

    part: float = 0.05
    """Of an object, regions with fewer pixels or points than this share of the largest are left
    out; 0: none is for its size."""

    speckle: int = 100
    """Where fewer pixels than this are connected, a camera's rays are free up to the least depth
    around them alone; 0: nowhere."""

    def __post_init__(self) -> None:
        for name in ("jump", "gap"):
            require_positive(name, getattr(self, name))
            require_at_most(name, getattr(self, name), _MOST)
        if not 0.0 <= self.part <= 1.0:
            raise SettingError(f"part is {self.part}; accepted: from 0 to 1")
        require_positive("speckle", self.speckle, zero=True)
        require_at_most("speckle", self.speckle, _MOST)
