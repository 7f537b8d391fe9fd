"""Free space as balls along its medial axis (after Haugo and Stahl, 2020)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from chsel.arrays import BoolArray, FloatArray, IntArray
from chsel.errors import SettingError
from chsel.kernels.balls import covering, mark_medial
from chsel.kernels.distance_transform import squared_clearances
from chsel.points import Lattice, Workspace

MOST_VOXELS = 30_000_000


@dataclass(frozen=True, eq=False)
class Balls:
    """Balls in the world: centres (N_b, 3) and radii (N_b,), metres."""

    centres: FloatArray
    radii: FloatArray

    def __len__(self) -> int:
        return len(self.radii)


def medial_balls(
    free: FloatArray, workspace: Workspace, resolution: float, inflation: float
) -> Balls:
    """Balls within the known-free voxels of a workspace that cover them but for `inflation`.

    Largest first. Each is the largest that touches no voxel that is not free, around a centre that
    no ball covers so far; of equals, the first in row-major order.

    free (N, 3): centres of free voxels of side `resolution`, metres, or any points, each of which
    makes the voxel free that it falls into. All else is not free, beyond the workspace, too.
    inflation: metres by which a ball may be inflated to cover another.
    Raises SettingError where the free points span too many voxels.
    """
    inside = _within(free, workspace, resolution)
    if len(inside) == 0:
        return Balls(np.zeros((0, 3)), np.zeros(0))
    lattice = Lattice(tuple(inside.min(axis=0).tolist()), resolution)
    squared = _clearances(_free_voxels(inside, lattice))
    medial = np.zeros(squared.shape, dtype=np.bool_)
    mark_medial(squared, medial)
    voxels = np.argwhere(medial)
    radii = np.sqrt(squared[medial].astype(np.float64))  # half sides
    largest_first = np.argsort(-squared[medial], kind="stable")
    chosen = covering(
        voxels, radii, _row_starts(medial), largest_first, 2.0 * inflation / resolution
    )
    return Balls(lattice.centres(voxels[chosen] - 1), radii[chosen] * (resolution / 2.0))


def _within(free: FloatArray, workspace: Workspace, resolution: float) -> FloatArray:
    """The points of free voxels whose centre is in the workspace, but for rounding."""
    margin = 1e-6 * resolution
    lower, upper = workspace.bounds
    return free[((free >= lower - margin) & (free <= upper + margin)).all(axis=1)]


def _free_voxels(points: FloatArray, lattice: Lattice) -> BoolArray:
    """Flags of the voxels that hold a point, with a layer of others around."""
    count = math.prod((np.ptp(points, axis=0) / lattice.spacing + 3.0).tolist())
    if not count <= MOST_VOXELS:
        raise SettingError(
            f"free points span {count:.1e} voxels of {lattice.spacing} m; "
            f"accepted: at most {MOST_VOXELS:.0e}, so a coarser free_resolution"
        )
    voxels = lattice.voxels(points)
    flags = np.zeros(voxels.max(axis=0) + 3, dtype=np.bool_)
    flags[tuple((voxels + 1).T)] = True
    return flags


def _clearances(free: BoolArray) -> IntArray:
    """Squared clearances of voxels in half sides; 0 where they are not free."""
    squared = np.empty(free.shape, dtype=np.int64)
    squared_clearances(free, squared)
    return squared


def _row_starts(medial: BoolArray) -> IntArray:
    """Where each row along the last axis starts among the voxels (nx, ny + 1), see `covering`."""
    in_row = np.count_nonzero(medial, axis=2)
    ends = np.cumsum(in_row).reshape(in_row.shape)
    return np.concatenate([ends[:, :1] - in_row[:, :1], ends], axis=1)
