"""The space that moving solids pass: nodes inside them, and poses close enough together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from chsel.errors import PoseError, SettingError, require_positive
from chsel.numerics.arrays import FloatArray, frozen
from chsel.problem.poses import (
    SENSOR_TOLERANCE,
    check_rigid,
    interpolated,
    product,
    rotation_angle,
)
from chsel.problem.sdf_grid import mesh_sdf

if TYPE_CHECKING:
    import trimesh

MOST_NODES = 2_000_000
MOST_POSES = 1_000_000
_DEEPEST_ON_SURFACE = 1e-9  # m: a node on the surface is not inside, however it is rounded
_ROUNDING = 1e-9  # steps: a move of one step is not two


def interior_lattice(
    meshes: trimesh.Trimesh | Sequence[trimesh.Trimesh], spacing: float
) -> FloatArray:
    """Nodes (M, 3) inside one closed mesh or inside any of several, in their common frame, metres.

    Each mesh has its own lattice around the centre of its bounding box, so that thin parts have
    nodes too. No voxel inside a solid is missed if `spacing` is at most the voxel's side / sqrt(3).
    Raises SettingError for a spacing that makes too many nodes.
    """
    import trimesh

    require_positive("spacing", spacing)
    solids = [meshes] if isinstance(meshes, trimesh.Trimesh) else meshes
    return np.concatenate([np.zeros((0, 3)), *(_inside(solid, spacing) for solid in solids)])


def poses_between(poses: FloatArray, *, step: float, radius: float) -> FloatArray:
    """Poses (Q, 4, 4) on the path through poses (P, 4, 4), about one step apart.

    Nothing within `radius` metres of the frame's origin moves by more than `step` metres from one
    pose to the next. Longer moves are interpolated along straight lines and shortest turns; poses
    closer together are thinned out, but the first and the last are kept. Raises PoseError for poses
    that are not rigid, or so far apart that more than a million are needed.
    """
    require_positive("step", step)
    require_positive("radius", radius, zero=True)
    poses = np.array(frozen("poses", poses, (None, 4, 4), error=PoseError))
    if len(poses) == 0:
        return poses
    check_rigid("poses", poses, SENSOR_TOLERANCE)
    moves = _motion(poses[:-1], poses[1:], radius)
    needed = len(poses) + float(moves.sum()) / step
    if not needed <= MOST_POSES:
        raise PoseError(
            f"poses move by {moves.sum():.3g} m, which takes {needed:.3g} poses {step:g} m apart; "
            f"accepted: at most {MOST_POSES:_}"
        )
    kept = poses[_thinned(moves, step)]
    steps = _motion(kept[:-1], kept[1:], radius) / step
    pieces = np.maximum(np.ceil(steps - _ROUNDING), 1.0).astype(np.int64)
    start = np.repeat(np.arange(len(pieces)), pieces)
    part = np.arange(len(start)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    path = kept[start]
    between = part > 0  # the given poses stay as they are
    fraction = (part / np.repeat(pieces, pieces))[between]
    path[between] = interpolated(kept[start[between]], kept[start[between] + 1], fraction)
    return np.concatenate([path, kept[-1:]])


def _inside(mesh: trimesh.Trimesh, spacing: float) -> FloatArray:
    lower, upper = np.asarray(mesh.bounds, dtype=np.float64)
    each_side = np.floor(0.5 * (upper - lower) / spacing)
    count = float(np.prod(2.0 * each_side + 1.0))
    if not count <= MOST_NODES:
        raise SettingError(
            f"spacing is {spacing:g} m, which makes {count:.3g} nodes in a solid; accepted: a "
            f"spacing that makes at most {MOST_NODES:_}"
        )
    axes = [np.arange(-n, n + 1.0) * spacing for n in each_side]
    nodes = 0.5 * (lower + upper) + np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return nodes[mesh_sdf(mesh, nodes)[0] < -_DEEPEST_ON_SURFACE]


def _motion(first: FloatArray, second: FloatArray, radius: float) -> FloatArray:
    """How far (N,) a point can move between poses (N, 4, 4): the shift plus the arc of the turn."""
    shift = second[:, :3, 3] - first[:, :3, 3]
    turn = product(np.swapaxes(first[:, :3, :3], 1, 2), second[:, :3, :3])
    return np.sqrt((shift**2).sum(axis=1)) + radius * rotation_angle(turn)


def _thinned(moves: FloatArray, step: float) -> list[int]:
    """Indices of P poses, given the P - 1 moves between them: each the last within one step."""
    path = np.concatenate([[0.0], np.cumsum(moves)])
    kept, last = [0], len(path) - 1
    while kept[-1] < last:
        reached = int(np.searchsorted(path, path[kept[-1]] + step, side="right")) - 1
        kept.append(max(reached, kept[-1] + 1))
    return kept
