"""The relaxed cost (CHSEL, Eqs. 6 to 10) in torch, with the gradient that the paper defines."""

from __future__ import annotations

import numpy as np

try:
    import torch
    from torch import Tensor
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "RelaxedCost needs torch: pip install 'chsel-replay[torch]'", name="torch"
    ) from error

from chsel.cost.cost_settings import CostSettings, interior_points, warn_if_too_deep
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints, VoxelGrid, require_parts
from chsel.problem.poses import stacked
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid


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
        *,
        settings: CostSettings | None = None,
        free_resolution: float = 0.01,
    ) -> None:
        require_parts(sdf=sdf, points=points)
        self.sdf, self.points = sdf, points
        self.settings = settings = (settings or CostSettings()).of_object(sdf, free_resolution)
        self._free, self._occupied = _tensor(points.free), _tensor(points.occupied)
        self._known, self._known_sdf = _tensor(points.known), _tensor(points.sdf)
        self._is_interior = settings.free_term == "interior" and len(points.free) > 0
        if self._is_interior:
            interior = interior_points(sdf, settings)
            self._voxels = VoxelGrid.around(points.free, free_resolution)
            self._inside, self._normals = _tensor(interior.points), _tensor(interior.normals)
            self._weights = _tensor(interior.weights(settings, free_resolution))
        warn_if_too_deep(sdf, points.free, alpha=settings.alpha)
        deep = np.argwhere(sdf.values < settings.alpha)
        corners = (deep.min(axis=0) - 1, deep.max(axis=0) + 1) if len(deep) else (1, 0)
        # Free points outside of this box cost nothing.
        self._deep = [_tensor(sdf.origin + sdf.resolution * np.asarray(c)) for c in corners]

    @classmethod
    def of(cls, problem: RegistrationProblem, settings: CostSettings | None = None) -> RelaxedCost:
        """Return the cost that a problem's points define."""
        return cls(
            problem.sdf, problem.points, settings=settings, free_resolution=problem.free_resolution
        )

    def __call__(self, rotation: Tensor, translation: Tensor) -> Tensor:
        """Return costs (B,) of object_from_world rotations (B, 3, 3) and translations (B, 3)."""
        poses = zip(rotation.split(1), translation.split(1), strict=True)
        return torch.cat([translation[:0, 0], *(self._cost(*pose) for pose in poses)])

    def evaluate(self, object_from_world: FloatArray) -> FloatArray:
        """Return costs (B,) of transforms (B, 4, 4); infinite for one that is not finite."""
        transforms = stacked(object_from_world)
        with torch.no_grad():
            costs = self(_tensor(transforms[:, :3, :3]), _tensor(transforms[:, :3, 3])).numpy()
        costs[~np.isfinite(transforms[:, :3]).all(axis=(1, 2))] = np.inf
        return np.asarray(costs)

    def _cost(self, rotation: Tensor, translation: Tensor) -> Tensor:
        """Return the cost of one pose."""
        settings = self.settings
        x, s, n = self._read(rotation, translation, points=self._known)
        difference = s - self._known_sdf  # sum |s - v|, with gradient (s - v) n (Eq. 10)
        excess = (difference.abs() - settings.known_tolerance).clamp_min(0.0)
        known = settings.known_scale * self._sum(excess, torch.sign(difference), x=x, n=n)
        occupied = settings.occupied_scale * self._violation(
            rotation, translation, points=self._occupied, sign=1.0
        )
        if self._is_interior:
            return known + occupied + self._interior(rotation, translation)
        return (
            known
            + occupied
            + settings.free_scale
            * self._violation(
                rotation, translation, points=self._near(rotation, translation), sign=-1.0
            )
        )

    def _near(self, rotation: Tensor, translation: Tensor) -> Tensor:
        """Return the free points (N', 3) that may cost something at a pose."""
        with torch.no_grad():
            x = _moved(rotation[:, None], translation[:, None], points=self._free)
        return self._free[((x >= self._deep[0]) & (x <= self._deep[1])).all(dim=2).any(dim=0)]

    def _violation(
        self, rotation: Tensor, translation: Tensor, *, points: Tensor, sign: float
    ) -> Tensor:
        """Return sum max(0, alpha -+ s), with gradient -+ max(0, alpha -+ s) n (Eqs. 8 and 9)."""
        x, s, n = self._read(rotation, translation, points=points)
        violation = (self.settings.alpha + sign * s).clamp_min(0.0)
        return self._sum(violation, torch.full_like(s, sign), x=x, n=n)

    def _read(
        self, rotation: Tensor, translation: Tensor, *, points: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return moved points (B, N, 3), their signed distances (B, N) and gradients (B, N, 3)."""
        x = _moved(rotation[:, None], translation[:, None], points=points)
        settings = self.settings
        at = x.detach().numpy().reshape(-1, 3)
        s, n = self.sdf.at(at, lookup=settings.lookup, outside=settings.outside)
        return x, _tensor(s).reshape(x.shape[:2]), _tensor(n).reshape(x.shape)

    def _sum(self, violation: Tensor, side: Tensor, *, x: Tensor, n: Tensor) -> Tensor:
        """Return sums (B,) of violations (B, N) to a side, with the gradient of the settings."""
        is_exact = self.settings.gradient == "exact"
        slope = (violation > 0.0).double() if is_exact else violation
        return _with_gradient(violation, (slope * side)[..., None] * n, points=x).sum(dim=1)

    def _interior(self, rotation: Tensor, translation: Tensor) -> Tensor:
        """Return the free term over points inside the object: lambda sum_j o_j w_j.

        w_j = -s(m_j) for interior points m_j, o_j = 1 where m_j lies in a known free voxel. The
        gradient by the world point y_j is lambda o_j w_j R^T n_j: inwards, out of the free voxel.
        """
        back = rotation.transpose(1, 2)[:, None]
        voxels = self._voxels
        nothing = torch.zeros_like(translation)[:, None]
        shift = _moved(back, nothing, points=translation[:, None])
        y = _moved(back, -shift, points=self._inside)  # (B, M, 3): R^T m - R^T t
        index = np.rint((y.detach().numpy() - voxels.origin) * (1.0 / voxels.resolution))
        index = np.clip(np.nan_to_num(index), 0, np.array(voxels.flags.shape) - 1).astype(np.int64)
        weight = self._weights * torch.from_numpy(voxels.flags[tuple(np.moveaxis(index, -1, 0))])
        inwards = _moved(back.detach(), nothing, points=self._normals)
        return _with_gradient(weight, weight[..., None] * inwards, points=y).sum(dim=1)


def _tensor(array: FloatArray) -> Tensor:
    return torch.tensor(array, dtype=torch.float64)


def _moved(rotation: Tensor, translation: Tensor, *, points: Tensor) -> Tensor:
    """Return R x + t (..., 3), without a matrix product, whose order of additions may differ."""
    columns = [rotation[..., i] * points[..., i, None] for i in range(3)]
    return columns[0] + columns[1] + columns[2] + translation


def _with_gradient(values: Tensor, gradients: Tensor, *, points: Tensor) -> Tensor:
    """Return values (..., P), with given gradients (..., P, 3) by points (..., P, 3)."""
    moves = gradients.detach() * (points - points.detach())  # zero, but not their derivative
    return values.detach() + moves.sum(dim=-1)
