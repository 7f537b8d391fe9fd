"""Whether known points can be those of an object."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from chsel.errors import PointsError, PointsWarning, require_instance
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.points import KnownPoints, Lattice, Workspace
from chsel.problem.sdf_grid import SdfGrid

# In diameters of the object:
MOST_APART = 10.0  # between contacts, and from a contact to the free points
NEVER_APART = 100.0  # between contacts: a tenth of an object whose points are in millimetres
NEVER_AROUND = 1000.0  # between any points: an object whose points are in millimetres
MOST_OUTSIDE = 0.2  # from the workspace to a contact

_BLOCK = np.array(sorted(np.ndindex(3, 3, 3), key=lambda at: at != (1, 1, 1))) - 1  # centre first
_MOST_VOXELS = 2.0**62  # that can be numbered


_PARTS = {
    "sdf": (SdfGrid, "a grid such as chsel.SdfGrid.from_mesh(mesh)"),
    "points": (KnownPoints, "chsel.KnownPoints(free=..., known=...)"),
    "workspace": (Workspace, "chsel.Workspace(lower, upper)"),
}


def require_parts(**parts: object) -> None:
    """Raise SettingError unless what is named sdf, points or workspace is of its class."""
    for name, part in parts.items():
        kind, accepted = _PARTS[name]
        if not getattr(type(part), "stands_in", False):  # for a grid that a recording has lost
            require_instance(name, part, kind, accepted)


def check_points(
    points: KnownPoints,
    diameter: float,
    free_resolution: float,
    workspace: Workspace | None = None,
) -> list[PointsWarning]:
    """Warnings about suspicious points; none for points as a session yields them.

    diameter: of the object, metres. free_resolution: side of a free voxel, metres. workspace: where
    the object can be, if it was given and not derived from the points.
    Raises PointsError for points that no object of this size can have.
    """
    if points.count == 0 or diameter <= 0.0:
        return []
    touching = np.concatenate([points.contacts, points.occupied])
    return [
        *_extent(points, touching, diameter),
        *_distance_to_free(points, diameter),
        *_outside_of_workspace(touching, diameter, workspace),
        *_within_free_space(points.contacts, points.free, free_resolution),
    ]


def check_contacts(points: KnownPoints) -> list[PointsWarning]:
    """A warning if the points only show where the object is not."""
    if points.count == 0 or len(points.known) or len(points.occupied):
        return []
    text = (
        "all known points are free: any pose outside of free space fits; add contacts, or occupied "
        "or other known points"
    )
    return [PointsWarning("no_contact", text)]


def _extent(points: KnownPoints, touching: FloatArray, diameter: float) -> Iterator[PointsWarning]:
    """Points on and in one rigid object are at most a diameter apart.

    A far larger span is an error, unless a few outliers cause it.
    """
    for what, group, most in (
        ("points on the object", touching, NEVER_APART),
        ("known points", points.all_points(), NEVER_AROUND),
    ):
        if _diagonal(group) > most * diameter and _spread(group) > most * diameter:
            raise PointsError(
                f"{what} span {_diagonal(group):.4g} m, and the object is {diameter:.3g} m: are "
                "they in millimetres? accepted: points in metres, and the object in the same unit"
            )
    extent = _diagonal(touching)
    if extent > MOST_APART * diameter:
        text = (
            f"points on the object span {extent:.3g} m, and the object is {diameter:.3g} m; check "
            "units and frames, and remove outliers"
        )
        yield PointsWarning("contacts_apart", text)


def _distance_to_free(points: KnownPoints, diameter: float) -> Iterator[PointsWarning]:
    contacts, free, most = points.contacts, points.free, MOST_APART * diameter
    near = _diagonal(np.concatenate([contacts, free])) <= most
    if near or len(contacts) == 0 or len(free) == 0:
        return
    from scipy.spatial import cKDTree  # which takes longer to import than most registrations

    distance, _ = cKDTree(free).query(contacts)
    far = distance > most
    if far.any():
        text = (
            f"{_count(far, 'contacts')} are more than {MOST_APART:g} object diameters from all "
            f"free points, the farthest {distance.max():.3g} m; check that both are in one frame "
            "and one unit"
        )
        yield PointsWarning("contacts_far_from_free", text)


def _outside_of_workspace(
    touching: FloatArray, diameter: float, workspace: Workspace | None
) -> Iterator[PointsWarning]:
    if workspace is None or len(touching) == 0:
        return
    lower, upper = workspace.bounds
    beyond = np.maximum(np.maximum(lower - touching, touching - upper), 0.0)
    distance = np.sqrt((beyond**2).sum(axis=1))
    sides = zip(workspace.lower, workspace.upper, strict=True)
    box = "[" + ", ".join(f"[{low:g}, {high:g}]" for low, high in sides) + "]"
    if float(distance.min()) > diameter:
        raise PointsError(
            f"all points on the object are outside of the workspace {box}, the nearest "
            f"{distance.min():.3g} m from it; accepted: a workspace that holds the object"
        )
    outside = distance > MOST_OUTSIDE * diameter
    if outside.any():
        text = (
            f"{_count(outside, 'points on the object')} are outside of the workspace {box}, the "
            f"farthest {distance.max():.3g} m from it; check workspace, units and frames"
        )
        yield PointsWarning("contacts_outside", text)


def _within_free_space(
    contacts: FloatArray, free: FloatArray, resolution: float
) -> Iterator[PointsWarning]:
    if len(contacts) == 0 or len(free) == 0:
        return
    within = _enclosed(contacts, free, resolution)
    if within.any():
        text = (
            f"{_count(within, 'contacts')} are in free space: at a free point, or in a free voxel "
            f"of {resolution:g} m with free voxels all around; end free space before the surface"
        )
        yield PointsWarning("contacts_in_free_space", text)


def _enclosed(contacts: FloatArray, free: FloatArray, resolution: float) -> BoolArray:
    """Which contacts (C, 3) are free points, or lie in a free voxel whose 26 neighbours are free.

    A contact in a free voxel is common, as the voxel's centre may be outside of the object; between
    free neighbours there is no room for an object thicker than a voxel.
    """
    lattice = Lattice(tuple(free[0].tolist()), resolution)
    wanted = lattice.voxels(contacts)[:, None] + _BLOCK  # (C, 27, 3)
    lower = wanted.min(axis=(0, 1))
    shape = tuple(wanted.max(axis=(0, 1)) - lower + 1)
    if np.prod(shape, dtype=float) > _MOST_VOXELS:
        return np.zeros(len(contacts), dtype=bool)
    voxels = lattice.voxels(free) - lower
    near = ((voxels >= 0) & (voxels < shape)).all(axis=1)
    numbers = np.ravel_multi_index(tuple(voxels[near].T), shape)
    wanted_numbers = np.ravel_multi_index(tuple(np.moveaxis(wanted - lower, -1, 0)), shape)
    enclosed = np.isin(wanted_numbers, numbers).all(axis=1)
    beside = free[near][np.isin(numbers, wanted_numbers[:, 0])]
    places = {point.tobytes() for point in beside}
    same = np.array([contact.tobytes() in places for contact in contacts])
    either: BoolArray = enclosed | same
    return either


def _diagonal(points: FloatArray) -> float:
    """Diagonal in metres of the box around points (N, 3); 0 for none."""
    return float(np.sqrt((np.ptp(points, axis=0) ** 2).sum())) if len(points) else 0.0


def _spread(points: FloatArray) -> float:
    """Twice the 90th percentile (m) of the distances of points (N, 3) from their median."""
    away = points - np.median(points, axis=0)
    distance = np.sqrt((away**2).sum(axis=1))
    return 2.0 * float(np.percentile(distance, 90.0, method="lower"))


def _count(chosen: BoolArray, what: str) -> str:
    return f"{int(chosen.sum())} of {len(chosen)} {what}"
