"""Motions of an object that nearly map it to itself: stage 4 of docs/anchored.md."""

from __future__ import annotations

import numpy as np

from chsel.methods.anchored.energy import Energy
from chsel.methods.anchored.fitting import fitted, twists_of
from chsel.numerics.arrays import FloatArray
from chsel.problem.basins import MODE_DISTANCE, basin_bests
from chsel.problem.noise import noise_model
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.pose_distances import SYMMETRIC
from chsel.problem.poses import Poses, compose, random_rotations, rotated
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import SE3Space
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.surface import (
    has_surface,
    object_centre,
    outline_distances_to,
    outline_in_object,
)

# Where these numbers are from: docs/anchored.md, "Numbers that are no settings".
_TURNS = 2000  # of the object that are tried, about 15 degrees apart
_FITTED = 100  # the best of them, which are fitted
_STEPS = 20  # of these fits
_MOST = 8  # near symmetries
_ALIKE = 0.04  # diameters that a near symmetry moves the surface by at most, root mean square


def near_symmetries(sdf: SdfGrid) -> FloatArray:
    """Return motions (S, 4, 4) of the object that nearly map its surface to itself.

    The identity is not among them. They are found once for a grid.
    """
    return sdf.derived("near symmetries", lambda: _near_symmetries(sdf))


def _near_symmetries(sdf: SdfGrid) -> FloatArray:
    fits = _fits_to_itself(sdf, _ALIKE)
    if len(fits) == 0:
        return fits.matrices
    poses = Poses.joined([Poses.of(np.eye(4)[None]), fits])
    return poses[basin_bests(sdf, poses, most=_MOST + 1, distance=np.inf)[1:]].matrices


def _fits_to_itself(sdf: SdfGrid, most: float) -> Poses:
    """Return fits of the object to itself, the best first.

    most: diameters that they move the surface by, root mean square.
    """
    identity = Poses.of(np.eye(4)[None])
    if not has_surface(sdf):
        return identity[:0]
    centre = object_centre(sdf)
    energy = energy_in_itself(sdf, MODE_DISTANCE)
    turns = random_rotations(StreamKey(0, 0).stream(Purpose.MESH_SAMPLES, 1), _TURNS)
    turned = turned_about(centre, turns)
    best = np.argsort(energy.of(turned), kind="stable")[:_FITTED]
    fits = fitted(energy, twists_of(SE3Space(), centre), poses=turned[best], steps=_STEPS)
    distances = outline_distances_to(sdf, fits, other=identity)
    order = np.argsort(distances, kind="stable")
    return fits[order[distances[order] <= most * sdf.diameter]]


def turns_alike(sdf: SdfGrid) -> FloatArray:
    """Return motions (S, 4, 4) that map the object's surface to itself, at most 100.

    They move it by at most SYMMETRIC diameters, root mean square. Those about an axis of revolution
    are spread around it.
    """
    return sdf.derived("turns alike", lambda: _fits_to_itself(sdf, SYMMETRIC).matrices)


def energy_in_itself(sdf: SdfGrid, noise: float) -> Energy:
    """Return the energy of an object posed in itself, by points of its surface as contacts.

    noise: standard deviation of these points, metres.
    """
    surface = KnownPoints(known=outline_in_object(sdf))
    problem = RegistrationProblem(
        sdf=sdf,
        points=surface,
        initial_set=np.eye(4)[None],
        workspace=Workspace(tuple(sdf.bounds[0]), tuple(sdf.bounds[1])),
        free_resolution=sdf.resolution,
        key=StreamKey(0, 0),
    )
    return Energy(problem, surface, noise=noise_model(noise))


def turned_about(centre: FloatArray, turns: FloatArray) -> Poses:
    """Return poses of an object turned by turns (B, 3, 3) about a point (3,) of it."""
    return Poses.of(compose(turns, centre - rotated(turns, centre)))
