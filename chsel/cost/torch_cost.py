"""The relaxed cost (CHSEL, Eqs. 6 to 10) in torch, with the gradient that the paper defines."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from chsel.cost.cost_settings import CostSettings
from chsel.cost.interior_points import interior_points
from chsel.cost.torch_octree import NODES_PER_POSE, FreeTree, Pairs
from chsel.errors import EngineError, require_positive
from chsel.numerics.arrays import FloatArray
from chsel.problem.points import KnownPoints, VoxelGrid
from chsel.problem.poses import as_tensor, moved, stacked
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid


def gpus() -> int:
    """The number of GPUs that torch finds on this machine."""
    return torch.cuda.device_count() if torch.cuda.is_available() else 0


def device_named(name: str) -> torch.device:
    """The device "cpu", "cuda" (torch's current GPU) or "cuda:N".

    Raises EngineError, which lists the devices of this machine, for any other name.
    """
    count = gpus()
    accepted = ["cpu", *(["cuda"] if count else []), *(f"cuda:{n}" for n in range(count))]
    if name == "cuda" and count:
        return torch.device("cuda", torch.cuda.current_device())
    if name in accepted:
        return torch.device(name)
    present = f"{count} GPU{'s' * (count > 1)}" if count else "no GPU"
    but = f", but torch finds {present} here" if str(name).startswith("cuda") else ""
    raise EngineError(f"device is {name}{but}; accepted: {', '.join(accepted)}")


_PAIRS_ON_CPU = 60_000  # fits its cache
_PAIRS_ON_GPU = 4_000_000  # at most 1.6 GB of its memory


class Part(NamedTuple):
    """A term of the cost for B poses, and its gradient."""

    value: Tensor  # (B,)
    by_rotation: Tensor  # (B, 3, 3)
    by_translation: Tensor  # (B, 3)


class RelaxedCost:
    """C^(X) = lambda sum_free c_f + lambda sum_occupied c_o + sum_known c_k (CHSEL, Eq. 7).

    A function of rotations (B, 3, 3) and translations (B, 3) of object_from_world; B may differ
    from call to call, and no pose's cost depends on the others. Built from numpy arrays and
    differentiable by torch: the gradient is the one that Eqs. 8 to 10 define, pushed through
    x~ = R x + t.

    Use it for gradients by torch, and with device "cuda" for the costs of 10^5 poses and more.
    The methods use CompiledCost: on a processor it is 20 to 35 times as fast, and its bits are the
    same on every machine. Those of RelaxedCost are the same in every run on one device, and in any
    batch there, as sums run in a fixed order. Between devices, costs agree to a relative 1e-9.

    pairs_at_once: how many pairs of pose and point are processed together, at 250 to 400 bytes
    each; one pose is never divided. By default 60 000 on a processor and 4 million on a GPU.
    Raises EngineError for a device that this machine does not have.
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
        settings = (settings or CostSettings()).of_object(sdf, free_resolution)
        self.settings = settings
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
        free, alpha, lookup = points.free, settings.alpha, settings.lookup
        if len(free) and not bool(sdf.active_cells(alpha, lookup).any()):
            warnings.warn(
                f"no node of the SDF is deeper than {-alpha} m: free points cannot be violated; "
                "use a smaller penetration_tolerance",
                stacklevel=2,
            )
        if len(free) and settings.free_term == "interior":
            self._interior = _InteriorPoints(sdf, free, free_resolution, settings, self.device)
        elif len(free):
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
            batch = as_tensor(transforms[first : first + size], self.device)
            with torch.no_grad():
                costs[first : first + size] = self(batch[:, :3, :3], batch[:, :3, 3]).cpu().numpy()
        costs[~np.isfinite(transforms[:, :3]).all(axis=(1, 2))] = np.inf
        return costs

    def terms(self, rotation: Tensor, translation: Tensor) -> dict[str, Part]:
        """The weighted terms "free", "occupied" and "known" for B poses."""
        size = self._poses_at_once
        batches = list(zip(rotation.split(size), translation.split(size), strict=True))
        terms = {"free": self._free, "occupied": self._of_occupied, "known": self._of_known}
        return {name: _joined([term(r, t) for r, t in batches]) for name, term in terms.items()}

    @property
    def _poses_at_once(self) -> int:
        free = 0 if self._tree is None else NODES_PER_POSE
        interior = 0 if self._interior is None else len(self._interior.points)
        most = max(1, free, interior, len(self._occupied), len(self._known))
        return max(1, self.pairs_at_once // most)

    def _free(self, rotation: Tensor, translation: Tensor) -> Part:
        """lambda sum max(0, alpha - s), with gradient -lambda max(0, alpha - s) n (Eq. 8)."""
        if self._interior is not None:
            return self._interior.part(rotation, translation)
        if self._tree is None:
            return _zero(rotation)
        violated = self._tree.violated(rotation, translation, self.pairs_at_once)
        if violated is None:
            half = -(-len(rotation) // 2)
            halves = zip(rotation.split(half), translation.split(half), strict=True)
            return _joined([self._free(r, t) for r, t in halves])
        s, n = self._query(violated)
        violation = (self.settings.alpha - s).clamp_min(0.0)
        return self._sum(rotation, violated, self.settings.free_scale, violation, -n)

    def _of_occupied(self, rotation: Tensor, translation: Tensor) -> Part:
        """lambda sum max(0, alpha + s), with gradient lambda max(0, alpha + s) n (Eq. 9)."""
        if len(self._occupied) == 0:
            return _zero(rotation)
        pairs = _all_pairs(rotation, translation, self._occupied)
        s, n = self._query(pairs)
        violation = (self.settings.alpha + s).clamp_min(0.0)
        return self._sum(rotation, pairs, self.settings.occupied_scale, violation, n)

    def _of_known(self, rotation: Tensor, translation: Tensor) -> Part:
        """sum |s - v|, with gradient (s - v) n (Eq. 10)."""
        if len(self._known) == 0:
            return _zero(rotation)
        pairs = _all_pairs(rotation, translation, self._known)
        s, n = self._query(pairs)
        difference = s - self._known_sdf.repeat(len(rotation))
        excess = (difference.abs() - self.settings.known_tolerance).clamp_min(0.0)
        along = torch.sign(difference)[:, None] * n
        return self._sum(rotation, pairs, self.settings.known_scale, excess, along)

    def _query(self, pairs: Pairs) -> tuple[Tensor, Tensor]:
        lookup, outside = self.settings.lookup, self.settings.outside
        return self.sdf.query(pairs.local, lookup=lookup, outside=outside)

    def _sum(
        self, rotation: Tensor, pairs: Pairs, scale: float, violation: Tensor, along: Tensor
    ) -> Part:
        """Sums by pose of violations (P,), which grow along object-frame directions (P, 3)."""
        exact = self.settings.gradient == "exact"
        slope = (violation > 0.0).double() if exact else violation
        gradient = scale * slope[:, None] * along
        return _sum_by_pose(
            rotation,
            pairs.pose,
            scale * violation,
            by_translation=gradient,
            left=gradient,
            right=pairs.world,
        )


class _InteriorPoints:
    """The free term over points inside the object: lambda sum_j o_j w_j.

    w_j = -s(m_j) for interior points m_j, o_j = 1 where m_j lies in a known free voxel. The
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
        self.points = as_tensor(interior.points, device)  # (M, 3)
        self._weight = as_tensor(interior.weights(settings, free_resolution), device)
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
        return _sum_by_pose(
            rotation, pose, weight, by_translation=-pull, left=local, right=by_world
        )


class _DefinedGradient(torch.autograd.Function):
    """Forward, the value; backward, the gradient that the terms define."""

    @staticmethod
    def forward(ctx: Any, rotation: Tensor, translation: Tensor, cost: RelaxedCost) -> Tensor:
        free, occupied, known = cost.terms(rotation.detach(), translation.detach()).values()
        value, *gradient = (a + b + c for a, b, c in zip(free, occupied, known, strict=True))
        ctx.save_for_backward(*gradient)
        return value

    @staticmethod
    def backward(ctx: Any, by_value: Tensor) -> tuple[Tensor, Tensor, None]:
        by_rotation, by_translation = ctx.saved_tensors
        return by_value[:, None, None] * by_rotation, by_value[:, None] * by_translation, None


def _all_pairs(rotation: Tensor, translation: Tensor, points: Tensor) -> Pairs:
    """All pairs of B poses and points (N, 3)."""
    count = len(rotation)
    pose = torch.arange(count, device=points.device).repeat_interleave(len(points))
    local = moved(rotation[:, None], translation[:, None], points)
    return Pairs(pose, points.repeat(count, 1), local.reshape(-1, 3))


def _sum_by_pose(
    rotation: Tensor,
    pose: Tensor,
    value: Tensor,
    *,
    by_translation: Tensor,
    left: Tensor,
    right: Tensor,
) -> Part:
    """Sums by pose (P,), ascending, of values (P,) and gradients (P, 3); that by R is left right^T.

    Each sum runs in the order of its pairs: the same bits in any batch.
    """
    count = len(rotation)
    if len(pose) == 0:
        return _zero(rotation)
    columns = [value[:, None], by_translation, *(left[:, i : i + 1] * right for i in range(3))]
    ends = torch.searchsorted(pose, torch.arange(count + 1, device=pose.device))
    # For two and more columns, torch adds rows one after another, on a GPU too.
    sums = torch.segment_reduce(torch.cat(columns, dim=1), "sum", lengths=ends.diff(), axis=0)
    return Part(sums[:, 0], sums[:, 4:].reshape(-1, 3, 3), sums[:, 1:4])


def _zero(rotation: Tensor) -> Part:
    """Zero for each of the rotations (B, 3, 3)."""
    zeros = torch.zeros_like(rotation)
    return Part(zeros[:, 0, 0], zeros, zeros[:, 0])


def _joined(parts: list[Part]) -> Part:
    return Part(*(torch.cat(tensors) for tensors in zip(*parts, strict=True)))
