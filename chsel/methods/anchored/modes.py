"""Poses that are unlike each other: basins of a search, new modes, and near symmetries."""

from __future__ import annotations

import numpy as np

from chsel.methods.anchored.energy import Energy
from chsel.methods.anchored.fitting import fitted, twists_of
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.problem.noise import noise_model
from chsel.problem.outline import outline_distances_to, outline_in_object
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import Poses, compose, random_rotations, rotated
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import SE3Space
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.subset import farthest_points, surface_descriptors
from chsel.problem.surface import has_surface, object_centre

FAR = 0.01  # metres between outlines of different modes, at least
_TURNED = 0.35  # radians between poses of different basins, even where their outlines are alike
_TURNS = 2000  # of the object, among which near symmetries are sought: about 15 degrees apart
_FITTED = 100  # of these
_STEPS = 20
_ALIKE = 0.04  # diameters that a near symmetry moves the surface by at most, root mean square
_MOST = 8  # near symmetries


def has_new_mode(sdf: SdfGrid, old: Poses, new: Poses, wanted: int) -> bool:
    """Whether any of new poses is far from all old ones.

    Far is farther apart than as many old ones as are wanted, spread as far as can be.
    """
    if len(old) == 0 or len(new) == 0:
        return len(new) > 0
    outlines = surface_descriptors(sdf, Poses.joined([old, new]))
    outlines, new_outlines = outlines[: len(old)], outlines[len(old) :]
    chosen = farthest_points(outlines, wanted)
    spacing = _apart(outlines[chosen[:-1]], outlines[chosen[-1:]]) if len(chosen) > 1 else 0.0
    return _apart(outlines, new_outlines) > max(spacing, FAR)


def _apart(outlines: FloatArray, others: FloatArray) -> float:
    """The largest distance (m) of other outlines (M, D) from the nearest of outlines (N, D)."""
    nearest = [((outlines - other) ** 2).mean(axis=1).min() for other in others]
    return float(np.sqrt(max(nearest)))


def distinct(sdf: SdfGrid, poses: Poses, most: int, far: float = FAR) -> IntArray:
    """Indices of at most `most` poses, each far from, or turned against, all chosen before it."""
    outlines, rotations = surface_descriptors(sdf, poses), poses.rotations.reshape(-1, 9)
    least = 1.0 + 2.0 * np.cos(_TURNED)  # trace of the relative rotation
    chosen: list[int] = []
    left = np.ones(len(poses), dtype=bool)
    while len(chosen) < most and left.any():
        n = int(np.argmax(left))
        chosen.append(n)
        others = np.flatnonzero(left)
        near = ((outlines[others] - outlines[n]) ** 2).mean(axis=1) <= far**2
        turned = (rotations[others] * rotations[n]).sum(axis=1) < least
        left[others[near & ~turned]] = False
        left[n] = False
    return np.array(chosen, dtype=np.int64)


def near_symmetries(sdf: SdfGrid) -> FloatArray:
    """Motions (S, 4, 4) of the object under which its surface nearly comes back to where it was.

    None is the identity; derived once.
    """

    def make() -> FloatArray:
        if not has_surface(sdf):
            return np.zeros((0, 4, 4))
        surface, identity, key = outline_in_object(sdf), np.eye(4)[None], StreamKey(0, 0)
        around = Workspace(tuple(sdf.bounds[0]), tuple(sdf.bounds[1]))
        problem = RegistrationProblem(
            sdf, KnownPoints(known=surface), identity, around, sdf.resolution, key
        )
        centre, space = object_centre(sdf), SE3Space()
        energy = Energy(problem, problem.points, noise_model(FAR))
        turns = random_rotations(key.stream(Purpose.MESH_SAMPLES, 1), _TURNS)
        turned = Poses.of(compose(turns, centre - rotated(turns, centre)))
        best = np.argsort(energy.of(turned), kind="stable")[:_FITTED]
        fits = fitted(energy, twists_of(space, centre), turned[best], _STEPS)
        same = Poses.of(identity)
        moved = outline_distances_to(sdf, fits, same)
        order = np.argsort(moved, kind="stable")
        order = order[moved[order] <= _ALIKE * sdf.diameter]
        poses = Poses.joined([same, fits[order]])
        return poses[distinct(sdf, poses, _MOST + 1, np.inf)[1:]].matrices

    return sdf.derived("near symmetries", make)
