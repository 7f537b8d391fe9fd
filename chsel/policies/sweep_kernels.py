"""Kernels of voxel entropy: what is occupied in a belief, and what a hand would sweep of it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import compiled
from chsel.numerics.elementary import log


class VoxelBox(NamedTuple):
    """Voxels of a box, in C order."""

    lower: FloatArray  # (3,): the box's corner, metres
    side: float  # of a voxel, metres
    counts: Any  # (3,): voxels along each axis


class Reach(NamedTuple):
    """How far A hands get, in K poses of the object."""

    travel: FloatArray  # (A, K), metres, in ascending order
    left: FloatArray  # (A, K + 1): weight of the poses from here on, whose contact comes later


@compiled
def occupy(box: Any, points: Any, poses: Any, weights: Any, chance: Any, latest: Any) -> None:
    """Add to chance (V,) the weights (K,) of the poses in which an object fills each voxel.

    A pose (K, 12), object_from_world, fills the voxels that hold one of points (N, 3) of the
    object. latest (V,): scratch, below 0.
    """
    for k in range(len(weights)):
        pose = poses[k]
        for n in range(len(points)):
            p, q, r = points[n, 0] - pose[9], points[n, 1] - pose[10], points[n, 2] - pose[11]
            x = (pose[0] * p + pose[3] * q + pose[6] * r - box.lower[0]) / box.side
            y = (pose[1] * p + pose[4] * q + pose[7] * r - box.lower[1]) / box.side
            z = (pose[2] * p + pose[5] * q + pose[8] * r - box.lower[2]) / box.side
            inside = x >= 0.0 and y >= 0.0 and z >= 0.0
            if inside and x < box.counts[0] and y < box.counts[1] and z < box.counts[2]:
                voxel = (int(x) * box.counts[1] + int(y)) * box.counts[2] + int(z)
                if latest[voxel] != k:
                    latest[voxel] = k
                    chance[voxel] += weights[k]


@compiled
def entropies(chance: Any, out: Any) -> None:
    """Fill out (V,) with the entropies of chances (V,), nats: 0 for what is certain."""
    for v in range(len(chance)):
        p = chance[v]
        out[v] = 0.0
        if 0.0 < p < 1.0:
            out[v] = -(p * log(p) + (1.0 - p) * log(1.0 - p))


@compiled
def sweep(
    centres: Any, entropy: Any, side: Any, moves: Any, front: Any, reach: Any, out: Any
) -> None:
    """Fill `out` (A,) at some actions with the entropy that the hand is expected to sweep.

    centres (M, 3), entropy (M,): of voxels, world frame. moves: Moves. front: HandFront, as wide as
    a voxel around the hand. A voxel counts by the chance that the first contact comes after it.
    """
    heights, nx, ny = front.heights, front.heights.shape[0], front.heights.shape[1]
    count, turn = len(centres), moves.rotation
    seen = np.empty((count, 3))
    low, high = np.inf, -np.inf
    for m in range(count):
        x, y, z = centres[m, 0], centres[m, 1], centres[m, 2]
        for axis in range(3):
            seen[m, axis] = turn[3 * axis] * x + turn[3 * axis + 1] * y + turn[3 * axis + 2] * z
        low, high = min(low, seen[m, 0]), max(high, seen[m, 0])
    rows = 1 if count == 0 else int((high - low) / side) + 1
    first = np.zeros(rows + 1, dtype=np.int64)
    for m in range(count):
        first[int((seen[m, 0] - low) / side) + 1] += 1
    for row in range(rows):
        first[row + 1] += first[row]
    filled, order = first[:-1].copy(), np.empty(count, dtype=np.int64)
    for m in range(count):
        row = int((seen[m, 0] - low) / side)
        order[filled[row]] = m
        filled[row] += 1
    for a in range(len(moves.which)):
        action = moves.which[a]
        x, y = moves.starts[a, 0] + front.lower[0], moves.starts[a, 1] + front.lower[1]
        z, length = moves.starts[a, 2], moves.length[a]
        begin = int(min(max((x - low) / side, 0.0), rows + 0.0))
        end = int(min(max((x + nx * front.cell - low) / side + 1.0, 0.0), rows + 0.0))
        travel, left = reach.travel[action], reach.left[action]
        total = 0.0
        for n in range(first[begin], first[end]):
            m = order[n]
            i, j = (seen[m, 0] - x) / front.cell, (seen[m, 1] - y) / front.cell
            if i >= 0.0 and i < nx and j >= 0.0 and j < ny:
                depth = seen[m, 2] - z - heights[int(i), int(j)]
                if depth >= 0.0 and depth <= length:
                    total += entropy[m] * left[np.searchsorted(travel, depth)]
        out[action] = total
