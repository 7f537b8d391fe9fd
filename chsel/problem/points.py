"""Free, occupied and known-SDF points in the world, and whether they can be those of an object."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from chsel.errors import (
    PointsError,
    PointsWarning,
    SettingError,
    require_instance,
    require_positive,
)
from chsel.numerics.arrays import (
    BoolArray,
    FloatArray,
    GrowingRows,
    IntArray,
    ShapesShown,
    digest,
    evenly_spaced,
    frozen,
    read_only,
)
from chsel.numerics.cell_set import bounds_of, set_voxels, voxels_of
from chsel.problem.sdf_grid import SdfGrid

FREE_RESOLUTION = 0.01  # side of a voxel of free space, metres
_SURELY = 0.99  # of a distance: what is nearer is, however it is rounded
_FEW = 300  # points whose distances take less time than importing and building a tree
FARTHEST_PLACE = 1e5  # coordinates in the world, metres: turned, they are still within FARTHEST
MANY_REPEATED = 0.1  # share of points at places that were measured before
SAME_PLACE = 0.003  # metres: contacts nearer to an earlier one measure the same place again

# In diameters of the object:
MOST_APART = 10.0  # between contacts, and from a contact to the free points
NEVER_APART = 100.0  # between contacts: a tenth of an object whose points are in millimetres
NEVER_AROUND = 1000.0  # between any points: an object whose points are in millimetres
MOST_OUTSIDE = 0.2  # from the workspace to a contact
MOST_SAME = 0.05  # the largest SAME_PLACE
MOST_AWAY = 100.0  # from the world's origin, or the workspace, to what a robot does

_LEAST_AWAY = 50.0  # the same for small objects, metres

POINT_CLASSES = ("free", "occupied", "known")
_OF_KNOWN = ("known", "known_sdf", "normals", "normal_noise")
_ARRAYS = ("free", "occupied", *_OF_KNOWN)
_UNIT = 1e-6  # by which the squared length of a normal may be off
NEAR_UNIT = 0.01  # the same of the length of one that a program or a file gives
NORMAL_NOISE = 0.25  # radians, of normals about which nothing else is known
_BLOCK = np.array(list(np.ndindex(3, 3, 3))) - 1  # a voxel, at index 13, and its 26 neighbours
_MOST_VOXELS = 2.0**62  # that can be numbered


def _no_points() -> FloatArray:
    return np.zeros((0, 3))


@dataclass(frozen=True, eq=False, repr=False)
class KnownPoints(ShapesShown):
    """Known points in world coordinates, metres, by their semantics (CHSEL, Sec. III).

    Arguments are given by name, as free points are first. Raises PointsError for wrong shapes and
    values that are not finite.
    """

    free: FloatArray = field(default_factory=_no_points)  # (N, 3), outside of the object
    occupied: FloatArray = field(default_factory=_no_points)  # (K, 3), inside of it
    known: FloatArray = field(default_factory=_no_points)  # (M, 3), of known signed distance
    known_sdf: FloatArray | None = None  # (M,), that distance; None: 0 for all, contacts
    # (M, 3), unit vectors out of the object; 0 where they are not known. None: nowhere.
    normals: FloatArray = None  # type: ignore[assignment]  # as is the next one
    # (M,), root mean square of the angle that a normal is off by, radians; 0 where there is none.
    normal_noise: FloatArray = None  # type: ignore[assignment]

    def __new__(cls, *unnamed: Any, **named: Any) -> Self:
        if len(unnamed) == 1 and not named:
            raise PointsError("points have no name; accepted: KnownPoints(free=..., known=...)")
        return super().__new__(cls)

    def __post_init__(self) -> None:
        for name in POINT_CLASSES:
            object.__setattr__(self, name, frozen(name, getattr(self, name), shape=(None, 3)))
        sdf = np.zeros(len(self.known)) if self.known_sdf is None else self.known_sdf
        object.__setattr__(self, "known_sdf", frozen("known_sdf", sdf, shape=(None,)))
        if len(self.sdf) != len(self.known):
            raise PointsError(
                f"known_sdf has {len(self.sdf)} entries; accepted: one per known point, "
                f"{len(self.known)}"
            )
        self._set_normals()

    def _set_normals(self) -> None:
        count = len(self.known)
        normals = np.zeros((count, 3)) if self.normals is None else self.normals
        noise = np.zeros(count) if self.normal_noise is None else self.normal_noise
        # Plus 0: -0 is 0, and has another digest.
        normals = read_only(frozen("normals", normals, shape=(count, 3)) + 0.0)
        noise = read_only(frozen("normal_noise", noise, shape=(count,)) + 0.0)
        given = (normals != 0.0).any(axis=1)
        wrong = given & (np.abs((normals**2).sum(axis=1) - 1.0) > _UNIT)
        if wrong.any():
            at = int(np.argmax(wrong))
            length = math.sqrt(float((normals[at] ** 2).sum()))
            raise PointsError(f"normals[{at}] is {length:.6g} long; accepted: unit vectors, or 0")
        wrong = np.where(given, (noise <= 0.0) | (noise > math.pi), noise != 0.0)
        if wrong.any():
            at = int(np.argmax(wrong))
            raise PointsError(
                f"normal_noise[{at}] is {noise[at]:.6g}; accepted: above 0, up to pi, radians, "
                "and 0 for a point without a normal"
            )
        object.__setattr__(self, "normals", normals)
        object.__setattr__(self, "normal_noise", noise)

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

    @property
    def touching(self) -> FloatArray:
        """The contacts, then the occupied points (T, 3)."""
        return np.concatenate([self.contacts, self.occupied])

    @property
    def has_normals(self) -> bool:
        """Whether the normal of any known point is known."""
        return bool(self.normal_noise.any())

    @cached_property
    def digest(self) -> str:
        """Digest of all points, in their order."""
        arrays = [getattr(self, name) for name in (*POINT_CLASSES, "known_sdf")]
        return digest(*arrays, *([self.normals, self.normal_noise] if self.has_normals else []))

    @cached_property
    def bounds(self) -> FloatArray:
        """Lower and upper corner (2, 3) of the box around all points, at least one, metres."""
        return _bounds(self.all_points())

    def with_known(self, which: Any) -> KnownPoints:
        """Return these points with some of the known ones: by flags (M,), indices or a slice."""
        parts = {name: getattr(self, name)[which] for name in _OF_KNOWN}
        return self._of(parts | {"free": self.free, "occupied": self.occupied})

    def without_normals(self) -> KnownPoints:
        """Return these points as if no normal were known."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        none = {name: np.zeros_like(arrays[name]) for name in ("normals", "normal_noise")}
        return self._of(arrays | none)

    def merged(self, new: KnownPoints) -> KnownPoints:
        """Return these points followed by new ones, class by class.

        It takes the time of the new ones: arrays share the memory of those that they continue.
        """
        if self.count == 0 or new.count == 0:
            return new if self.count == 0 else self
        grown = {
            name: self._memory[name].appended(getattr(self, name), getattr(new, name))
            for name in _ARRAYS
        }
        merged = self._of({name: array for name, (array, _) in grown.items()})
        merged.__dict__["_memory"] = {name: memory for name, (_, memory) in grown.items()}
        merged.__dict__["bounds"] = _bounds(np.concatenate([self.bounds, new.bounds]))
        return merged

    @cached_property
    def _memory(self) -> dict[str, GrowingRows]:
        """The memory of each array."""
        return {name: GrowingRows(getattr(self, name)) for name in _ARRAYS}

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in _ARRAYS}  # memory stays in its process

    @classmethod
    def joined(cls, parts: Sequence[KnownPoints]) -> KnownPoints:
        """Return the points of several parts, at least one, in their order, class by class."""
        return cls._of(
            {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
        )

    @classmethod
    def _of(cls, arrays: Mapping[str, FloatArray]) -> Self:
        """Return the points of all arrays of others, which are checked already."""
        points = cls.__new__(cls)
        for name, array in arrays.items():
            object.__setattr__(points, name, read_only(array))
        return points

    def all_points(self) -> FloatArray:
        """Return every point of every class (N + K + M, 3)."""
        return np.concatenate([getattr(self, name) for name in POINT_CLASSES])


@dataclass(frozen=True)
class Workspace:
    """The box of the world in which the object must be."""

    lower: tuple[float, float, float]  # corners, metres
    upper: tuple[float, float, float] = ()  # type: ignore[assignment]  # so that we say what lacks

    def __post_init__(self) -> None:
        if np.size(self.upper) == 0:
            raise PointsError("workspace has one corner; accepted: chsel.Workspace(lower, upper)")
        lower, upper = frozen("workspace", (self.lower, self.upper), shape=(2, 3))
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

    def __str__(self) -> str:
        """Return its sides, as errors show them."""
        sides = zip(self.lower, self.upper, strict=True)
        return "[" + ", ".join(f"[{low:g}, {high:g}]" for low, high in sides) + "]"

    def distances(self, points: FloatArray) -> FloatArray:
        """Return how far points (N, 3) are outside, metres (N,); 0 inside."""
        lower, upper = self.bounds
        beyond = np.maximum(np.maximum(lower - points, points - upper), 0.0)
        return np.sqrt((beyond**2).sum(axis=1))

    @classmethod
    def around(cls, points: FloatArray, margin: float) -> Workspace:
        """Return the bounds of points (N, 3), N > 0, padded by `margin` on every side."""
        lower = points.min(axis=0) - margin
        upper = points.max(axis=0) + margin
        return cls(tuple(lower.tolist()), tuple(upper.tolist()))


def world_points(name: str, given: Any) -> FloatArray:
    """Return points (N, 3) as a program or a file gives them, metres; none for None.

    Raises PointsError unless it is such an array, and for places beyond FARTHEST_PLACE.
    """
    given = _no_points() if given is None else given
    return frozen(name, given, shape=(None, 3), most=FARTHEST_PLACE)


def unit_normals(name: str, given: Any, *, noise: Any, count: int) -> tuple[FloatArray, FloatArray]:
    """Return normals (N, 3) and their noise (N,) as a program or a file gives them, radians.

    name: of the normals, in errors. given: None for no normals; (0, 0, 0) for one that is not
    known. noise: one number for all, or one each; None for NORMAL_NOISE. Normals that KnownPoints
    accepts keep their bits. Raises PointsError for another count, for NaN, and for lengths that are
    not 1.
    """
    if given is None:
        if noise is not None:
            raise PointsError(f"normal_noise has no {name}; accepted: both, or none")
        return np.zeros((count, 3)), np.zeros(count)
    normals = frozen(name, given, shape=(None, 3))
    if len(normals) != count:
        raise PointsError(f"{name} has {len(normals)} rows; accepted: one per point, {count}")
    known = (normals != 0.0).any(axis=1)
    squares = (normals**2).sum(axis=1)
    lengths = np.where(np.abs(squares - 1.0) <= _UNIT, 1.0, np.sqrt(squares))
    wrong = known & (np.abs(lengths - 1.0) > NEAR_UNIT)
    if wrong.any():
        at = int(np.argmax(wrong))
        raise PointsError(
            f"{name}[{at}] is {lengths[at]:.4g} long; accepted: unit vectors out of the "
            "object, or 0 where a normal is not known"
        )
    one = not isinstance(noise, list | tuple) and np.ndim(noise) == 0
    noise = frozen(
        "normal_noise", [NORMAL_NOISE if noise is None else noise] if one else noise, shape=(None,)
    )
    if not one and len(noise) != count:
        raise PointsError(f"normal_noise has {len(noise)} entries; accepted: one, or {count}")
    needed = True if one else known
    if ((noise < 0.0) | (noise > math.pi) | (needed & (noise == 0.0))).any():
        text = "in degrees? " if (noise > math.pi).any() else ""
        raise PointsError(
            f"normal_noise is {noise.max() if text else noise.min():.4g}; {text}accepted: above 0, "
            "up to pi, radians"
        )
    return normals / np.where(known, lengths, 1.0)[:, None], np.where(known, noise, 0.0)


def world_known_points(
    *, free: Any = None, occupied: Any = None, known: Any = None, known_sdf: Any = None
) -> KnownPoints:
    """Return points of all classes, as `world_points` does; a known point needs its distance."""
    sdf = np.zeros(0) if known_sdf is None else known_sdf
    return KnownPoints(
        free=world_points("free", free),
        occupied=world_points("occupied", occupied),
        known=world_points("known", known),
        known_sdf=frozen("known_sdf", sdf, shape=(None,), most=FARTHEST_PLACE),
    )


def workspace_around(points: KnownPoints, sdf: SdfGrid) -> Workspace:
    """Return the workspace of an object that touches points: their bounds and its diameter."""
    return Workspace.around(points.all_points(), sdf.diameter)


def check_places(
    name: str, places: FloatArray, *, diameter: float, workspace: Workspace | None = None
) -> list[PointsWarning]:
    """Return a warning if places (N, 3) are so far away that they may be in millimetres.

    That is, all far from the world's origin and from the workspace, where there is one. diameter:
    of the object, metres.
    """
    if len(places) == 0:
        return []
    lower, upper = np.zeros((2, 3)) if workspace is None else workspace.bounds
    lower, upper = np.minimum(lower, 0.0), np.maximum(upper, 0.0)
    beyond = np.maximum(np.maximum(lower - places, places - upper), 0.0)
    nearest = float(np.sqrt((beyond**2).sum(axis=1)).min())
    if nearest <= max(MOST_AWAY * diameter, _LEAST_AWAY):
        return []
    away = "the world's origin" if workspace is None else "the workspace and the world's origin"
    text = f"{name} is {nearest:.4g} m from {away}: in millimetres? accepted: metres"
    return [PointsWarning("far_away", text)]


def check_workspace(workspace: Workspace, diameter: float) -> list[PointsWarning]:
    """Return a warning if a workspace is so wide that it may be in millimetres; diameter: metres.

    Raises PointsError for corners beyond FARTHEST_PLACE.
    """
    frozen("workspace", workspace.bounds, shape=(2, 3), most=FARTHEST_PLACE)
    widest = float(np.ptp(workspace.bounds, axis=0).max())
    if widest <= max(MOST_AWAY * diameter, _LEAST_AWAY):
        return []
    text = f"workspace is {widest:.4g} m wide, and the object {diameter:.3g} m: in millimetres?"
    return [PointsWarning("wide_workspace", f"{text} accepted: metres")]


def same_place(diameter: float) -> float:
    """Return up to which distance (metres) points on an object measure the same place."""
    return min(SAME_PLACE, MOST_SAME * diameter)


def distinct_points(
    new: KnownPoints, earlier: KnownPoints, *, apart: float
) -> tuple[KnownPoints, list[PointsWarning]]:
    """Return new points at places that were not measured before, and a warning about others.

    Such points have one error in common, so they count once: occupied and known points farther than
    `apart` metres from all earlier ones are kept, by position and signed distance. Free points are
    all kept. A few such points, as in a dense scan, are no warning.
    """
    known, before = (np.column_stack([each.known, each.sdf]) for each in (new, earlier))
    fresh = first_at_place(known, before, apart=apart)
    inside = first_at_place(new.occupied, earlier.occupied, apart=apart)
    repeated = int((~fresh).sum() + (~inside).sum())
    count = len(fresh) + len(inside)
    if repeated == 0:
        return new, []
    kept = replace(new, occupied=new.occupied[inside]).with_known(fresh)
    if repeated <= MANY_REPEATED * count:
        return kept, []
    text = (
        f"{repeated} of {count} points are within {1000.0 * apart:.2g} mm of an "
        "earlier one; a place that is measured again counts once"
    )
    return kept, [PointsWarning("repeated", text)]


def away_from(points: FloatArray, earlier: FloatArray, *, apart: float) -> BoolArray:
    """Return flags (N,) of points (N, k) farther than `apart` from all earlier ones (M, k)."""
    if len(points) == 0 or len(earlier) == 0:
        return np.ones(len(points), dtype=bool)
    if len(points) * len(earlier) <= _FEW**2:
        away = points[:, None] - earlier
        return np.asarray(((away**2).sum(axis=2) > apart**2).all(axis=1))
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(earlier).query(points)[0] > apart)


def first_at_place(points: FloatArray, earlier: FloatArray, *, apart: float) -> BoolArray:
    """Return flags (N,) of points (N, k) farther than `apart` from earlier (M, k) and kept ones."""
    first = away_from(points, earlier, apart=apart)
    left = np.flatnonzero(first)
    if len(left) < 2:
        return first
    left = left[np.sort(np.unique(points[left], axis=0, return_index=True)[1])]
    first[:] = False
    first[left] = True
    near = _near(points[left], apart)
    for n, row in enumerate(left):
        if first[row]:
            first[left[near(n)]] = False
            first[row] = True
    return first


def _near(points: FloatArray, apart: float) -> Callable[[int], Any]:
    """Return a function of n: which of points (N, k) are up to `apart` from the n-th one."""
    if len(points) <= _FEW:
        away = points[:, None] - points
        within = (away**2).sum(axis=2) <= apart**2
        return lambda n: within[n]
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    return lambda n: tree.query_ball_point(points[n], apart)


@dataclass(frozen=True)
class Lattice:
    """A regular lattice of voxel centres: the origin plus integer multiples of the spacing."""

    origin: tuple[float, float, float]  # metres
    spacing: float  # metres

    def __post_init__(self) -> None:
        require_positive("voxel spacing", self.spacing)

    def voxels(self, points: FloatArray) -> np.ndarray:
        """Return indices (N, 3) of the voxels of points (N, 3): nearest centres, ties to even."""
        return voxels_of(points, np.array(self.origin), side=self.spacing)

    def centres(self, voxels: np.ndarray) -> FloatArray:
        """Return centres (N, 3) of voxels (N, 3)."""
        return np.array(self.origin) + voxels * self.spacing


def voxels_spanned(points: FloatArray, resolution: float) -> float:
    """Return at least the number of voxels in a grid around points (N, 3), N > 0; see VoxelGrid."""
    return math.prod((np.ptp(points, axis=0) / resolution + 3.0).tolist())


@dataclass(frozen=True)
class VoxelGrid:
    """The voxels that hold a free point, with a layer of empty ones around."""

    origin: FloatArray  # (3,) centre of the first voxel
    resolution: float  # side of a voxel, metres
    flags: BoolArray  # (nx, ny, nz)

    @classmethod
    def around(cls, free: FloatArray, resolution: float, *, most: int = 100_000_000) -> VoxelGrid:
        """Return the voxels of free points (N, 3), N > 0. Raises SettingError for too many."""
        bounds = bounds_of(free)
        count = voxels_spanned(bounds, resolution)
        if not count <= most:
            raise SettingError(
                f"free points span {count:.1e} voxels of {resolution} m; "
                f"accepted: at most {most:.0e}, so a coarser free_resolution"
            )
        lattice = Lattice(tuple(bounds[0].tolist()), resolution)
        flags = np.zeros(lattice.voxels(bounds[1]) + 3, dtype=bool)
        set_voxels(read_only(free), bounds[0], side=resolution, flags=flags)
        return cls(bounds[0] - resolution, resolution, flags=flags)


class FreeVoxels:
    """Free space so far, one point per voxel (the density cap of CHSEL, Sec. IV-B)."""

    def __init__(self, lattice: Lattice) -> None:
        self.lattice = lattice
        self._seen: set[int] = set()  # numbers of voxels

    def add(self, points: FloatArray) -> FloatArray:
        """Add the voxels of points (N, 3); return the centres (N', 3) of new ones by index."""
        voxels = self.lattice.voxels(np.asarray(points, float).reshape(-1, 3))
        found, first = np.unique(_numbers(voxels), return_index=True)
        numbers = found.tolist()
        new = np.array([number not in self._seen for number in numbers], dtype=bool)
        self._seen.update(numbers)
        return self.lattice.centres(voxels[first[new]])

    def forget(self) -> None:
        """Let the next points be new again, as after the object has moved."""
        self._seen.clear()

    def holds(self, points: FloatArray) -> BoolArray:
        """Return flags (N,) of points (N, 3) in a voxel added so far."""
        numbers = _numbers(self.lattice.voxels(points)).tolist()
        return np.array([number in self._seen for number in numbers], dtype=bool)

    def __len__(self) -> int:
        return len(self._seen)


def _numbers(voxels: IntArray) -> IntArray:
    """Return a number (N,) for each of voxels (N, 3), ascending by index, within 2^20 voxels."""
    x, y, z = voxels.T
    return (x << 42) + (y << 21) + z


_PARTS = {
    "sdf": (SdfGrid, "a grid such as chsel.SdfGrid.from_mesh(mesh)"),
    "points": (KnownPoints, "chsel.KnownPoints(free=..., known=...)"),
    "workspace": (Workspace, "chsel.Workspace(lower, upper)"),
}


def require_parts(**parts: object) -> None:
    """Raise SettingError unless what is named sdf, points or workspace is of its class."""
    for name, part in parts.items():
        kind, accepted = _PARTS[name]
        require_instance(name, part, kind=kind, accepted=accepted)


def check_points(
    points: KnownPoints,
    diameter: float,
    *,
    free_resolution: float,
    workspace: Workspace | None = None,
) -> list[PointsWarning]:
    """Return warnings about suspicious points; none for points as a session yields them.

    diameter: of the object, metres. free_resolution: side of a free voxel, metres. workspace: where
    the object can be, if it was given and not derived from the points.
    Raises PointsError for points that no object of this size can have.
    """
    require_possible(points, diameter, workspace=workspace)
    if points.count == 0 or diameter <= 0.0:
        return []
    contacts, free = points.contacts, points.free
    touching = points.touching
    warnings: list[PointsWarning] = []
    if (extent := _diagonal(touching)) > MOST_APART * diameter:
        text = (
            f"points on the object span {extent:.3g} m, and the object is {diameter:.3g} m; check "
            "units and frames, and remove outliers"
        )
        warnings.append(PointsWarning("contacts_apart", text))
    both = len(contacts) > 0 and len(free) > 0
    if both and _is_far(contacts, free, most=MOST_APART * diameter, bounds=points.bounds):
        from scipy.spatial import cKDTree  # which takes longer to import than most registrations

        distance, _ = cKDTree(free).query(contacts)
        if (far := distance > MOST_APART * diameter).any():
            text = (
                f"{_count(far, 'contacts')} are more than {MOST_APART:g} object diameters from all "
                f"free points, the farthest {distance.max():.3g} m; check that both are in one "
                "frame and one unit"
            )
            warnings.append(PointsWarning("contacts_far_from_free", text))
    if workspace is not None and len(touching):
        distance = workspace.distances(touching)
        if (outside := distance > MOST_OUTSIDE * diameter).any():
            text = (
                f"{_count(outside, 'points on the object')} are outside of the workspace "
                f"{workspace}, the farthest {distance.max():.3g} m from it; check workspace, units "
                "and frames"
            )
            warnings.append(PointsWarning("contacts_outside", text))
    if both and (within := _enclosed(contacts, free, resolution=free_resolution)).any():
        text = (
            f"{_count(within, 'contacts')} are in free space: at a free point, or in a free voxel "
            f"of {free_resolution:g} m with free voxels all around; end free space before the "
            "surface"
        )
        warnings.append(PointsWarning("contacts_in_free_space", text))
    return warnings


def require_possible(
    points: KnownPoints, diameter: float, *, workspace: Workspace | None = None
) -> None:
    """Raise PointsError for points that no object of this size can have.

    Arguments as of `check_points`.
    """
    if points.count == 0 or diameter <= 0.0:
        return
    touching = points.touching
    for what, bounds, most in (
        ("points on the object", touching, NEVER_APART),
        ("known points", points.bounds, NEVER_AROUND),
    ):
        extent = _diagonal(bounds)
        if extent <= most * diameter:
            continue
        # A far larger span is an error, unless a few outliers cause it.
        if _spread(touching if bounds is touching else points.all_points()) > most * diameter:
            raise PointsError(
                f"{what} span {extent:.4g} m, and the object is {diameter:.3g} m: are "
                "they in millimetres? accepted: points in metres, and the object in the same unit"
            )
    if workspace is None or len(touching) == 0:
        return
    nearest = float(workspace.distances(touching).min())
    if nearest > diameter:
        raise PointsError(
            f"all points on the object are outside of the workspace {workspace}, the nearest "
            f"{nearest:.3g} m from it; accepted: a workspace that holds the object"
        )


def check_contacts(points: KnownPoints) -> list[PointsWarning]:
    """Return a warning if the points only show where the object is not."""
    if points.count == 0 or len(points.known) or len(points.occupied):
        return []
    text = (
        "all known points are free: any pose outside of free space fits; add contacts, or occupied "
        "or other known points"
    )
    return [PointsWarning("no_contact", text)]


def _enclosed(contacts: FloatArray, free: FloatArray, *, resolution: float) -> BoolArray:
    """Return flags (C,) of contacts at a free point, or in a free voxel with 26 free neighbours.

    A contact in a free voxel is common, as the voxel's centre may be outside of the object; between
    free neighbours there is no room for an object thicker than a voxel.
    """
    lattice = Lattice(tuple(free[0].tolist()), resolution)
    wanted = lattice.voxels(contacts)[:, None] + _BLOCK  # (C, 27, 3)
    lower, upper = wanted.min(axis=(0, 1)), wanted.max(axis=(0, 1))
    shape = tuple(upper - lower + 1)
    if np.prod(shape, dtype=float) > _MOST_VOXELS:
        return np.zeros(len(contacts), dtype=bool)
    free = _within(free, lattice.centres(np.array([lower - 1, upper + 1])))  # with all that count
    voxels = lattice.voxels(free) - lower
    near = ((voxels >= 0) & (voxels < shape)).all(axis=1)
    numbers = np.ravel_multi_index(tuple(voxels[near].T), shape)
    wanted_numbers = np.ravel_multi_index(tuple(np.moveaxis(wanted - lower, -1, 0)), shape)
    enclosed = np.isin(wanted_numbers, numbers).all(axis=1)
    beside = free[near][np.isin(numbers, wanted_numbers[:, 13])]
    places = {point.tobytes() for point in beside}
    same = np.array([contact.tobytes() in places for contact in contacts])
    return np.asarray(enclosed | same)


def _is_far(contacts: FloatArray, free: FloatArray, *, most: float, bounds: FloatArray) -> bool:
    """Return whether a contact may be farther than `most` metres from all free points.

    bounds: of both, and of other points. Some of the free points show that most contacts are not.
    """
    if _diagonal(bounds) <= most or _diagonal(np.concatenate([contacts, free])) <= most:
        return False
    some = free[evenly_spaced(len(free), _FEW)]
    return bool(away_from(contacts, some, apart=_SURELY * most).any())


def _within(points: FloatArray, bounds: FloatArray) -> FloatArray:
    """Return those of points (N, 3) in a box, by its lower and upper corner (2, 3)."""
    kept = np.arange(len(points))
    for axis in range(3):  # as most are beyond the first sides
        values = points[kept, axis]
        kept = kept[(values >= bounds[0, axis]) & (values <= bounds[1, axis])]
    return points[kept]


def _bounds(points: FloatArray) -> FloatArray:
    """Return the lower and the upper corner (2, 3) of the box around points (N, 3), N > 0."""
    return np.array([points.min(axis=0), points.max(axis=0)])


def _diagonal(points: FloatArray) -> float:
    """Return diagonal in metres of the box around points (N, 3); 0 for none."""
    return float(np.sqrt((np.ptp(points, axis=0) ** 2).sum())) if len(points) else 0.0


def _spread(points: FloatArray) -> float:
    """Return twice the 90th percentile (m) of the distances of points (N, 3) from their median."""
    away = points - np.median(points, axis=0)
    distance = np.sqrt((away**2).sum(axis=1))
    return 2.0 * float(np.percentile(distance, 90.0, method="lower"))


def _count(chosen: BoolArray, what: str) -> str:
    return f"{int(chosen.sum())} of {len(chosen)} {what}"
