"""The energy of poses, fits that lower it, and random walks below a limit."""

from __future__ import annotations

from copy import copy
from threading import get_ident
from typing import Any, NamedTuple

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_settings import CostSettings, uncertain_depth
from chsel.methods.anchored.fine_cells import fine_cells_below
from chsel.methods.anchored.fit_kernels import Fit, Loss, Twists, fit_for, fit_poses
from chsel.methods.anchored.walk_kernels import (
    Chains,
    MoveDraws,
    Stride,
    Walk,
    chains_from,
    energies_below,
    walk_below,
    walk_for,
)
from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import triple
from chsel.numerics.threads import spread
from chsel.problem.noise import Noise, estimate_noise
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.search_space import SE2Space, SearchSpace
from chsel.problem.streams import Purpose
from chsel.problem.subset import distances_from_surface
from chsel.problem.surface import object_centre

_FIT_LEVEL = -0.003  # metres: free points at less depth do not push
_LEVER = 0.15  # metres that a radian counts for
_FOREIGN = 8.0  # noise levels beyond which a known point costs no more
_WRONG = 20.0  # noise levels off that a known point costs as much as a free one can


class NoiseLevel(NamedTuple):
    """How inexact points are taken to be."""

    sigma: float  # standard deviation of known points, metres
    tolerance: float  # depth that free points may have at no cost, metres
    least_cap: float  # distance beyond which known points cost no more, at least, metres


def tolerances_of(problem: RegistrationProblem, fixed: float | None) -> tuple[float, ...]:
    """The depths (metres) that free points may have at no cost, the first unless nothing fits.

    Voxels may be off by half of one, or by a whole one.
    """
    if fixed is not None:
        return (fixed,)
    if len(problem.points.free) == 0:
        return (0.0,)
    sdf, voxel = problem.sdf, problem.free_resolution
    return tuple(dict.fromkeys(uncertain_depth(sdf, depth) for depth in (0.0, 0.5 * voxel, voxel)))


class Energy:
    """E(X) = mean loss of s - v over known points + a sum of depths over free ones, in metres.

    The loss is quadratic up to the noise, then linear, then constant; a free point costs its depth
    beyond a tolerance, but at most as much as some known points that are off; occupied points are
    the mirror image of free ones. N / sigma times it is a negative log-likelihood of the pose, with
    N known points of noise sigma.
    """

    def __init__(
        self,
        problem: RegistrationProblem,
        known: KnownPoints,
        space: SearchSpace,
        bounds: tuple[FloatArray, FloatArray],
        level: NoiseLevel,
    ) -> None:
        """known: the problem's points, see most_informative_first.

        bounds: where walks keep the object's origin.
        """
        settings = CostSettings(
            penetration_tolerance=0.0, known_scale=1.0 / max(len(known.known), 1)
        )
        resolution = problem.free_resolution
        self._sdf, self._known, self._key = problem.sdf, known, problem.key
        self._cost = CompiledCost(
            problem.sdf, known, settings, free_resolution=resolution, culling="octree"
        )
        basis, axis = np.eye(6), (0.0, 0.0, 0.0)
        if isinstance(space, SE2Space):
            basis, axis = np.zeros((3, 6)), triple(space.axis)
            basis[0, :3], basis[1, 3:], basis[2, 3:] = space.axis, space.e_u, space.e_v
        basis[:, :3] /= _LEVER
        centre = triple(object_centre(problem.sdf))
        self._twists = Twists(basis, centre)
        self._stride = Stride(
            planar=isinstance(space, SE2Space),
            axis=axis,
            pivot=centre,
            lower=triple(bounds[0]),
            upper=triple(bounds[1]),
        )
        self._set(level)

    def _set(self, level: NoiseLevel) -> None:
        self.level = level
        self._walks: dict[int, Walk] = {}
        self._fits: dict[int, Fit] = {}
        self._model = self._cost.at_level(self._sdf, -level.tolerance)
        self._fitting = self._cost.at_level(self._sdf, _FIT_LEVEL - level.tolerance)
        self._fine = fine_cells_below(self._sdf, self._model.alpha)
        self._fine_of_fits = fine_cells_below(self._sdf, self._fitting.alpha)
        cap = max(_FOREIGN * level.sigma, level.least_cap)
        self.loss = Loss(level.sigma, cap, _WRONG * level.sigma / max(len(self._known.known), 1))

    def at(self, level: NoiseLevel) -> Energy:
        """The energy at another level of noise."""
        energy = copy(self)
        energy._set(level)
        return energy

    def walk(self) -> Walk:
        """Scratch of this thread for kernels of energies and walks."""
        thread = get_ident()
        if thread not in self._walks:
            table = self._sdf.values.reshape(-1)
            self._walks[thread] = walk_for(self._model, table, self._fine)
        return self._walks[thread]

    def _fit(self) -> Fit:
        """Scratch of this thread for fits."""
        thread = get_ident()
        if thread not in self._fits:
            dimension = len(self._twists.basis)
            self._fits[thread] = fit_for(self._fitting, self._fine_of_fits, dimension)
        return self._fits[thread]

    def noise(self, pose: Poses, sensor_noise: float) -> Noise:
        """What known points are off at a pose."""
        places = self._known.known
        distances = np.empty((1, len(places)))
        distances_from_surface(self._model.field, pose.numbers, places, distances, 0, 1)
        return estimate_noise(distances[0] - self._known.sdf, sensor_noise)

    def of(self, poses: Poses) -> FloatArray:
        """Energies (B,) of poses."""
        energies = np.empty(len(poses))

        def run(first: int, last: int, walk: Any) -> None:
            energies_below(
                self._model, self.loss, poses.numbers, np.inf, energies, first, last, walk
            )

        spread(run, len(poses), self.walk, least=50)
        return energies

    def fitted(self, poses: Poses, steps: int, loss: Loss) -> Poses:
        """Poses after at most so many Levenberg-Marquardt steps that lower a loss."""
        moved = np.array(poses.numbers)

        def run(first: int, last: int, fit: Any) -> None:
            fit_poses(self._fitting, loss, self._twists, moved, steps, first, last, fit)

        spread(run, len(moved), self._fit, least=8)
        return Poses(moved)

    def walked(
        self,
        poses: Poses,
        energies: FloatArray,
        floor: float,
        moves: int,
        *,
        kept: int,
        index: int,
    ) -> Chains:
        """Chains from C poses with energies (C,), after so many moves.

        floor: the limit that they stay below, or come down to. kept: states of each to keep.
        index: of the stream.
        """
        chains = chains_from(poses.numbers, energies, kept)
        if kept == 0 and (energies <= floor).all():
            return chains
        draws = MoveDraws(self._key.kernel_stream(Purpose.WALKS, index), moves)

        def run(first: int, last: int, walk: Any) -> None:
            walk_below(
                self._model, self.loss, self._stride, floor, chains, draws, first, last, walk
            )

        spread(run, len(poses), self.walk, least=2)
        return chains
