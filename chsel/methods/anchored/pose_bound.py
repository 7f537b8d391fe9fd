"""The distance and the angle between the best of some poses and the farthest from it."""

from __future__ import annotations

import numpy as np

from chsel.methods.anchored.fitting import fitted, twists_of
from chsel.methods.anchored.near_symmetries import energy_in_itself, turned_about
from chsel.numerics.arrays import FloatArray
from chsel.problem.pose_distances import SYMMETRIC, middle
from chsel.problem.poses import Poses, product, rotated, rotation_angle
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import SE3Space
from chsel.problem.surface import has_surface, outline_distances_to

# Where these numbers are from: docs/anchored.md, "Numbers that are no settings".
_SOFT = 0.02  # diameters: noise of the fit of an object to itself
_STEPS = 20  # of this fit
_TOGETHER = 4  # turns whose symmetries are looked for at once, the largest first
_SMALL = 0.05  # radians: turns up to it are taken as they are, without looking for a symmetry


def pose_bound(sdf: SdfGrid, poses: Poses) -> tuple[float, float]:
    """Return how far the farthest of poses (B, 12) is from the first, in metres and in radians.

    In metres: the object's centre. In radians: the turn that is left after the nearest symmetry of
    the object, a motion that moves the surface by at most SYMMETRIC diameters, root mean square. It
    is found by fitting the object, turned, to itself. Declared symmetries count as they are.
    """
    if not has_surface(sdf):
        return 0.0, 0.0
    symmetry = sdf.symmetry
    centre = middle(sdf) if symmetry is None else symmetry.centre
    back = np.swapaxes(poses.rotations, 1, 2)  # world_from_object
    places = rotated(back, centre - poses.translations)
    away = np.sqrt(((places - places[0]) ** 2).sum(axis=1))
    turns = product(poses.rotations[0], back)  # of the object, in its frame
    if symmetry is not None:
        return float(away.max()), float(symmetry.rotation_errors(turns).max())
    angles = rotation_angle(turns)
    order = np.argsort(-angles, kind="stable")
    large = order[angles[order] > _SMALL]
    turn = float(angles[angles <= _SMALL].max(initial=0.0))
    for first in range(0, len(large), _TOGETHER):
        some = large[first : first + _TOGETHER]
        if angles[some[0]] <= turn:  # what is left of a turn is no more than the turn
            break
        turn = max(turn, float(_left(sdf, centre, turns=turns[some]).max()))
    return float(away.max()), turn


def _left(sdf: SdfGrid, centre: FloatArray, *, turns: FloatArray) -> FloatArray:
    """Return angles (B,), radians, that turns (B, 3, 3) have left after their nearest symmetry."""
    angles = rotation_angle(turns)
    energy = energy_in_itself(sdf, _SOFT * sdf.diameter)
    fits = fitted(
        energy, twists_of(SE3Space(), centre), poses=turned_about(centre, turns), steps=_STEPS
    )
    alike = (
        outline_distances_to(sdf, fits, other=Poses.of(np.eye(4)[None])) <= SYMMETRIC * sdf.diameter
    )
    left = rotation_angle(product(turns, np.swapaxes(fits.rotations, 1, 2)))
    return np.where(alike, np.minimum(left, angles), angles)
