"""Points on the object that sensors measure, with normals and how far these may be off."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from chsel.numerics.arrays import FloatArray
from runners.sensors.rig import NO_NORMALS, Degrees

_ARRAYS = ("points", "contact_normals", "normals", "normal_noise")


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points on the object in the world. Normals are unit, out of the object, 0 if unknown."""

    points: FloatArray  # (N, 3), metres
    contact_normals: FloatArray  # (N, 3), for `Probe.contact_normals`, which are drawn alone
    normals: FloatArray  # (N, 3), for the known points, where methods read them
    normal_noise: FloatArray
    """(N,), root mean square of the angle that `normals` are off by, radians; 0 where unknown."""

    @classmethod
    def measured(
        cls,
        points: FloatArray,
        *,
        contact_normals: FloatArray | None = None,
        normals: FloatArray | None = None,
        degrees: Degrees = NO_NORMALS,
    ) -> SurfacePoints:
        """Return the points (N, 3) of one sensor with normals (N, 3); None: all are unknown.

        degrees: setting `normals` of the sensor; with NO_NORMALS none is kept for methods.
        """
        unknown = np.zeros_like(points)
        noise = np.zeros(len(points))
        if normals is None or degrees == NO_NORMALS:
            normals = unknown
        else:
            noise[(normals != 0.0).any(axis=1)] = math.radians(degrees)
        shown = unknown if contact_normals is None else contact_normals
        return cls(points, shown, normals=normals, normal_noise=noise)

    @classmethod
    def joined(cls, parts: Sequence[SurfacePoints]) -> SurfacePoints:
        """Return the points of several parts in their order; none of no part."""
        parts = [NO_POINTS, *parts]
        arrays = {name: np.concatenate([getattr(one, name) for one in parts]) for name in _ARRAYS}
        return cls(**arrays)

    def chosen(self, which: Any) -> SurfacePoints:
        """Return some of the points: by flags (N,), or by indices."""
        return SurfacePoints(**{name: getattr(self, name)[which] for name in _ARRAYS})

    def __len__(self) -> int:
        return len(self.points)


NO_POINTS = SurfacePoints.measured(np.zeros((0, 3)))
