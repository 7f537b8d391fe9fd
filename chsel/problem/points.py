"""What touch and sight have shown: free, occupied and known-SDF points in the world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from chsel.errors import PointsError, SettingError, require_positive
from chsel.numerics.arrays import (
    BoolArray,
    FloatArray,
    ShapesShown,
    digest,
    frozen,
    read_only,
    same_bits,
)
from chsel.numerics.voxels import bounds_of, set_voxels

_CLASSES = ("free", "occupied", "known", "known_sdf")


def _no_points() -> FloatArray:
    return np.zeros((0, 3))


@dataclass(frozen=True, eq=False, repr=False)
class KnownPoints(ShapesShown):
    """Known points in world coordinates, metres, by their semantics (CHSEL, Sec. III).

    Raises PointsError for wrong shapes and values that are not finite.
    """

    free: FloatArray = field(default_factory=_no_points)  # (N, 3), outside of the object
    occupied: FloatArray = field(default_factory=_no_points)  # (K, 3), inside of it
    known: FloatArray = field(default_factory=_no_points)  # (M, 3), of known signed distance
    known_sdf: FloatArray | None = None  # (M,), that distance; None: 0 for all, contacts

    def __post_init__(self) -> None:
        for name in ("free", "occupied", "known"):
            object.__setattr__(self, name, frozen(name, getattr(self, name), (None, 3)))
        sdf = np.zeros(len(self.known)) if self.known_sdf is None else self.known_sdf
        object.__setattr__(self, "known_sdf", frozen("known_sdf", sdf, (None,)))
        if len(self.sdf) != len(self.known):
            raise PointsError(
                f"known_sdf has {len(self.sdf)} entries; accepted: one per known point, "
                f"{len(self.known)}"
            )

    @property
    def sdf(self) -> FloatArray:
        """The known signed distances (M,) in metres; always an array."""
        assert self.known_sdf is not None
        return self.known_sdf

    @property
    def count(self) -> int:
        """Number of points in all classes."""
        return len(self.free) + len(self.occupied) + len(self.known)

    @property
    def contacts(self) -> FloatArray:
        """The known points on the surface, with signed distance 0 (M', 3)."""
        return self.known[self.sdf == 0.0]

    @cached_property
    def digest(self) -> str:
        """Digest of all points, in their order."""
        return digest(*(getattr(self, name) for name in _CLASSES))

    def merged(self, new: KnownPoints) -> KnownPoints:
        """These points followed by new ones, class by class."""
        return KnownPoints.joined([self, new])

    @classmethod
    def joined(cls, parts: Sequence[KnownPoints]) -> KnownPoints:
        """The points of several parts, at least one, in their order, class by class."""
        arrays: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts]) for name in _CLASSES
        }
        return cls(**arrays)

    def all_points(self) -> FloatArray:
        """Every point of every class (N + K + M, 3)."""
        return np.concatenate([self.free, self.occupied, self.known])


class GrowingPoints:
    """The known points of a session so far, joined only when all are asked for."""

    def __init__(self, initial: KnownPoints) -> None:
        self.free = self.occupied = self.known = self.contacts = 0  # numbers of points
        self._parts: list[KnownPoints] = []
        self.add(initial)

    def add(self, new: KnownPoints) -> None:
        """Append new points."""
        self._parts.append(new)
        self.free += len(new.free)
        self.occupied += len(new.occupied)
        self.known += len(new.known)
        self.contacts += len(new.contacts)

    def all(self) -> KnownPoints:
        """All points so far; the same value until more are added."""
        if len(self._parts) > 1:
            self._parts = [KnownPoints.joined(self._parts)]
        return self._parts[0]

    def same(self, points: KnownPoints) -> bool:
        """Whether these are all points so far in their order, to the bit; faster than digests."""
        for name in _CLASSES:
            whole, parts = getattr(points, name), [getattr(part, name) for part in self._parts]
            if len(whole) != sum(map(len, parts)):
                return False
            first = 0
            for part in parts:
                if not same_bits(whole[first : first + len(part)], part):
                    return False
                first += len(part)
        self._parts = [points]  # joined, without another copy
        return True

    @property
    def count(self) -> int:
        """Number of points in all classes."""
        return self.free + self.occupied + self.known


@dataclass(frozen=True)
class Workspace:
    """The box of the world in which the object must be."""

    lower: tuple[float, float, float]  # corners, metres
    upper: tuple[float, float, float]

    def __post_init__(self) -> None:
        lower, upper = frozen("workspace", (self.lower, self.upper), (2, 3))
        if not (upper > lower).all():
            raise PointsError(
                f"workspace runs from {lower.tolist()} to {upper.tolist()}; accepted: every lower "
                "bound below its upper bound"
            )
        object.__setattr__(self, "lower", tuple(float(value) for value in lower))
        object.__setattr__(self, "upper", tuple(float(value) for value in upper))

    @property
    def bounds(self) -> FloatArray:
        """Lower and upper corner (2, 3)."""
        return np.array([self.lower, self.upper])

    @classmethod
    def around(cls, points: FloatArray, margin: float) -> Workspace:
        """The bounds of points (N, 3), N > 0, padded by `margin` on every side."""
        lower, upper = points.min(axis=0) - margin, points.max(axis=0) + margin
        return cls(tuple(lower.tolist()), tuple(upper.tolist()))


@dataclass(frozen=True)
class Lattice:
    """A regular lattice of voxel centres: the origin plus integer multiples of the spacing."""

    origin: tuple[float, float, float]  # metres
    spacing: float  # metres

    def __post_init__(self) -> None:
        require_positive("voxel spacing", self.spacing)

    def voxels(self, points: FloatArray) -> np.ndarray:
        """Index (N, 3) of the voxel that holds each point: the nearest centre, ties to even."""
        return np.rint((points - np.array(self.origin)) / self.spacing).astype(np.int64)

    def centres(self, voxels: np.ndarray) -> FloatArray:
        """Centres (N, 3) of voxels (N, 3)."""
        return np.array(self.origin) + voxels * self.spacing


def voxels_spanned(points: FloatArray, resolution: float) -> float:
    """At least the number of voxels in a grid around points (N, 3), N > 0; see VoxelGrid."""
    return math.prod((np.ptp(points, axis=0) / resolution + 3.0).tolist())


@dataclass(frozen=True)
class VoxelGrid:
    """The voxels that hold a free point, with a layer of empty ones around."""

    origin: FloatArray  # (3,) centre of the first voxel
    resolution: float  # side of a voxel, metres
    flags: BoolArray  # (nx, ny, nz)

    @classmethod
    def around(cls, free: FloatArray, resolution: float, most: int = 100_000_000) -> VoxelGrid:
        """The voxels of free points (N, 3), N > 0. Raises SettingError for too many voxels."""
        bounds = bounds_of(free)
        count = voxels_spanned(bounds, resolution)
        if not count <= most:
            raise SettingError(
                f"free points span {count:.1e} voxels of {resolution} m; "
                f"accepted: at most {most:.0e}, so a coarser free_resolution"
            )
        lattice = Lattice(tuple(bounds[0].tolist()), resolution)
        flags = np.zeros(lattice.voxels(bounds[1]) + 3, dtype=bool)
        set_voxels(read_only(free), bounds[0], resolution, flags)
        return cls(bounds[0] - resolution, resolution, flags)


class FreeVoxels:
    """Free space so far, one point per voxel (the density cap of CHSEL, Sec. IV-B)."""

    def __init__(self, lattice: Lattice) -> None:
        self.lattice = lattice
        self._seen: set[tuple[int, int, int]] = set()

    def add(self, points: FloatArray) -> FloatArray:
        """Add the voxels of points (N, 3); return the centres (N', 3) of new ones by index."""
        voxels = np.unique(self.lattice.voxels(np.asarray(points, float).reshape(-1, 3)), axis=0)
        new = [voxel for voxel in map(tuple, voxels.tolist()) if voxel not in self._seen]
        self._seen.update(new)
        return self.lattice.centres(np.array(new, dtype=np.int64).reshape(-1, 3))

    def holds(self, points: FloatArray) -> BoolArray:
        """Which points (N, 3) are in a voxel added so far."""
        voxels = map(tuple, self.lattice.voxels(points).tolist())
        return np.array([voxel in self._seen for voxel in voxels], dtype=bool)

    def __len__(self) -> int:
        return len(self._seen)
