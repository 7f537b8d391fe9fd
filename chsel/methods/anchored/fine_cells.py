"""The parts of grid cells where interpolated values may be below a level."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.arrays import BoolArray, IntArray
from chsel.numerics.cell_set import Box
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.sdf_lookup import cells_below

_PARTS = 4  # of a cell, along each axis
_MOST_PARTS = 50_000_000  # of all cells; of larger grids, cells are taken whole
_ROUNDING = 1e-9  # of values, generously


class FineCells(NamedTuple):
    """A set of parts of grid cells."""

    box: Box
    bits: Any  # (words,) one bit for each part, and a last one that is set; uint32
    unsure: int  # the index of the last bit


def fine_cells_below(sdf: SdfGrid, level: float) -> FineCells:
    """The parts of a grid's cells that hold a point whose interpolated value is below a level.

    And perhaps parts where values are higher by less than rounding. Derived once.
    """

    def make() -> FineCells:
        region = cells_below(sdf, level, "trilinear")
        cells = (region.clearance < 0.0).reshape(sdf.shape)
        parts = _PARTS if cells.size * _PARTS**3 <= _MOST_PARTS else 1
        shape = np.array(sdf.shape) * parts
        i, j, k = np.argwhere(cells).T
        below = _parts_below(sdf, level, i, j, k, parts)  # (C, parts, parts, parts)
        flags = np.zeros(int(shape.prod() // 32 + 1) * 32, dtype=bool)
        flags[shape.prod()] = True
        a, b, c = (parts * index[:, None, None, None] for index in (i, j, k))
        p, q, r = np.ogrid[:parts, :parts, :parts]
        at = ((a + p) * shape[1] + (b + q)) * shape[2] + (c + r)
        flags[at[below]] = True
        words = np.packbits(flags, bitorder="little").view("<u4").astype(np.uint32)
        box = region.box
        x, y, z = (parts * (most + 1.0) - 1.0 for most in box.most)
        fine = Box(
            first=box.first,
            last=box.last,
            inverse=parts * box.inverse,
            between=1.0,
            most=(x, y, z),
            across=float(shape[1] * shape[2]),
            along=float(shape[2]),
        )
        return FineCells(fine, words, int(shape.prod()))

    return sdf.derived(("fine cells below", level), make)


def _parts_below(
    sdf: SdfGrid, level: float, i: IntArray, j: IntArray, k: IntArray, parts: int
) -> BoolArray:
    """Whether parts (C, parts, parts, parts) of cells (C,) have a corner below a level.

    Interpolated values are extreme at corners, as they are linear along each axis.
    """
    values = np.zeros((len(i), parts + 1, parts + 1, parts + 1))
    shares = np.arange(parts + 1) / parts
    for a, b, c in np.ndindex(2, 2, 2):
        u, v, w = (shares if side else 1.0 - shares for side in (a, b, c))
        weights = u[:, None, None] * v[:, None] * w
        values += weights * sdf.values[i + a, j + b, k + c][:, None, None, None]
    below = values < level + _ROUNDING * (1.0 + np.abs(values))
    corners = [
        below[:, a : a + parts, b : b + parts, c : c + parts] for a, b, c in np.ndindex(2, 2, 2)
    ]
    return np.logical_or.reduce(corners)
