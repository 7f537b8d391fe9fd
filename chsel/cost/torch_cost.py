"""The relaxed cost of a pose (CHSEL, Eqs. 6 to 10), with the gradient that the paper defines."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from chsel.cost.cost_settings import CostSettings
from chsel.cost.interior_points import VoxelGrid, interior_points, interior_spacing
from chsel.cost.torch_octree import FreeTree
from chsel.errors import EngineError, require_positive
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints
from chsel.problem.poses import as_tensor, moved, stacked
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid


def gpus() -> int:
    """How many GPUs torch finds here."""
    return torch.cuda.device_count() if torch.cuda.is_available() else 0


def device_named(name: str) -> torch.device:
    """The device "cpu", "cuda" (the GPU that torch uses at present) or "cuda:N".

    Raises EngineError, with what is accepted here, for any other.
    """
    count = gpus()
    accepted = ["cpu", *(["cuda"] if count else []), *(f"cuda:{n}" for n in range(count))]
    if name == "cuda" and count:
        return torch.device("cuda", torch.cuda.current_device())
    if name in accepted:
        return torch.device(name)
    found = f"{count} GPU{'s' * (count > 1)}" if count else "no GPU"
    but = f", but torch finds {found} here" if str(name).startswith("cuda") else ""
    raise EngineError(f"device is {name}{but}; accepted: {', '.join(accepted)}")


_PAIRS_ON_CPU = 60_000
_PAIRS_ON_GPU = 4_000_000


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

    Take it for gradients by torch, and with device "cuda" for the costs of 10^5 poses and more.
    CompiledCost is what the methods take: on a processor it is 20 to 35 times as fast, and its
    bits are the same on every machine. Here they are the same in every run on one device, and in
    any batch there: sums run in a fixed order. Between devices, costs agree to a relative 1e-9.

    pairs_at_once: how many pairs of pose and point are worked on together, at 250 to 400 bytes
    each; one pose is never divided. By default 60 000 on a processor, for its cache, and 4 million
    on a GPU, at most 1.6 GB of its memory.
    Raises EngineError for a device that is not here.
    """

    def __init__(
        self,
        sdf: SdfGrid,
        points: KnownPoints,
        settings: CostSettings | None = None,
        *,
        free_resolution: float = 0.01,
        device: str = "cpu",
        pairs_at_once: int | None = None,
    ) -> None:
        self.settings = settings = settings or CostSettings()
        self.sdf = sdf
        self.points = points
        self.device = device_named(device)
        if pairs_at_once is None:
            pairs_at_once = _PAIRS_ON_CPU if self.device.type == "cpu" else _PAIRS_ON_GPU
        require_positive("pairs_at_once", pairs_at_once)
        self.pairs_at_once = pairs_at_once
        self._occupied = as_tensor(points.occupied, self.device)
        self._known = as_tensor(points.known, self.device)
        self._known_sdf = as_tensor(points.sdf, self.device)
        self._tree: FreeTree | None = None
        self._interior: _InteriorPoints | None = None
        if len(points.free):
            self._look_at_free(points.free, free_resolution)

    def _look_at_free(self, free: FloatArray, free_resolution: float) -> None:
        sdf, settings = self.sdf, self.settings
        alpha, lookup = settings.penetration_tolerance, settings.lookup
        if not bool(sdf.active_cells(alpha, lookup).any()):
            warnings.warn(
                f"no node of the SDF is deeper than {-alpha} m: free points cannot be violated; "
                "use a smaller penetration_tolerance",
                stacklevel=3,
            )
        if settings.free_term == "interior":
            self._interior = _InteriorPoints(sdf, free, free_resolution, settings, self.device)
        else:
            self._tree = FreeTree(sdf, free, free_resolution, alpha, lookup, self.device)

    @classmethod
    def of(
        cls,
        problem: RegistrationProblem,
        settings: CostSettings | None = None,
        *,
        device: str = "cpu",
    ) -> RelaxedCost:
        """The cost that a problem's points define."""
        resolution = problem.free_resolution
        return cls(problem.sdf, problem.points, settings, free_resolution=resolution, device=device)

    def __call__(self, rotation: Tensor, translation: Tensor) -> Tensor:
        """Costs (B,) of object_from_world rotations (B, 3, 3) and translations (B, 3)."""
        for tensor in (rotation, translation):
            if tensor.device != self.device:
                raise EngineError(
                    f"poses are on {tensor.device}, the cost is on {self.device}; accepted: equal"
                )
        cost: Tensor = _DefinedGradient.apply(rotation, translation, self)
        return cost

    def evaluate(self, object_from_world: FloatArray) -> FloatArray:
        """Costs (B,) of transforms (B, 4, 4); infinite for one that is not finite."""
        transforms = stacked(object_from_world)
        costs, size = np.empty(len(transforms)), self._poses_at_once
        for first in range(0, len(transforms), size):
            some = as_tensor(transforms[first : first + size], self.device)
            with torch.no_grad():
                costs[first : first + size] = self(some[:, :3, :3], some[:, :3, 3]).cpu().numpy()
        costs[~np.isfinite(transforms[:, :3]).all(axis=(1, 2))] = np.inf
        return costs

    def terms(self, rotation: Tensor, translation: Tensor) -> dict[str, Part]:
        """The weighted terms "free", "occupied" and "known" for B poses."""
        size = self._poses_at_once
        chunks = zip(rotation.split(size), translation.split(size), strict=True)
        parts = [
            (self._free_part(r, t), self._occupied_part(r, t), self._known_part(r, t))
            for r, t in chunks
        ]
        names = ("free", "occupied", "known")
        return {name: _joined([part[i] for part in parts]) for i, name in enumerate(names)}

    @property
    def _poses_at_once(self) -> int:
        free = 0 if self._tree is None else self._tree.usual
        interior = 0 if self._interior is None else len(self._interior.points)
        most = max(1, free, interior, len(self._occupied), len(self._known))
        return max(1, self.pairs_at_once // most)

    def _free_part(self, rotation: Tensor, translation: Tensor) -> Part:
        """lambda sum max(0, alpha - s), with gradient -lambda max(0, alpha - s) n."""
        if self._interior is not None:
            return self._interior.part(rotation, translation)
        if self._tree is None:
            return _zero(rotation)
        found = self._tree.violated(rotation, translation, self.pairs_at_once)
        if found is None:
            half = -(-len(rotation) // 2)
            halves = zip(rotation.split(half), translation.split(half), strict=True)
            return _joined([self._free_part(r, t) for r, t in halves])
        pose, world, points = found
        s, n = self._query(points)
        violation = (self.settings.penetration_tolerance - s).clamp_min(0.0)
        size = violation if self.settings.gradient == "defined" else (violation > 0.0).double()
        scale = self.settings.free_scale
        gradient = -scale * size[:, None] * n
        return _sum_by_pose(rotation, pose, scale * violation, gradient, gradient, world)

    def _occupied_part(self, rotation: Tensor, translation: Tensor) -> Part:
        """lambda sum max(0, alpha + s), with gradient lambda max(0, alpha + s) n."""
        if len(self._occupied) == 0:
            return _zero(rotation)
        pose, world, points = _all_pairs(rotation, translation, self._occupied)
        s, n = self._query(points)
        violation = (self.settings.penetration_tolerance + s).clamp_min(0.0)
        size = violation if self.settings.gradient == "defined" else (violation > 0.0).double()
        scale = self.settings.occupied_scale
        gradient = scale * size[:, None] * n
        return _sum_by_pose(rotation, pose, scale * violation, gradient, gradient, world)

    def _known_part(self, rotation: Tensor, translation: Tensor) -> Part:
        """sum |s - v|, with gradient (s - v) n."""
        if len(self._known) == 0:
            return _zero(rotation)
        pose, world, points = _all_pairs(rotation, translation, self._known)
        s, n = self._query(points)
        difference = s - self._known_sdf.repeat(len(rotation))
        excess = (difference.abs() - self.settings.known_tolerance).clamp_min(0.0)
        signed = excess * torch.sign(difference)
        size = signed if self.settings.gradient == "defined" else torch.sign(signed)
        scale = self.settings.known_scale
        gradient = scale * size[:, None] * n
        return _sum_by_pose(rotation, pose, scale * excess, gradient, gradient, world)

    def _query(self, points: Tensor) -> tuple[Tensor, Tensor]:
        lookup, outside = self.settings.lookup, self.settings.outside
        return self.sdf.query(points, lookup=lookup, outside=outside)


class _InteriorPoints:
    """The free term over points inside of the object: lambda sum_j o_j w_j.

    w_j = -s(m_j) for interior points m_j, o_j = 1 where m_j falls into a known free voxel. The
    gradient by the world point y_j is lambda o_j w_j R^T n_j: inwards, out of the free voxel.
    """

    def __init__(
        self,
        sdf: SdfGrid,
        free: FloatArray,
        free_resolution: float,
        settings: CostSettings,
        device: torch.device,
    ) -> None:
        interior = interior_points(sdf, settings)
        voxels = VoxelGrid.around(free, free_resolution)
        scale = settings.free_scale
        if settings.volume_normalise:
            scale *= (interior_spacing(sdf, settings) / free_resolution) ** 3
        self.points = as_tensor(interior.points, device)  # (M, 3)
        self._weight = as_tensor(scale * interior.depth, device)
        self._normal = as_tensor(interior.normals, device)
        self._is_free = torch.from_numpy(voxels.flags.reshape(-1)).to(device)
        self._counts = voxels.flags.shape
        self._last = torch.tensor(voxels.flags.shape).to(device) - 1
        self._origin = as_tensor(voxels.origin, device)
        self._inverse = 1.0 / voxels.resolution

    def part(self, rotation: Tensor, translation: Tensor) -> Part:
        """The term for B poses."""
        back, nothing = rotation.transpose(1, 2), torch.zeros_like(translation)
        start = -moved(back, nothing, translation)
        world = moved(back[:, None], start[:, None], self.points)  # (B, M, 3): R^T m - R^T t
        index = torch.round((world - self._origin) * self._inverse).to(torch.int64)
        i, j, k = torch.minimum(index.clamp_min(0), self._last).unbind(dim=2)
        _, ny, nz = self._counts
        flat = (i * ny + j) * nz + k
        pose, point = self._is_free[flat].nonzero(as_tuple=True)
        weight = self._weight[point]
        pull = weight[:, None] * self._normal[point]  # R dC/dy
        local = self.points[point] - translation[pose]
        by_world = moved(back[pose], nothing[pose], pull)
        return _sum_by_pose(rotation, pose, weight, -pull, local, by_world)


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


def _all_pairs(
    rotation: Tensor, translation: Tensor, points: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """All pairs of B poses and points (N, 3): the pose (B N,), the points, and them moved."""
    count = len(rotation)
    pose = torch.arange(count, device=points.device).repeat_interleave(len(points))
    there = moved(rotation[:, None], translation[:, None], points)
    return pose, points.repeat(count, 1), there.reshape(-1, 3)


def _sum_by_pose(
    rotation: Tensor,
    pose: Tensor,
    value: Tensor,
    by_translation: Tensor,
    left: Tensor,
    right: Tensor,
) -> Part:
    """Sum what pairs add to their poses: values (P,) and gradients; that by R is left right^T.

    pose (P,): ascending. Each sum runs in the order of its pairs: the same bits in any batch.
    """
    count = len(rotation)
    if len(pose) == 0:
        return _zero(rotation)
    columns = [value[:, None], by_translation, *(left[:, i : i + 1] * right for i in range(3))]
    ends = torch.searchsorted(pose, torch.arange(count + 1, device=pose.device))
    # Not one column alone: for two and more, torch adds rows one after another on a GPU, too.
    sums = torch.segment_reduce(torch.cat(columns, dim=1), "sum", lengths=ends.diff(), axis=0)
    return Part(sums[:, 0], sums[:, 4:].reshape(-1, 3, 3), sums[:, 1:4])


def _zero(rotation: Tensor) -> Part:
    """Nothing, for each of the rotations (B, 3, 3)."""
    zeros = torch.zeros_like(rotation)
    return Part(zeros[:, 0, 0], zeros, zeros[:, 0])


def _joined(parts: list[Part]) -> Part:
    return Part(
        torch.cat([part.value for part in parts]),
        torch.cat([part.by_rotation for part in parts]),
        torch.cat([part.by_translation for part in parts]),
    )
