"""How far poses are from the best of them, but for symmetries of the object."""

from __future__ import annotations

import numpy as np

from chsel.methods.anchored.energy import Energy
from chsel.methods.anchored.fitting import fitted, twists_of
from chsel.numerics.arrays import FloatArray
from chsel.problem.noise import noise_model
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import Poses, compose, product, rotated, rotation_angle
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import SE3Space
from chsel.problem.streams import StreamKey
from chsel.problem.surface import (
    has_surface,
    outline_distances_to,
    outline_in_object,
)
from chsel.problem.trust import SYMMETRIC, middle

_SOFT = 0.02  # diameters: noise of the fit of an object to itself
_STEPS = 20
_SMALL = 0.05  # radians: turns that are taken as they are


def pose_bound(sdf: SdfGrid, poses: Poses) -> tuple[float, float]:
    """How far the farthest of poses (B, 12) is from the first: metres and radians.

    Of the object's centre, and turned. A turn counts as what is left of it after the symmetry of
    the object nearest to it: a motion that moves the surface by at most SYMMETRIC diameters, root
    mean square. It is found by fitting the object, turned, to itself.
    """
    if not has_surface(sdf):
        return 0.0, 0.0
    centre = middle(sdf)
    back = np.swapaxes(poses.rotations, 1, 2)  # world_from_object
    places = rotated(back, centre - poses.translations)
    away = np.sqrt(((places - places[0]) ** 2).sum(axis=1))
    turns = product(poses.rotations[0], back)  # of the object, in its frame
    angles = rotation_angle(turns)
    large = angles > _SMALL
    angles[large] = _left(sdf, centre, turns[large])
    return float(away.max()), float(angles.max())


def _left(sdf: SdfGrid, centre: FloatArray, turns: FloatArray) -> FloatArray:
    """Angles (B,), radians, of turns (B, 3, 3) of the object after the symmetry nearest to each."""
    angles = rotation_angle(turns)
    if len(turns) == 0:
        return angles
    identity = np.eye(4)[None]
    around = Workspace(tuple(sdf.bounds[0]), tuple(sdf.bounds[1]))
    surface = KnownPoints(known=outline_in_object(sdf))
    itself = RegistrationProblem(
        sdf,
        surface,
        initial_set=identity,
        workspace=around,
        free_resolution=sdf.resolution,
        key=StreamKey(0, 0),
    )
    energy = Energy(itself, surface, noise_model(_SOFT * sdf.diameter))
    turned = Poses.of(compose(turns, centre - rotated(turns, centre)))
    fits = fitted(energy, twists_of(SE3Space(), centre), turned, _STEPS)
    alike = outline_distances_to(sdf, fits, Poses.of(identity)) <= SYMMETRIC * sdf.diameter
    left = rotation_angle(product(turns, np.swapaxes(fits.rotations, 1, 2)))
    return np.where(alike, np.minimum(left, angles), angles)
