"""Which free points poses violate: a walk down an octree for all poses together, in torch."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from chsel.numerics.arrays import FloatArray
from chsel.numerics.octree import octree
from chsel.problem.poses import as_tensor, moved, squared_length
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.sdf_lookup import cells_below

NODES_PER_POSE = 256  # that a walk typically looks at together


class Pairs(NamedTuple):
    """Pairs of pose and point, by pose."""

    pose: Tensor  # (P,) ascending indices
    world: Tensor  # (P, 3) points
    local: Tensor  # (P, 3) points moved by the poses


class FreeTree:
    """Free points (N, 3) in an octree, and the cells of a grid that violate them.

    alpha: the level, metres, below which a point is violated. lookup: see SdfGrid.at.
    """

    def __init__(
        self,
        sdf: SdfGrid,
        free: FloatArray,
        spacing: float,
        alpha: float,
        lookup: str,
        device: torch.device,
    ) -> None:
        tree = octree(free, spacing)
        self._grid, self._lookup = sdf.on(device), lookup
        self._clearance = as_tensor(cells_below(sdf, alpha, lookup).clearance, device)
        self._centres = as_tensor(tree.spheres[:3].T, device)  # of the nodes, then the points
        self._radii = as_tensor(tree.spheres[3], device)
        self._starts = torch.tensor(tree.starts).to(device)
        self._depth = len(tree.levels) - 1
        self._top = torch.arange(int(tree.levels[1]), device=device)

    def violated(self, rotation: Tensor, translation: Tensor, most: int) -> Pairs | None:
        """The points in violating cells, by pose, then in the order of the tree.

        Exact: a node is left out only if its moved sphere misses every such cell. None if several
        poses need more than `most` nodes together.
        """
        count, stretch = len(rotation), _stretch(rotation)
        pose = torch.arange(count, device=rotation.device).repeat_interleave(len(self._top))
        node = self._top.repeat(count)
        for _ in range(self._depth):
            _, squared, clearance = self._look_up(rotation[pose], translation[pose], node)
            reach = stretch[pose] * self._radii[node]
            near = clearance.clamp_min(0.0) + squared <= reach * reach
            pose, node = pose[near], node[near]
            children = self._starts[node + 1] - self._starts[node]
            total = int(children.sum())
            if total > most and count > 1:
                return None
            before = children.cumsum(0) - children
            pose = pose.repeat_interleave(children, output_size=total)
            node = (self._starts[node] - before).repeat_interleave(children, output_size=total)
            node = node + torch.arange(total, device=node.device)
        points, squared, clearance = self._look_up(rotation[pose], translation[pose], node)
        violated = (clearance < 0.0) & (squared == 0.0)
        return Pairs(pose[violated], self._centres[node[violated]], points[violated])

    def _look_up(
        self, rotation: Tensor, translation: Tensor, node: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Moved centres (P, 3), their squared distances (P,) to the grid, clearances there (P,)."""
        centres = moved(rotation, translation, self._centres[node])
        inside = self._grid.clamped(centres)
        clearance = self._clearance[self._grid.cells(inside, self._lookup)]
        return centres, squared_length(centres - inside)[:, 0], clearance


def _stretch(matrices: Tensor) -> Tensor:
    """An upper bound of how far matrices (B, 3, 3) stretch a vector; about 1 for rotations."""
    gram = (matrices[:, :, :, None] * matrices[:, :, None, :]).sum(dim=1)
    return torch.sqrt(gram.abs().sum(dim=2).amax(dim=1)) * (1.0 + 1e-12)
