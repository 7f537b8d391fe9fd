"""Balls that cover free space: those of its medial axis, largest first (CHSEL, Sec. V-D)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.numerics.clearance import squared_clearances
from chsel.numerics.compiler import compiled, inner
from chsel.problem.points import VoxelGrid, Workspace

MOST_VOXELS = 30_000_000
_TOLERANCE = 2e-3  # half sides, by which a ball may stick out of the one that holds it


@dataclass(frozen=True, eq=False)
class Balls:
    """Balls in the world."""

    centres: FloatArray  # (N_b, 3), metres
    radii: FloatArray  # (N_b,), metres

    def __len__(self) -> int:
        return len(self.radii)


def medial_balls(
    free: FloatArray, workspace: Workspace, resolution: float, inflation: float
) -> Balls:
    """Balls within the known-free voxels of a workspace that cover them but for `inflation`.

    Largest first. Each is the largest that touches no voxel that is not free, around a centre that
    no ball covers so far; of equals, the first in row-major order.

    free (N, 3): centres of free voxels of side `resolution`, metres, or any points, which make the
    voxels free that hold them. All else is not free, nor is anything beyond the workspace.
    inflation: metres by which a ball may be inflated to cover another.
    Raises SettingError where the free points span too many voxels.
    """
    margin, (lower, upper) = 1e-6 * resolution, workspace.bounds
    inside = free[((free >= lower - margin) & (free <= upper + margin)).all(axis=1)]
    if len(inside) == 0:
        return Balls(np.zeros((0, 3)), np.zeros(0))
    flags = VoxelGrid.around(inside, resolution, MOST_VOXELS).flags
    squared = np.empty(flags.shape, dtype=np.int64)
    squared_clearances(flags, squared, 1)
    medial = np.zeros(squared.shape, dtype=np.bool_)
    _mark_medial(squared, medial)
    voxels = np.argwhere(medial)
    radii = np.sqrt(squared[medial].astype(np.float64))  # half sides
    order = np.argsort(-squared[medial], kind="stable")
    chosen = _covering(voxels, radii, _row_starts(medial), order, 2.0 * inflation / resolution)
    centres = inside.min(axis=0) + (voxels[chosen] - 1) * resolution
    return Balls(centres, radii[chosen] * (resolution / 2.0))


def _row_starts(medial: BoolArray) -> IntArray:
    """Where each row of voxels along the last axis starts (nx, ny + 1); the next entry ends it."""
    in_row = np.count_nonzero(medial, axis=2)
    ends = np.cumsum(in_row).reshape(in_row.shape)
    return np.concatenate([ends[:, :1] - in_row[:, :1], ends], axis=1)


@compiled
def _mark_medial(squared: IntArray, out: BoolArray) -> None:
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
    radius = np.sqrt(float(squared[i, j, k]))
    for a in range(-1, 2):
        for b in range(-1, 2):
            for c in range(-1, 2):
                other = squared[i + a, j + b, k + c]
                if other > squared[i, j, k]:
                    apart = 2.0 * np.sqrt(float(a * a + b * b + c * c))
                    if apart + radius <= np.sqrt(float(other)) + _TOLERANCE:
                        return True
    return False


@compiled
def _covering(
    voxels: IntArray, radii: FloatArray, rows: IntArray, order: IntArray, inflation: float
) -> IntArray:
    """Indices of balls that, inflated, cover all others: each the next that is not yet covered.

    voxels (P, 3), ascending in row-major order, with radii (P,). rows: see `_row_starts`. order
    (P,): in which balls are taken. Ball i covers ball j if |c_i - c_j| + r_j <= r_i + inflation.
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
