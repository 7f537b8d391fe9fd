"""The relaxed cost of a pose (CHSEL, Eqs. 6 to 10), with the gradient that the paper defines."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from chsel.arrays import FloatArray
from chsel.errors import SettingError, require_choice, require_positive
from chsel.points import KnownPoints, Lattice
from chsel.pose import as_tensor
from chsel.problem import RegistrationProblem
from chsel.sdf import LOOKUPS, OUTSIDE, SdfGrid

FREE_TERMS = ("direct", "interior")
GRADIENTS = ("defined", "exact")
FEW_INTERIOR_POINTS = 25
_PAIRS_AT_ONCE = 2_000_000
_MAX_VOXELS = 100_000_000


@dataclass(frozen=True)
class CostSettings:
    """Settings of the relaxed cost, with the paper's symbols.

    penetration_tolerance: alpha, the level (metres, negative) that free points may reach.
    free_scale, occupied_scale: lambda. known_scale: weight of known-SDF points.
    free_term: "direct" sums over free points as Eq. 8 does; "interior" sums over points inside
    the object that fall into free voxels, as the authors' experiments did.
    interior_spacing: of those points, metres; by default |alpha|. volume_normalise: weigh them by
    the volume they stand for in free voxels. known_tolerance: dead band of known-SDF points,
    metres. lookup, outside: how the SDF grid is read, see SdfGrid.query. gradient: "defined"
    is violation times normal (Eqs. 8 to 10); "exact" is the derivative of the value.
    """

    penetration_tolerance: float = -0.01
    free_scale: float = 20.0
    occupied_scale: float = 20.0
    known_scale: float = 1.0
    free_term: str = "direct"
    interior_spacing: float | None = None
    volume_normalise: bool = False
    known_tolerance: float = 0.0
    lookup: str = "trilinear"
    outside: str = "surface_point"
    gradient: str = "defined"

    def __post_init__(self) -> None:
        if not -10.0 < self.penetration_tolerance <= 0.0:
            raise SettingError(
                f"penetration_tolerance is {self.penetration_tolerance}; accepted: at most 0 (m)"
            )
        for name in ("free_scale", "occupied_scale", "known_scale", "known_tolerance"):
            require_positive(name, getattr(self, name), zero=True)
        if self.interior_spacing is not None:
            require_positive("interior_spacing", self.interior_spacing)
        require_choice("free_term", self.free_term, FREE_TERMS)
        require_choice("lookup", self.lookup, LOOKUPS)
        require_choice("outside", self.outside, OUTSIDE)
        require_choice("gradient", self.gradient, GRADIENTS)
        if self.free_term == "interior" and self.gradient == "exact":
            raise SettingError(
                "gradient is exact with free_term interior, whose value is piecewise constant; "
                "accepted: gradient defined, or free_term direct"
            )


@dataclass(frozen=True)
class Part:
    """A term of the cost for B poses: value (B,), gradient by R (B, 3, 3) and by t (B, 3)."""

    value: Tensor
    by_rotation: Tensor
    by_translation: Tensor

    def __add__(self, other: Part) -> Part:
        return Part(
            self.value + other.value,
            self.by_rotation + other.by_rotation,
            self.by_translation + other.by_translation,
        )


class RelaxedCost:
    """C^(X) = lambda sum_free c_f + lambda sum_occupied c_o + sum_known c_k (CHSEL, Eq. 7).

    A function of rotations (B, 3, 3) and translations (B, 3) of object_from_world; B may differ
    from call to call, and no pose's cost depends on the others. Built from numpy arrays and
    differentiable by torch: the gradient is the one that Eqs. 8 to 10 define, pushed through
    x~ = R x + t.
    """

    def __init__(
        self,
        sdf: SdfGrid,
        points: KnownPoints,
        settings: CostSettings | None = None,
        *,
        free_resolution: float = 0.01,
    ) -> None:
        self.settings = settings or CostSettings()
        self.sdf = sdf
        self.points = points
        self._free = as_tensor(points.free)
        self._free_columns = as_tensor(points.free.T.copy())
        self._occupied = as_tensor(points.occupied)
        self._known = as_tensor(points.known)
        self._known_sdf = as_tensor(points.sdf)
        self._active = sdf.active_cells(self.settings.penetration_tolerance, self.settings.lookup)
        if len(points.free) and not bool(self._active.any()):
            warnings.warn(
                f"no node of the SDF is deeper than {-self.settings.penetration_tolerance} m: free "
                "points cannot be violated; use a smaller penetration_tolerance",
                stacklevel=2,
            )
        self._interior: _InteriorPoints | None = None
        if self.settings.free_term == "interior" and len(points.free):
            self._interior = _InteriorPoints(sdf, points.free, free_resolution, self.settings)

    @classmethod
    def of(cls, problem: RegistrationProblem, settings: CostSettings | None = None) -> RelaxedCost:
        """The cost that a problem's points define."""
        free_resolution = problem.free_resolution
        return cls(problem.sdf, problem.points, settings, free_resolution=free_resolution)

    def __call__(self, rotation: Tensor, translation: Tensor) -> Tensor:
        """Costs (B,) of object_from_world rotations (B, 3, 3) and translations (B, 3)."""
        cost: Tensor = _DefinedGradient.apply(rotation, translation, self)
        return cost

    def evaluate(self, object_from_world: FloatArray) -> FloatArray:
        """Costs (B,) of transforms (B, 4, 4)."""
        transforms = torch.tensor(np.asarray(object_from_world), dtype=torch.float64)
        with torch.no_grad():
            return self(transforms[:, :3, :3], transforms[:, :3, 3]).numpy()

    def terms(self, rotation: Tensor, translation: Tensor) -> dict[str, Part]:
        """The weighted terms "free", "occupied" and "known" for B poses."""
        size = max(1, _PAIRS_AT_ONCE // max(1, self._points_per_pose))
        chunks = zip(rotation.split(size), translation.split(size), strict=True)
        parts = [
            (self._free_part(r, t), self._occupied_part(r, t), self._known_part(r, t))
            for r, t in chunks
        ]
        names = ("free", "occupied", "known")
        return {name: _joined([part[i] for part in parts]) for i, name in enumerate(names)}

    @property
    def _points_per_pose(self) -> int:
        interior = 0 if self._interior is None else len(self._interior.points)
        return max(len(self._free), len(self._occupied), len(self._known), interior)

    def _free_part(self, rotation: Tensor, translation: Tensor) -> Part:
        """lambda sum max(0, alpha - s), with gradient -lambda max(0, alpha - s) n."""
        if self._interior is not None:
            return self._interior.part(rotation, translation)
        if len(self._free) == 0:
            return _zero(len(rotation))
        moved, point, counts = self._free_in_active_cells(rotation, translation)
        s, n = self._query(moved)
        violation = (self.settings.penetration_tolerance - s).clamp_min(0.0)
        size = violation if self.settings.gradient == "defined" else (violation > 0.0).double()
        scale = self.settings.free_scale
        gradient = -scale * size[:, None] * n
        columns = [(scale * violation)[:, None], gradient]
        columns += [gradient[:, i : i + 1] * self._free[point] for i in range(3)]
        sums = _sum_by_pose(torch.cat(columns, dim=1), counts)
        return Part(sums[:, 0], sums[:, 4:].reshape(-1, 3, 3), sums[:, 1:4])

    def _free_in_active_cells(
        self, rotation: Tensor, translation: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The pairs of pose and free point that can be violated, pose by pose.

        Moved points (P, 3), indices of their free points (P,), and pairs per pose (B,). Exact:
        every point left out reads only SDF nodes at or above alpha.
        """
        x, y, z = self._free_columns
        moved = [  # three times (B, N): a third of the time that (B, N, 3) takes
            rotation[:, i, 0:1] * x
            + rotation[:, i, 1:2] * y
            + rotation[:, i, 2:3] * z
            + translation[:, i : i + 1]
            for i in range(3)
        ]
        first, last = self.sdf.bounds
        near = torch.ones_like(moved[0], dtype=torch.bool)
        for i in range(3):
            near &= (moved[i] >= first[i]) & (moved[i] <= last[i])
        pairs = near.reshape(-1).nonzero()[:, 0]
        points = torch.stack([column.reshape(-1)[pairs] for column in moved], dim=1)
        active = self._active[self.sdf.cells(points, self.settings.lookup)]
        pairs = pairs[active]
        counts = torch.bincount(pairs // len(x), minlength=len(rotation))
        return points[active], pairs % len(x), counts

    def _occupied_part(self, rotation: Tensor, translation: Tensor) -> Part:
        """lambda sum max(0, alpha + s), with gradient lambda max(0, alpha + s) n."""
        if len(self._occupied) == 0:
            return _zero(len(rotation))
        s, n = self._query_all(_move(rotation, translation, self._occupied))
        violation = (self.settings.penetration_tolerance + s).clamp_min(0.0)
        size = violation if self.settings.gradient == "defined" else (violation > 0.0).double()
        scale = self.settings.occupied_scale
        return _dense_part(scale * violation, scale * size[..., None] * n, self._occupied)

    def _known_part(self, rotation: Tensor, translation: Tensor) -> Part:
        """sum |s - v|, with gradient (s - v) n."""
        if len(self._known) == 0:
            return _zero(len(rotation))
        s, n = self._query_all(_move(rotation, translation, self._known))
        difference = s - self._known_sdf
        excess = (difference.abs() - self.settings.known_tolerance).clamp_min(0.0)
        signed = excess * torch.sign(difference)
        size = signed if self.settings.gradient == "defined" else torch.sign(signed)
        scale = self.settings.known_scale
        return _dense_part(scale * excess, scale * size[..., None] * n, self._known)

    def _query(self, points: Tensor) -> tuple[Tensor, Tensor]:
        lookup, outside = self.settings.lookup, self.settings.outside
        return self.sdf.query(points, lookup=lookup, outside=outside)

    def _query_all(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """SDF (B, N) and gradients (B, N, 3) at points (B, N, 3)."""
        s, n = self._query(points.reshape(-1, 3))
        return s.reshape(points.shape[:2]), n.reshape(points.shape)


class _InteriorPoints:
    """The free term over points inside of the object: lambda sum_j o_j w_j.

    w_j = -s(m_j) for interior points m_j, o_j = 1 where m_j falls into a known free voxel. The
    gradient by the world point y_j is lambda o_j w_j R^T n_j: inwards, out of the free voxel.
    """

    def __init__(
        self, sdf: SdfGrid, free: FloatArray, free_resolution: float, settings: CostSettings
    ) -> None:
        alpha = settings.penetration_tolerance
        spacing = settings.interior_spacing or max(-alpha, sdf.resolution / 4)
        lower, upper = sdf.bounds
        counts = np.floor((upper - lower) / spacing).astype(int) + 1
        nodes = lower + np.indices(counts).reshape(3, -1).T * spacing
        s, n = sdf.query(nodes, lookup=settings.lookup, outside=settings.outside)
        inside = s < alpha
        if not bool(inside.any()):
            raise SettingError(
                f"free_term interior finds no point deeper than {-alpha} m; accepted: "
                "a penetration_tolerance nearer to 0, or free_term direct"
            )
        if int(inside.sum()) < FEW_INTERIOR_POINTS:
            warnings.warn(
                f"free_term interior uses {int(inside.sum())} points; a finer interior_spacing "
                f"than {spacing} m describes the object better",
                stacklevel=3,
            )
        scale = settings.free_scale
        if settings.volume_normalise:
            scale *= (spacing / free_resolution) ** 3
        self.points = as_tensor(nodes)[inside]
        self._weight = -scale * s[inside]
        self._normal = n[inside]
        self._build_voxels(free, free_resolution)

    def _build_voxels(self, free: FloatArray, resolution: float) -> None:
        lattice = Lattice(tuple(free.min(axis=0).tolist()), resolution)
        voxels = lattice.voxels(free)
        shape = voxels.max(axis=0) + 1
        if np.prod(shape, dtype=float) > _MAX_VOXELS:
            raise SettingError(
                f"free points span {np.prod(shape, dtype=float):.1e} voxels of {resolution} m; "
                f"accepted: at most {_MAX_VOXELS:.0e}, so a coarser free_resolution"
            )
        # One layer of unknown voxels around, onto which everything outside is clamped.
        grid = np.zeros(shape + 2, dtype=bool)
        grid[tuple((voxels + 1).T)] = True
        self._is_free = torch.from_numpy(grid.reshape(-1))
        self._shape = torch.tensor(grid.shape)
        self._origin = as_tensor(lattice.origin)
        self._resolution = resolution

    def part(self, rotation: Tensor, translation: Tensor) -> Part:
        """The term for B poses."""
        back = rotation.transpose(1, 2)
        local = self.points - translation[:, None]  # (B, M, 3): y = R^T (m - t)
        world = _move(back, torch.zeros_like(translation), local)
        index = torch.round((world - self._origin) / self._resolution).to(torch.int64) + 1
        index = torch.minimum(index.clamp_min(0), self._shape - 1)
        flat = (index[..., 0] * self._shape[1] + index[..., 1]) * self._shape[2] + index[..., 2]
        weight = torch.where(self._is_free[flat], self._weight, 0.0)  # (B, M)
        pull = weight[..., None] * self._normal  # R dC/dy
        by_world = _move(back, torch.zeros_like(translation), pull)
        by_rotation = torch.stack(
            [(local[..., i : i + 1] * by_world).sum(dim=1) for i in range(3)], dim=1
        )
        return Part(weight.sum(dim=1), by_rotation, -pull.sum(dim=1))


class _DefinedGradient(torch.autograd.Function):
    """Returns the value forward and the gradient that the terms define backward."""

    @staticmethod
    def forward(ctx: Any, rotation: Tensor, translation: Tensor, cost: RelaxedCost) -> Tensor:
        terms = cost.terms(rotation.detach(), translation.detach())
        total = terms["free"] + terms["occupied"] + terms["known"]
        ctx.save_for_backward(total.by_rotation, total.by_translation)
        return total.value

    @staticmethod
    def backward(ctx: Any, by_value: Tensor) -> tuple[Tensor, Tensor, None]:
        by_rotation, by_translation = ctx.saved_tensors
        return by_value[:, None, None] * by_rotation, by_value[:, None] * by_translation, None


def _move(rotation: Tensor, translation: Tensor, points: Tensor) -> Tensor:
    """R x + t: points (N, 3) or (B, N, 3) under B poses, (B, N, 3).

    Written out, as a matrix product adds in an order that depends on the machine.
    """
    points = points if points.dim() == 3 else points[None]
    columns = [rotation[:, None, :, i] * points[..., i : i + 1] for i in range(3)]
    return columns[0] + columns[1] + columns[2] + translation[:, None]


def _dense_part(value: Tensor, gradient: Tensor, points: Tensor) -> Part:
    """Sum values (B, N) and object-frame gradients (B, N, 3) at world points (N, 3)."""
    rows = [(gradient[..., i : i + 1] * points).sum(dim=1) for i in range(3)]
    return Part(value.sum(dim=1), torch.stack(rows, dim=1), gradient.sum(dim=1))


def _sum_by_pose(rows: Tensor, counts: Tensor) -> Tensor:
    """Sums (B, C) of consecutive rows (P, C), counts (B,) of them per pose, in order."""
    if len(rows) == 0:
        return torch.zeros((len(counts), rows.shape[1]), dtype=torch.float64)
    return torch.segment_reduce(rows, "sum", lengths=counts, axis=0)


def _zero(count: int) -> Part:
    zeros = torch.zeros(count, dtype=torch.float64)
    return Part(zeros, zeros.new_zeros((count, 3, 3)), zeros.new_zeros((count, 3)))


def _joined(parts: list[Part]) -> Part:
    if not parts:
        return _zero(0)
    return Part(
        torch.cat([part.value for part in parts]),
        torch.cat([part.by_rotation for part in parts]),
        torch.cat([part.by_translation for part in parts]),
    )
