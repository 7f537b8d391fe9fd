"""The grid of signed distances in torch, for the differentiable cost and its device."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from chsel.numerics.arrays import FloatArray
from chsel.problem.poses import as_tensor, length


class TorchGrid:
    """What SdfGrid looks up, by the same arithmetic on a device.

    bounds: first and last node (2, 3). values (nx, ny, nz), gradients (nx, ny, nz, 3): see SdfGrid.
    """

    def __init__(
        self,
        bounds: FloatArray,
        resolution: float,
        values: FloatArray,
        gradients: FloatArray,
        device: torch.device,
    ) -> None:
        self._inverse, self._shape = 1.0 / resolution, values.shape
        self._first, self._last = (as_tensor(bound, device) for bound in bounds)
        self._top = as_tensor(np.array(values.shape) - 2.0, device)  # of the lowest of eight nodes
        self._values = as_tensor(values.reshape(-1), device)
        self._gradients = as_tensor(gradients.reshape(-1, 3), device)

    def clamped(self, points: Tensor) -> Tensor:
        """The points of the grid's box (P, 3) nearest to points (P, 3), never NaN."""
        return points.fmax(self._first).fmin(self._last)

    def cells(self, points: Tensor, lookup: str) -> Tensor:
        """Flat index (P,) of the nodes that points (P, 3) within the grid read.

        The nearest node for lookup "nearest", the lowest of eight nodes for "trilinear".
        """
        cell = (points - self._first) * self._inverse
        return self._flat(cell.round() if lookup == "nearest" else self._base(cell))

    def query(self, points: Tensor, *, lookup: str, outside: str) -> tuple[Tensor, Tensor]:
        """Signed distance (P,) and gradient (P, 3) at points (P, 3): see SdfGrid.at."""
        clamped = self.clamped(points)
        read = self._nearest if lookup == "nearest" else self._trilinear
        value, gradient = read((clamped - self._first) * self._inverse)
        beyond = (clamped != points).any(dim=1)
        if not bool(beyond.any()):
            return value, gradient
        away = points[beyond] - clamped[beyond]
        if outside == "surface_point":
            unit = gradient[beyond] / length(gradient[beyond])
            away = away + value[beyond, None] * unit
        distance = length(away)
        value[beyond] = distance[:, 0]
        gradient[beyond] = away / distance
        return value, gradient

    def _base(self, cell: Tensor) -> Tensor:
        """The lowest of the eight nodes around grid coordinates (P, 3)."""
        return cell.floor().minimum(self._top)

    def _nearest(self, cell: Tensor) -> tuple[Tensor, Tensor]:
        """Value and gradient at grid coordinates (P, 3) by the nearest node."""
        index = self._flat(cell.round())
        return self._values[index], self._gradients[index]

    def _trilinear(self, cell: Tensor) -> tuple[Tensor, Tensor]:
        """Value and gradient at grid coordinates (P, 3) by interpolation between 8 nodes."""
        base = self._base(cell)
        fraction = cell - base
        sides = (1.0 - fraction, fraction)
        first = self._flat(base)
        _, ny, nz = self._shape
        value, gradient = cell.new_zeros(len(cell)), cell.new_zeros(cell.shape)
        for i, j, k in np.ndindex(2, 2, 2):
            weight = sides[i][:, 0] * sides[j][:, 1] * sides[k][:, 2]
            index = first + (i * ny + j) * nz + k
            value = value + weight * self._values[index]
            gradient = gradient + weight[:, None] * self._gradients[index]
        return value, gradient

    def _flat(self, index: Tensor) -> Tensor:
        _, ny, nz = self._shape
        return ((index[:, 0] * ny + index[:, 1]) * nz + index[:, 2]).long()
