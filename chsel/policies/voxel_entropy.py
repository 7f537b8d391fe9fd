"""The action whose way is most uncertain: free or occupied, by voxels of the workspace.

In the spirit of RUMI (Zhong, Fazeli and Berenson, arXiv 2408.10450), whose reward is information
about the workspace's occupancy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np

from chsel.next_probe.decision_problem import DecisionProblem, HandFront
from chsel.next_probe.first_contact import moves_by_orientation, touched_points
from chsel.next_probe.forecast import Forecast
from chsel.numerics.arrays import FloatArray, IntArray, evenly_spaced
from chsel.numerics.compiler import compiled
from chsel.numerics.elementary import logs
from chsel.policies.policy import ConfiguredPolicy, PolicySettings
from chsel.problem.points import Workspace
from chsel.problem.poses import Poses, rotated
from chsel.problem.sdf_grid import FARTHEST, SdfGrid
from chsel.problem.settings import positive

_MOST_VOXELS = 1_000_000
_MOST_POINTS = 5000  # inside of an object
_WIDEST = 250  # cells that a hand is widened by, at most


@dataclass(frozen=True)
class VoxelEntropySettings(PolicySettings):
    """Settings of the policy."""

    # Side of a voxel, metres; larger where the workspace would have more than a million.
    voxel: Annotated[float, positive] = 0.02


class VoxelEntropy(ConfiguredPolicy[VoxelEntropySettings]):
    """Rates actions by the entropy of what the hand would sweep until its first contact, nats."""

    settings_class = VoxelEntropySettings

    def rate(self, problem: DecisionProblem, forecast: Forecast) -> FloatArray:
        """Entropy (A,) over voxels that are not known, each by the chance to get there."""
        box = voxel_box(problem.workspace, self.settings.voxel)
        entropy = occupancy_entropy(problem, box)
        uncertain = np.nonzero(entropy)
        centres = box.lower + (np.stack(uncertain, axis=1) + 0.5) * box.side  # (M, 3), world
        front = _widened(problem.hand.front, box.side)
        reach = _reach(forecast.first.travel, problem.belief.weights)
        swept = np.zeros(len(problem.actions))
        for moves in moves_by_orientation(problem.actions):
            seen = rotated(moves.rotation.reshape(3, 3), centres)
            low = seen[:, 0].min(initial=np.inf)
            row = np.floor((seen[:, 0] - low) / box.side)  # across the hand
            order = np.argsort(row, kind="stable")
            lower = moves.starts[:, 0] + front.lower[0] - low
            upper = lower + len(front.heights) * front.cell
            begin = np.searchsorted(row[order], np.floor(lower / box.side))
            end = np.searchsorted(row[order], upper / box.side + 1.0)
            voxels = seen[order], entropy[uncertain][order], begin, end
            sweep(voxels, moves, front, reach, swept)
        return swept


class VoxelBox(NamedTuple):
    """Voxels of a box."""

    lower: FloatArray  # (3,): the box's corner, metres
    side: float  # of a voxel, metres
    counts: IntArray  # (3,): voxels along each axis

    def holding(self, places: FloatArray) -> tuple[IntArray, ...]:
        """Indices along each axis of the voxels that hold places (N, 3), of those in the box."""
        x, y, z = ((places - self.lower) / self.side).T
        inside = (x >= 0.0) & (y >= 0.0) & (z >= 0.0)
        inside &= (x < self.counts[0]) & (y < self.counts[1]) & (z < self.counts[2])
        return tuple(cells[inside].astype(np.int64) for cells in (x, y, z))


def voxel_box(workspace: Workspace, side: float) -> VoxelBox:
    """Voxels of at least a side, metres, that fill a workspace."""
    lower, upper = workspace.bounds
    extent = np.minimum(upper - lower, FARTHEST)
    while np.prod(np.ceil(extent / side)) > _MOST_VOXELS:
        side *= 1.25
    return VoxelBox(lower, side, counts=np.maximum(np.ceil(extent / side), 1.0).astype(np.int64))


def occupancy_entropy(problem: DecisionProblem, box: VoxelBox) -> FloatArray:
    """Entropy (X, Y, Z), nats, of whether the object fills each voxel; 0 for those known."""
    filled = np.ascontiguousarray(filled_points(problem.sdf, box.side).T)
    poses = Poses.of(problem.belief.object_from_world).numbers
    chance = np.zeros(box.counts)
    for pose, weight in zip(poses, problem.belief.weights, strict=True):
        turn = pose[:9].reshape(3, 3, 1)
        (x, y, z) = filled - pose[9:, None]
        places = turn[0] * x + turn[1] * y + turn[2] * z  # (3, N), world
        chance[box.holding(places.T)] += weight
    for known in (problem.points.free, problem.points.known, problem.points.occupied):
        chance[box.holding(known)] = 0.0
    uncertain = (chance > 0.0) & (chance < 1.0)
    p = chance[uncertain]
    entropy = np.zeros_like(chance)
    entropy[uncertain] = -(p * logs(p) + (1.0 - p) * logs(1.0 - p))
    return entropy


def filled_points(sdf: SdfGrid, side: float) -> FloatArray:
    """Return points (N, 3) on an object and in it, in its frame, half a side apart."""
    stride = max(int(0.5 * side / sdf.resolution), 1)
    inside = np.argwhere(sdf.values[::stride, ::stride, ::stride] <= 0.0) * stride
    inside = inside[evenly_spaced(len(inside), _MOST_POINTS)]
    return np.concatenate([touched_points(sdf).points, sdf.origin + inside * sdf.resolution])


def _widened(front: HandFront, side: float) -> HandFront:
    """Return the front of a hand that sweeps every voxel of which it touches the square ahead."""
    from scipy.ndimage import maximum_filter

    margin = min(int(0.5 * side / front.cell), _WIDEST)
    heights = np.pad(front.heights, margin, constant_values=-np.inf)
    heights = maximum_filter(heights, 2 * margin + 1, mode="constant", cval=-np.inf)
    return HandFront(heights, front.lower - margin * front.cell, cell=front.cell)


def _reach(travel: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ways (A, K) to first contacts from (K, A), ascending; weights (A, K + 1) of those to come."""
    order = np.argsort(travel, axis=0, kind="stable")
    left = np.zeros((len(weights) + 1, travel.shape[1]))
    left[:-1] = np.cumsum(weights[order][::-1], axis=0)[::-1]
    return np.sort(travel.T, axis=1), np.ascontiguousarray(left.T)


@compiled
def sweep(voxels: Any, moves: Any, front: Any, reach: Any, out: Any) -> None:
    """Fill `out` (A,) at some actions with the entropy that the hand is expected to sweep.

    voxels: centres (M, 3) in axes of the hand, entropy (M,), and where those begin and end (A')
    that an action can meet. front: HandFront, as wide as a voxel around the hand. reach: `_reach`.
    A voxel counts by the chance that the first contact comes after it.
    """
    seen, entropy, begin, end = voxels
    nx, ny = front.heights.shape
    for a in range(len(moves.which)):
        action = moves.which[a]
        x, y = moves.starts[a, 0] + front.lower[0], moves.starts[a, 1] + front.lower[1]
        travel, left = reach[0][action], reach[1][action]
        total = 0.0
        for m in range(begin[a], end[a]):
            i, j = (seen[m, 0] - x) / front.cell, (seen[m, 1] - y) / front.cell
            if i >= 0.0 and i < nx and j >= 0.0 and j < ny:
                depth = seen[m, 2] - moves.starts[a, 2] - front.heights[int(i), int(j)]
                if depth >= 0.0 and depth <= moves.length[a]:
                    total += entropy[m] * left[np.searchsorted(travel, depth)]
        out[action] = total
