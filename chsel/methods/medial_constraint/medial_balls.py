"""Balls that cover free space: those of its medial axis, largest first (CHSEL, Sec. V-D)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.numerics.cell_set import squared_clearances
from chsel.numerics.compiler import compiled
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
    medial = _is_medial(squared)
    voxels = np.argwhere(medial)
    radii = np.sqrt(squared[medial].astype(np.float64))  # half sides
    order = np.argsort(-squared[medial], kind="stable")
    chosen = order[_covering(voxels[order], radii[order], 2.0 * inflation / resolution)]
    centres = inside.min(axis=0) + (voxels[chosen] - 1) * resolution
    return Balls(centres, radii[chosen] * (resolution / 2.0))


def _is_medial(squared: IntArray) -> BoolArray:
    """Flags (nx, ny, nz) of voxels of the set whose ball is in the ball of no neighbour.

    squared (nx, ny, nz): squared clearances, 0 outside of the set and on the outermost layer. Ball
    u holds ball v if |c_u - c_v| + r_v <= r_u.
    """
    inner = squared[1:-1, 1:-1, 1:-1]
    radii, medial = np.sqrt(squared.astype(np.float64)), np.zeros(squared.shape, dtype=np.bool_)
    own, kept = radii[1:-1, 1:-1, 1:-1], inner > 0
    for offset in np.ndindex(3, 3, 3):
        apart = 2.0 * math.sqrt(sum((step - 1) ** 2 for step in offset))
        around = tuple(
            slice(step, step + side) for step, side in zip(offset, inner.shape, strict=True)
        )
        if apart > 0.0:
            kept &= (apart + own > radii[around] + _TOLERANCE) | (squared[around] <= inner)
    medial[1:-1, 1:-1, 1:-1] = kept
    return medial


@compiled
def _covering(voxels: IntArray, radii: FloatArray, inflation: float) -> IntArray:
    """Indices of balls that, inflated, cover all others: each the next that is not yet covered.

    voxels (P, 3) with radii (P,). Ball i covers ball j if |c_i - c_j| + r_j <= r_i + inflation.
    """
    covered, chosen = np.zeros(len(radii), dtype=np.bool_), np.empty(len(radii), dtype=np.int64)
    count = 0
    for i in range(len(radii)):
        if not covered[i]:
            chosen[count] = i
            count += 1
            for j in range(i, len(radii)):
                x, y = voxels[i, 0] - voxels[j, 0], voxels[i, 1] - voxels[j, 1]
                z, margin = voxels[i, 2] - voxels[j, 2], radii[i] + inflation - radii[j]
                covered[j] |= 4.0 * (x * x + y * y + z * z) <= margin * margin
    return chosen[:count].copy()
