"""The relaxed cost (CHSEL, Eqs. 6 to 10) in torch, with the gradient that the paper defines."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import torch
from torch import Tensor

from chsel.cost.cost_settings import CostSettings
from chsel.cost.interior_points import interior_points
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints, VoxelGrid, require_parts
from chsel.problem.poses import stacked
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid

_PAIRS_AT_ONCE = 60_000  # of poses and points; more leave the processor's cache


class RelaxedCost:
    """C^(X) = lambda sum_free c_f + lambda sum_occupied c_o + sum_known c_k (CHSEL, Eq. 7).

    A function of rotations (B, 3, 3) and translations (B, 3) of object_from_world, float64 tensors
    on the processor. Built from numpy arrays and differentiable by torch: the gradient is the one
    that Eqs. 8 to 10 define, pushed through x~ = R x + t.

    The methods use CompiledCost, which is many times as fast and has the same bits on every
    machine.
    """

    def __init__(
        self,
        sdf: SdfGrid,
        points: KnownPoints,
        settings: CostSettings | None = None,
        *,
        free_resolution: float = 0.01,
    ) -> None:
        require_parts(sdf=sdf, points=points)
        self.sdf, self.points = sdf, points
        self.settings = settings = (settings or CostSettings()).of_object(sdf, free_resolution)
        self._world = {
            "free": _tensor(points.free if settings.free_term == "direct" else np.zeros((0, 3))),
            "occupied": _tensor(points.occupied),
            "known": _tensor(points.known),
        }
        self._known_sdf = _tensor(points.sdf)
        self._interior: _InteriorPoints | None = None
        deep = np.argwhere(sdf.values < settings.alpha)
        corners = (deep.min(axis=0) - 1, deep.max(axis=0) + 1) if len(deep) else (1, 0)
        # Free points outside of this box cost nothing.
        self._deep = [_tensor(sdf.origin + sdf.resolution * np.asarray(c)) for c in corners]
        if len(points.free) and not len(deep):
            warnings.warn(
                f"no node of the SDF is deeper than {-settings.alpha} m: free points cannot be "
                "violated; use a smaller penetration_tolerance",
                stacklevel=2,
            )
        if len(points.free) and settings.free_term == "interior":
            self._interior = _InteriorPoints(sdf, points.free, free_resolution, settings)
        interior = 0 if self._interior is None else len(self._interior.points)
        pairs = max(1, interior + sum(map(len, self._world.values())))
        self._poses_at_once = max(1, _PAIRS_AT_ONCE // pairs)

    @classmethod
    def of(cls, problem: RegistrationProblem, settings: CostSettings | None = None) -> RelaxedCost:
        """The cost that a problem's points define."""
        return cls(problem.sdf, problem.points, settings, free_resolution=problem.free_resolution)

    def __call__(self, rotation: Tensor, translation: Tensor) -> Tensor:
        """Costs (B,) of object_from_world rotations (B, 3, 3) and translations (B, 3)."""
        cost: Tensor = _InBatches.apply(rotation, translation, self)
        return cost

    def evaluate(self, object_from_world: FloatArray) -> FloatArray:
        """Costs (B,) of transforms (B, 4, 4); infinite for one that is not finite."""
        transforms = stacked(object_from_world)
        batches = _tensor(transforms).split(self._poses_at_once)
        with torch.no_grad():
            costs = torch.cat([self.of_batch(b[:, :3, :3], b[:, :3, 3]) for b in batches]).numpy()
        costs[~np.isfinite(transforms[:, :3]).all(axis=(1, 2))] = np.inf
        return np.asarray(costs)

    def of_batch(self, rotation: Tensor, translation: Tensor) -> Tensor:
        """The same, of a few poses, as torch differentiates it."""
        settings = self.settings
        lookup, outside = settings.lookup, settings.outside
        total = 0.0 * (rotation[:, 0, 0] + translation[:, 0])
        for name, scale in (
            ("free", settings.free_scale),
            ("occupied", settings.occupied_scale),
            ("known", settings.known_scale),
        ):
            points = self._world[name]
            pose, point = self._pairs(rotation, translation, points, can_be_far=name != "free")
            local = _moved(rotation[pose], translation[pose], points[point])  # (Q, 3)
            s, n = map(_tensor, self.sdf.at(local.detach().numpy(), lookup=lookup, outside=outside))
            if name == "known":  # sum |s - v|, with gradient (s - v) n (Eq. 10)
                s = s - self._known_sdf[point]
                violation, side = s.abs() - settings.known_tolerance, torch.sign(s)
            else:  # sum max(0, alpha -+ s), with gradient -+ max(0, alpha -+ s) n (Eqs. 8 and 9)
                sign = -1.0 if name == "free" else 1.0
                violation, side = settings.alpha + sign * s, torch.full_like(s, sign)
            violation = violation.clamp_min(0.0)
            slope = (violation > 0.0).double() if settings.gradient == "exact" else violation
            values = scale * _with_gradient(violation, (slope * side)[:, None] * n, local)
            total = total.index_add(0, pose, values)
        if self._interior is not None:
            total = total + self._interior.cost(rotation, translation)
        return total

    def _pairs(
        self, rotation: Tensor, translation: Tensor, points: Tensor, *, can_be_far: bool
    ) -> tuple[Tensor, Tensor]:
        """Indices (Q,) of poses and of points, pose by pose; without points that cost nothing.

        can_be_far: points far from the object cost something, too.
        """
        if can_be_far:
            pairs = torch.ones((len(rotation), len(points)), dtype=torch.bool)
        else:
            with torch.no_grad():
                local = points @ rotation.transpose(1, 2) + translation[:, None]
            pairs = ((local >= self._deep[0]) & (local <= self._deep[1])).all(dim=2)
        pose, point = pairs.nonzero(as_tuple=True)
        return pose, point


class _InteriorPoints:
    """The free term over points inside the object: lambda sum_j o_j w_j.

    w_j = -s(m_j) for interior points m_j, o_j = 1 where m_j lies in a known free voxel. The
    gradient by the world point y_j is lambda o_j w_j R^T n_j: inwards, out of the free voxel.
    """

    def __init__(
        self, sdf: SdfGrid, free: FloatArray, free_resolution: float, settings: CostSettings
    ) -> None:
        interior = interior_points(sdf, settings)
        voxels = VoxelGrid.around(free, free_resolution)
        self.points = _tensor(interior.points)  # (M, 3)
        self._weight = _tensor(interior.weights(settings, free_resolution))
        self._normal = _tensor(interior.normals)
        self._is_free = torch.from_numpy(voxels.flags)
        self._origin, self._inverse = _tensor(voxels.origin), 1.0 / voxels.resolution

    def cost(self, rotation: Tensor, translation: Tensor) -> Tensor:
        """The term (B,) for B poses."""
        back = rotation.transpose(1, 2)
        nothing = torch.zeros_like(translation)
        world = _moved(  # (B, M, 3): R^T m - R^T t
            back[:, None], -_moved(back, nothing, translation)[:, None], self.points
        )
        last = torch.tensor(self._is_free.shape) - 1
        index = torch.round((world.detach() - self._origin) * self._inverse).to(torch.int64)
        i, j, k = torch.minimum(index.clamp_min(0), last).unbind(dim=2)
        weight = self._weight * self._is_free[i, j, k]  # (B, M)
        inwards = _moved(back[:, None].detach(), nothing[:, None], self._normal)
        return _with_gradient(weight, weight[..., None] * inwards, world).sum(dim=1)


def _tensor(array: FloatArray) -> Tensor:
    return torch.tensor(array, dtype=torch.float64)


def _moved(rotation: Tensor, translation: Tensor, points: Tensor) -> Tensor:
    """R x + t (..., 3), without a matrix product, whose order of additions may differ."""
    columns = [rotation[..., i] * points[..., i, None] for i in range(3)]
    return columns[0] + columns[1] + columns[2] + translation


def _with_gradient(values: Tensor, gradients: Tensor, points: Tensor) -> Tensor:
    """Values (..., P), with given gradients (..., P, 3) by points (..., P, 3)."""
    moves = gradients.detach() * (points - points.detach())  # zero, but not their derivative
    return values.detach() + moves.sum(dim=-1)


class _InBatches(torch.autograd.Function):
    """The cost of a batch of poses after the other, and its gradient at once, to save memory."""

    @staticmethod
    def forward(ctx: Any, rotation: Tensor, translation: Tensor, cost: RelaxedCost) -> Tensor:
        values, slopes, size = [], [], cost._poses_at_once
        for some in zip(rotation.split(size), translation.split(size), strict=True):
            leaves = tuple(part.detach().requires_grad_() for part in some)
            with torch.enable_grad():
                value = cost.of_batch(*leaves)
                slopes.append(torch.autograd.grad(value.sum(), leaves))
            values.append(value.detach())
        ctx.save_for_backward(*(torch.cat(parts) for parts in zip(*slopes, strict=True)))
        return torch.cat(values)

    @staticmethod
    def backward(ctx: Any, by_value: Tensor) -> tuple[Tensor, Tensor, None]:
        by_rotation, by_translation = ctx.saved_tensors
        return by_value[:, None, None] * by_rotation, by_value[:, None] * by_translation, None
