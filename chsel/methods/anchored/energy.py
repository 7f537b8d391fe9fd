"""The energy of poses, fits that lower it, and random walks below a limit."""

from __future__ import annotations

from typing import Any

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_settings import CostSettings
from chsel.cost.objective import Objective
from chsel.methods.anchored.fit_kernels import Twists, fit_for, fit_poses, surrounding_for
from chsel.methods.anchored.walk_kernels import (
    DRAWS,
    Chains,
    Stride,
    chains_from,
    energies_below,
    walk_below,
)
from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import triple
from chsel.numerics.threads import spread
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.search_space import SE2Space, SearchSpace
from chsel.problem.streams import Purpose
from chsel.problem.surface import object_centre

_FIT_LEVEL = -0.003  # metres: free points at less depth do not push
_LEVER = 0.15  # metres that a radian counts for
_BLOCK = 512  # chains whose moves are drawn at a time


class Energy:
    """E(X) = mean |s - v| over known points + sum max(0, -tau - s) over free ones, in metres.

    The same above tau for occupied points. It is the relaxed cost (CHSEL, Eq. 7) with other
    weights and alpha = -tau, interpolated.
    """

    def __init__(
        self,
        problem: RegistrationProblem,
        known: KnownPoints,
        space: SearchSpace,
        tolerance: float,
        bounds: tuple[FloatArray, FloatArray],
    ) -> None:
        """known: the problem's points, see most_informative_first. tolerance: tau, metres.

        bounds: where walks keep the object's origin.
        """
        sdf = problem.sdf
        settings = CostSettings(
            penetration_tolerance=-tolerance,
            free_scale=1.0,
            occupied_scale=1.0,
            known_scale=1.0 / max(len(known.known), 1),
            gradient="exact",
        )
        resolution = problem.free_resolution
        cost = CompiledCost(sdf, known, settings, free_resolution=resolution, culling="octree")
        self.objective = Objective(cost, space)
        self._model = cost.model
        self._fitting = cost.at_level(sdf, _FIT_LEVEL - tolerance)
        self._key = problem.key
        basis, axis = np.eye(6), (0.0, 0.0, 0.0)
        if isinstance(space, SE2Space):
            basis, axis = np.zeros((3, 6)), triple(space.axis)
            basis[0, :3], basis[1, 3:], basis[2, 3:] = space.axis, space.e_u, space.e_v
        basis[:, :3] /= _LEVER
        centre = triple(object_centre(sdf))
        self._twists = Twists(basis, centre)
        self._stride = Stride(
            planar=isinstance(space, SE2Space),
            axis=axis,
            pivot=centre,
            lower=triple(bounds[0]),
            upper=triple(bounds[1]),
        )

    def of(self, poses: Poses) -> FloatArray:
        """Energies (B,) of poses."""
        energies = np.empty(len(poses))

        def run(first: int, last: int, near: Any) -> None:
            energies_below(self._model, poses.numbers, np.inf, energies, first, last, near)

        spread(run, len(poses), lambda: surrounding_for(self._model), least=50)
        return energies

    def fitted(self, poses: Poses, steps: int) -> Poses:
        """Poses after at most so many Levenberg-Marquardt steps."""
        moved = np.array(poses.numbers)

        def run(first: int, last: int, fit: Any) -> None:
            fit_poses(self._fitting, self._twists, moved, steps, first, last, fit)

        dimension = len(self._twists.basis)
        spread(run, len(moved), lambda: fit_for(self._fitting, dimension), least=8)
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
        stream = self._key.stream(Purpose.WALKS, index)

        def run(first: int, last: int, near: Any) -> None:
            walk_below(self._model, self._stride, floor, block, draws, first, last, near)

        for before in range(0, len(poses), _BLOCK):
            block = Chains._make(part[before : before + _BLOCK] for part in chains)
            draws = stream.random((len(block.poses), moves, DRAWS), dtype=np.float32)
            spread(run, len(draws), lambda: surrounding_for(self._model), least=2)
        return chains
