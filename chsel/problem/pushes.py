"""Touches that may have moved the object: points that were known before have moved with it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from chsel.errors import PointsError, require_positive
from chsel.numerics.arrays import FloatArray, IntArray, ShapesShown, digest, frozen
from chsel.numerics.cell_set import voxels_of
from chsel.problem.points import POINT_CLASSES, KnownPoints

_STEPS = 4
_UNIT = 1e-6  # by which the length of a direction may be off


@dataclass(frozen=True, eq=False, repr=False)
class Pushes(ShapesShown):
    """Touches of an object, each of which has moved it by the same unknown distance.

    A point that was known before some of them is now at p + s sum_j d_j, with their directions d_j
    and the distance s of one push, metres.
    Raises PointsError for directions that are not unit vectors and numbers of points that decrease.
    """

    directions: FloatArray  # (P, 3), unit vectors in the world, in the order of time
    before: IntArray  # (P, 3): numbers of free, occupied and known points that were known by then
    largest: float  # metres that one push moves the object at most

    def __post_init__(self) -> None:
        directions = frozen("push directions", self.directions, shape=(None, 3))
        before = frozen(
            "points before pushes", self.before, shape=(len(directions), 3), dtype=np.int64
        )
        require_positive("largest distance of a push", self.largest)
        if (np.abs((directions**2).sum(axis=1) - 1.0) > _UNIT).any():
            raise PointsError("push directions are not of length 1; accepted: unit vectors (P, 3)")
        if (before < 0).any() or (before[1:] < before[:-1]).any():
            raise PointsError("points before pushes decrease; accepted: counts (P, 3) in time")
        object.__setattr__(self, "directions", directions)
        object.__setattr__(self, "before", before)
        object.__setattr__(self, "largest", float(self.largest))

    def require_points(self, points: KnownPoints) -> None:
        """Raise PointsError if more points were known before a push than there are."""
        for name, counts in zip(POINT_CLASSES, self.before.T, strict=True):
            here = len(getattr(points, name))
            if (counts > here).any():
                raise PointsError(
                    f"{counts.max()} {name} points were known before a push; accepted: at most "
                    f"{here}, as many as there are"
                )

    @property
    def distances(self) -> list[float]:
        """Distances of a push that are tried, metres, in equal steps from 0 to the largest."""
        return [self.largest * n / _STEPS for n in range(_STEPS + 1)]

    @property
    def digest(self) -> str:
        """Digest of directions, counts and the largest distance."""
        return digest(self.directions, self.before, np.array([self.largest]))

    def carried(self, points: KnownPoints, distance: float, *, resolution: float) -> KnownPoints:
        """Return the points on the object as it is after every push moved it by a distance, metres.

        resolution: side of free voxels, metres, each of which keeps the first of its free points:
        what was free is swept again, as it has moved, too.
        """
        now = {name: np.array(getattr(points, name)) for name in POINT_CLASSES}
        for direction, counts in zip(self.directions, self.before, strict=True):
            for name, count in zip(POINT_CLASSES, counts, strict=True):
                now[name][:count] += distance * direction
        free = now["free"]
        x, y, z = voxels_of(free, free[:1], side=resolution).T
        _, first = np.unique((x << 42) + (y << 21) + z, return_index=True)  # within 2^20 voxels
        now["free"] = free[np.sort(first)]
        return replace(points, **now)
