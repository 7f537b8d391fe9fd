"""Free points in blocks, most of which are too far from the object to be looked at."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from chsel.arrays import FloatArray
from chsel.kernels.region import clearance_of
from chsel.kernels.tree import octree
from chsel.pose import as_tensor, moved_columns
from chsel.sdf import SdfGrid, squared_length


class FreeBlocks:
    """Free points (N, 3), neighbours together in K blocks, and the cells that violate them.

    alpha: the level, metres, below which a point is violated; lookup: see SdfGrid.query.
    """

    size = 32
    """Points in a block."""

    def __init__(
        self,
        sdf: SdfGrid,
        free: FloatArray,
        spacing: float,
        alpha: float,
        lookup: str,
        device: torch.device,
    ) -> None:
        # In the last block, points that are not numbers: they compare as outside of anything.
        padding = np.full((-len(free) % self.size, 3), np.nan)
        ordered = np.concatenate([free[octree(free, spacing).order], padding])
        blocks = ordered.reshape(-1, self.size, 3)
        lower, upper = np.nanmin(blocks, axis=1), np.nanmax(blocks, axis=1)
        rounding = 1e-9 + 1e-12 * float(np.abs(free).max())
        radii = np.sqrt((((upper - lower) / 2.0) ** 2).sum(axis=1)) * (1.0 + 1e-12) + rounding
        cells = sdf.active_cells(alpha, lookup).numpy().reshape(sdf.shape)
        self._sdf, self._lookup = sdf, lookup
        self._clearance = as_tensor(clearance_of(cells, sdf.resolution), device)
        self._points = as_tensor(np.moveaxis(blocks, 2, 0), device)  # (3, K, 32)
        self._centres = as_tensor((lower + upper).T / 2.0, device)  # (3, K)
        self._radii = as_tensor(radii, device)

    def __len__(self) -> int:
        return len(self._radii)

    def near(self, rotation: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
        """Pairs of pose (Q,) and block (Q,), pose by pose, that may hold violated points.

        Of any other block, the moved ball around its points misses every violating cell.
        """
        columns = moved_columns(rotation, translation, self._centres)
        centres = torch.stack(columns, dim=-1).reshape(-1, 3)
        inside = self._sdf.clamped(centres)
        clearance = self._clearance[self._sdf.cells(inside, self._lookup)].clamp_min(0.0)
        squared = clearance + squared_length(centres - inside)[:, 0]
        reach = _stretch(rotation)[:, None] * self._radii  # (B, K)
        pose, block = (squared.reshape(reach.shape) <= reach * reach).nonzero(as_tuple=True)
        return pose, block

    def violated(
        self, rotation: Tensor, translation: Tensor, pose: Tensor, block: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The points of pairs of pose and block that lie in violating cells.

        Their poses (P,), the points (P, 3), and them moved (P, 3); in the order of the pairs.
        """
        columns = self._points[:, block]  # (3, Q, 32)
        moved = moved_columns(rotation[pose], translation[pose], columns)
        first, last = self._sdf.bounds.tolist()
        within = torch.ones_like(moved[0], dtype=torch.bool)
        for i in range(3):
            within &= (moved[i] >= first[i]) & (moved[i] <= last[i])
        pair, place = within.nonzero(as_tuple=True)
        points = torch.stack([column[pair, place] for column in moved], dim=-1)
        in_cell = self._clearance[self._sdf.cells(points, self._lookup)] < 0.0
        pair, place = pair[in_cell], place[in_cell]
        world = columns[:, pair, place].T
        return pose[pair], world, points[in_cell]


def _stretch(matrices: Tensor) -> Tensor:
    """An upper bound (B,) of how far matrices (B, 3, 3) stretch a vector; 1 for rotations."""
    gram = (matrices[:, :, :, None] * matrices[:, :, None, :]).sum(dim=1)  # R^T R
    return torch.sqrt(gram.abs().sum(dim=2).amax(dim=1)) * (1.0 + 1e-12)
