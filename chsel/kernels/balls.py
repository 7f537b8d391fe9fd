"""Balls along the medial axis of a voxel set, and a small choice of them that covers the rest.

Lengths are in half sides of a voxel. A ball is as large as the squared clearance of its voxel.
"""

from __future__ import annotations

import numpy as np

from chsel.arrays import BoolArray, FloatArray, IntArray
from chsel.kernels.compiler import compiled, inner

_TOLERANCE = 2e-3  # half sides, by which a ball may stick out of the one that holds it


@compiled
def mark_medial(squared: IntArray, out: BoolArray) -> None:
    """Fill out (nx, ny, nz): voxels of the set whose ball is in the ball of no neighbour.

    squared (nx, ny, nz): squared clearances, 0 outside of the set and on the outermost layer.
    """
    nx, ny, nz = squared.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                out[i, j, k] = squared[i, j, k] > 0 and not _held(squared, i, j, k)


@inner
def _held(squared: IntArray, i: int, j: int, k: int) -> bool:
    """Whether |c_u - c_v| + r_v <= r_u for any of the 26 neighbours u of a voxel v."""
    own = squared[i, j, k]
    radius = np.sqrt(float(own))
    for a in range(-1, 2):
        for b in range(-1, 2):
            for c in range(-1, 2):
                other = squared[i + a, j + b, k + c]
                if other > own:
                    apart = 2.0 * np.sqrt(float(a * a + b * b + c * c))
                    if apart + radius <= np.sqrt(float(other)) + _TOLERANCE:
                        return True
    return False


@compiled
def covering(
    voxels: IntArray, radii: FloatArray, rows: IntArray, order: IntArray, inflation: float
) -> IntArray:
    """Indices of balls that, once inflated, cover all others; each the next that none does so far.

    voxels (P, 3), ascending in row-major order, with radii (P,). rows (nx, ny + 1): of every row of
    voxels along the last axis, where it starts in `voxels`; the next entry is its end. order (P,):
    in which balls are taken. Ball i covers ball j if |c_i - c_j| + r_j <= r_i + inflation.
    """
    covered, chosen = np.zeros(len(order), dtype=np.bool_), np.empty(len(order), dtype=np.int64)
    count = 0
    for i in order:
        if not covered[i]:
            _cover(voxels, radii, rows, i, inflation, covered)
            chosen[count] = i
            count += 1
    return chosen[:count].copy()


@inner
def _cover(
    voxels: IntArray,
    radii: FloatArray,
    rows: IntArray,
    i: int,
    inflation: float,
    covered: BoolArray,
) -> None:
    """Mark the balls that ball i covers; their centres are within reach = r_i + inflation."""
    x, y, z = voxels[i, 0], voxels[i, 1], voxels[i, 2]
    nx, ny, reach = len(rows), rows.shape[1] - 1, radii[i] + inflation
    steps = int(min(0.5 * reach, float(nx + ny))) + 1
    for row in range(max(x - steps, 0), min(x + steps + 1, nx)):
        for column in range(max(y - steps, 0), min(y + steps + 1, ny)):
            aside = (row - x) * (row - x) + (column - y) * (column - y)
            if 4.0 * aside > reach * reach:
                continue
            for j in range(rows[row, column], rows[row, column + 1]):
                apart = 4.0 * (aside + (voxels[j, 2] - z) * (voxels[j, 2] - z))
                margin = reach - radii[j]
                if margin >= 0.0 and apart <= margin * margin:
                    covered[j] = True
