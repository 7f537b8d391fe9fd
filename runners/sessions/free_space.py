"""Voxels that are known to be free: at the border of the workspace, and where the hand has been."""

from __future__ import annotations

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.problem.points import Lattice, Workspace

SLAB_MARGIN = 0.15  # m: by which the floor slab is wider than the object
SLAB_LAYERS = 2


def floor_slab(lattice: Lattice, vertices: FloatArray) -> FloatArray:
    """Centres of the lattice's lowest layers, below the floor, under and around vertices (V, 3)."""
    low = lattice.voxels(vertices.min(axis=0, keepdims=True) - SLAB_MARGIN)[0]
    high = lattice.voxels(vertices.max(axis=0, keepdims=True) + SLAB_MARGIN)[0]
    low[2], high[2] = 0, SLAB_LAYERS - 1
    return lattice.centres(low + _box(high - low + 1))


def box_shell(lattice: Lattice, workspace: Workspace) -> FloatArray:
    """Centres of one layer of voxels on the six faces of the workspace."""
    last = lattice.voxels(workspace.bounds[1:])[0]
    shell = np.ones(last + 1, dtype=bool)
    shell[1:-1, 1:-1, 1:-1] = False
    return lattice.centres(np.argwhere(shell))


def swept_voxels(lattice: Lattice, interior: FloatArray, positions: FloatArray) -> FloatArray:
    """Centres of the voxels that interior (M, 3) meets at any of the hand's positions (P, 3)."""
    bounds = np.array([positions.min(axis=0), positions.max(axis=0)])
    bounds += [interior.min(axis=0), interior.max(axis=0)]
    low, high = lattice.voxels(bounds)
    met = np.zeros(high - low + 1, dtype=bool)
    _, width, height = met.shape
    flags, points = met.reshape(-1), np.ascontiguousarray(interior.T)  # (3, M)
    origin, first = np.array(lattice.origin)[:, None], low.astype(np.float64)[:, None]
    for position in np.unique(positions, axis=0):
        # As Lattice.voxels, in place: these are ten thousands of positions.
        at = points + position[:, None]
        at -= origin
        at /= lattice.spacing
        x, y, z = np.subtract(np.rint(at, out=at), first, out=at)
        flags[((x * width + y) * height + z).astype(np.int64)] = True
    return lattice.centres(low + np.argwhere(met))


def _box(shape: np.ndarray) -> np.ndarray:
    """All indices (N, 3) of an array of that shape (3,)."""
    return np.argwhere(np.ones(shape, dtype=bool))
