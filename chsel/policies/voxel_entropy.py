"""The action whose way is most uncertain: free or occupied, by voxels of the workspace.

In the spirit of RUMI (Zhong, Fazeli and Berenson, arXiv 2408.10450), whose reward is information
about the workspace's occupancy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.ndimage import maximum_filter

from chsel.next_probe.decision_problem import DecisionProblem
from chsel.next_probe.first_contact import moves_by_orientation, touched_points
from chsel.next_probe.forecast import Forecast
from chsel.next_probe.hand_shape import HandFront
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.policies.policy import ConfiguredPolicy, PolicySettings
from chsel.policies.sweep_kernels import Reach, VoxelBox, entropies, occupy, sweep
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import Poses
from chsel.problem.sdf_grid import FARTHEST, SdfGrid
from chsel.problem.settings import positive
from chsel.problem.subset import evenly_spaced

_MOST_VOXELS = 1_000_000
_MOST_POINTS = 5000  # inside of an object
_WIDEST = 250  # cells that a hand is widened by, at most


@dataclass(frozen=True)
class VoxelEntropySettings(PolicySettings):
    """All settings of the policy."""

    # Side of a voxel, metres; larger where the workspace would have more than a million.
    voxel: Annotated[float, positive] = 0.02


class VoxelEntropy(ConfiguredPolicy[VoxelEntropySettings]):
    """Rates actions by the entropy of what the hand would sweep until its first contact, nats."""

    settings_class = VoxelEntropySettings

    def rate(self, problem: DecisionProblem, forecast: Forecast) -> FloatArray:
        """Entropy (A,) over voxels that are not known, each by the chance to get there."""
        box = voxel_box(problem.workspace, self.settings.voxel)
        entropy = occupancy_entropy(problem, box)  # (V,)
        uncertain = np.flatnonzero(entropy)
        voxels = np.stack(np.unravel_index(uncertain, tuple(box.counts.tolist())), axis=1)
        centres = box.lower + (voxels + 0.5) * box.side
        front = _widened(problem.hand.front, box.side)
        reach = _reach(forecast.first.travel, np.array(problem.belief.weights))
        swept = np.zeros(len(problem.actions))
        for moves in moves_by_orientation(problem.actions):
            sweep(centres, entropy[uncertain], box.side, moves, front, reach, swept)
        return swept


def voxel_box(workspace: Workspace, side: float) -> VoxelBox:
    """Voxels of at least a side, metres, that fill a workspace."""
    lower, upper = workspace.bounds
    extent = np.minimum(upper - lower, FARTHEST)
    while np.prod(np.ceil(extent / side)) > _MOST_VOXELS:
        side *= 1.25
    counts = np.maximum(np.ceil(extent / side), 1.0).astype(np.int64)
    return VoxelBox(lower, side, counts)


def occupancy_entropy(problem: DecisionProblem, box: VoxelBox) -> FloatArray:
    """Entropy (V,), nats, of whether the object fills each voxel; 0 for those that are known."""
    poses = np.array(Poses.of(problem.belief.object_from_world).numbers)
    weights = np.array(problem.belief.weights)
    chance = np.zeros(int(np.prod(box.counts)))
    latest = np.full(len(chance), -1)
    occupy(box, filled_points(problem.sdf, box.side), poses, weights, chance, latest)
    chance[known_voxels(problem.points, box)] = 0.0
    entropy = np.empty(len(chance))
    entropies(chance, entropy)
    return entropy


def filled_points(sdf: SdfGrid, side: float) -> FloatArray:
    """Points (N, 3) of an object in its frame: on its surface, and inside, half a side apart."""
    stride = max(int(0.5 * side / sdf.resolution), 1)
    inside = np.argwhere(sdf.values[::stride, ::stride, ::stride] <= 0.0) * stride
    inside = inside[evenly_spaced(len(inside), _MOST_POINTS)]
    return np.concatenate([touched_points(sdf).points, sdf.origin + inside * sdf.resolution])


def known_voxels(points: KnownPoints, box: VoxelBox) -> BoolArray:
    """Flags (V,) of the voxels that hold a known point."""
    known = np.zeros(tuple(box.counts.tolist()), dtype=bool)
    for places in (points.free, points.known, points.occupied):
        cells = np.floor((places - box.lower) / box.side)
        i, j, k = cells[((cells >= 0.0) & (cells < box.counts)).all(axis=1)].astype(np.int64).T
        known[i, j, k] = True
    return known.reshape(-1)


def _widened(front: HandFront, side: float) -> HandFront:
    """The front of a hand that sweeps every voxel of which it touches the square ahead of it."""
    margin = min(int(0.5 * side / front.cell), _WIDEST)
    heights = np.pad(front.heights, margin, constant_values=-np.inf)
    heights = maximum_filter(heights, 2 * margin + 1, mode="constant", cval=-np.inf)
    return HandFront(heights, front.lower - margin * front.cell, front.cell)


def _reach(travel: FloatArray, weights: FloatArray) -> Reach:
    """How far the hands get, from the ways (K, A) to first contacts."""
    order = np.argsort(travel, axis=0, kind="stable")
    ascending = np.take_along_axis(travel, order, axis=0)
    left = np.zeros((len(weights) + 1, travel.shape[1]))
    left[:-1] = np.cumsum(weights[order][::-1], axis=0)[::-1]
    return Reach(np.ascontiguousarray(ascending.T), np.ascontiguousarray(left.T))
