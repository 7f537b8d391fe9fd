"""Motions of an object that nearly map it to itself: stage 4 of docs/anchored.md."""

from __future__ import annotations

import numpy as np

from chsel.methods.anchored.energy import Energy
from chsel.methods.anchored.fitting import fitted, twists_of
from chsel.numerics.arrays import FloatArray
from chsel.problem.basins import MODE_DISTANCE, basin_bests
from chsel.problem.noise import noise_model
from chsel.problem.points import KnownPoints, Workspace
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
    if not has_surface(sdf):
        return np.zeros((0, 4, 4))
    centre = object_centre(sdf)
    identity = Poses.of(np.eye(4)[None])
    energy = energy_in_itself(sdf, MODE_DISTANCE)
    turns = random_rotations(StreamKey(0, 0).stream(Purpose.MESH_SAMPLES, 1), _TURNS)
    turned = turned_about(centre, turns)
    best = np.argsort(energy.of(turned), kind="stable")[:_FITTED]
    fits = fitted(energy, twists_of(SE3Space(), centre), poses=turned[best], steps=_STEPS)
    distances = outline_distances_to(sdf, fits, other=identity)
    order = np.argsort(distances, kind="stable")
    order = order[distances[order] <= _ALIKE * sdf.diameter]
    poses = Poses.joined([identity, fits[order]])
    return poses[basin_bests(sdf, poses, most=_MOST + 1, distance=np.inf)[1:]].matrices


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
