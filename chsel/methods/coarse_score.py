"""The coarse score of sampled poses: how far contacts are off, and depths in free space.

Nothing is interpolated: distances, gradients and free voxels are read at the nearest node. Points
are moved in 32 bits, twice as many at a time as in 64, relative to one of them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.cost.cost_settings import uncertain_depth
from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import Box, bounds_of, box_of, triple
from chsel.numerics.compiler import inner, leaf
from chsel.numerics.pose_tuples import Triple, inverted, moved, turned
from chsel.problem.points import KnownPoints, VoxelGrid, voxels_spanned
from chsel.problem.prior_kernels import Prior, prior_energy, prior_of
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.sdf_lookup import at_node
from chsel.problem.subset import farthest_points

SAMPLES = 64  # of a block
_MOST_KNOWN = 32  # that score poses: more are close to these, and take time
_FIRST = 32  # points inside that rule out most poses
_AT_ONCE = 16  # of the others that are looked up together
_MOST_INSIDE = 64  # points inside the object that poses are scored by
_REACH = 0.06  # metres beyond which known points cost no more, as they may be outliers
_DEEP = 0.3  # of the greatest depth: points inside are at least so deep, as the rest may be noise
_MOST_NODES = 4000  # of which they are chosen; the time for that grows with them
_WEIGHT, _BEYOND = 5.0, 20.0  # of their mean depths in free space, all and those beyond tolerance
_MOST_VOXELS = 20_000_000  # of free space: bytes
_OFF_NORMAL = 0.02  # metres that the normal of a contact costs which is across
_MOST_OFF_NORMAL = 0.03  # and any other one, at most
_PER_NAT = 0.005  # metres that a nat of the prior costs
_ZERO, _HALF = np.float32(0.0), np.float32(0.5)


class CoarseScore(NamedTuple):
    """Data of the coarse score: A known points, and P points inside of the object."""

    box: Box  # of the grid of signed distances
    values: Any  # (nodes,): signed distances, metres, float32
    table: FloatArray  # (4 nodes,): the same, and gradients, of which normals read the latter
    known: Any  # (3, A), relative to an origin, metres, float32
    known_origin: Triple  # world, metres
    known_sdf: Any  # (A,), metres, float32
    normals: FloatArray  # (3, A), world
    off_normal: (
        FloatArray  # (A,), metres that a normal costs which is across; 0 where there is none
    )
    left_out: int  # known points that cost the most and do not count: 0 or 1
    prior: Prior  # on the pose
    inside: Any  # (3, P), relative to an origin, metres, float32
    inside_origin: Triple  # object frame, metres
    costs: FloatArray  # (P,), of each in free space, metres of the sum over known points
    voxels: Box  # of free space, world
    is_free: Any  # (voxels,), flags


def coarse_score(
    problem: RegistrationProblem,
    known: KnownPoints,
    *,
    free: VoxelGrid | None,
    tolerance: float,
    left_out: int,
) -> CoarseScore:
    """Return the score by a problem's points.

    known: its known points, of which the first count. free: see `free_voxels`. tolerance: depth in
    metres up to which points in free space cost little, at least half of a voxel, as voxels are
    coarse. left_out: see CoarseScore.
    """
    sdf = problem.sdf
    tolerance = max(tolerance, uncertain_depth(sdf, 0.5 * problem.free_resolution))
    inside, costs = sdf.derived(("inside", tolerance), lambda: _inside(sdf, tolerance))
    if free is None:
        inside, costs = inside[:0], costs[:0]
        free = VoxelGrid(np.zeros(3), 1.0, flags=np.zeros((1, 1, 1), dtype=np.bool_))
    known = known.with_known(slice(_MOST_KNOWN))
    origin = known.known[0] if len(known.known) else np.zeros(3)
    centre = sdf.bounds.mean(axis=0)
    return CoarseScore(
        box=box_of(sdf.origin, sdf.resolution, shape=sdf.shape),
        values=sdf.derived("coarse values", lambda: _values(sdf)),
        table=sdf.table.reshape(-1),
        known=np.ascontiguousarray((known.known - origin).T, dtype=np.float32),
        known_origin=triple(origin),
        known_sdf=known.sdf.astype(np.float32),
        normals=known.normals.T.copy(),
        off_normal=np.where(known.normal_noise > 0.0, _OFF_NORMAL, 0.0),
        left_out=left_out,
        prior=prior_of(problem.prior, sdf),
        inside=np.ascontiguousarray((inside - centre).T, dtype=np.float32),
        inside_origin=triple(centre),
        costs=max(len(known.known), 1) / max(len(costs), 1) * costs,
        voxels=box_of(free.origin, free.resolution, shape=free.flags.shape),
        is_free=free.flags.reshape(-1),
    )


def free_voxels(problem: RegistrationProblem, margin: float) -> VoxelGrid | None:
    """Return the free voxels, or those that matter if they are far apart.

    Those do within `margin` metres and a diameter of the workspace. None if there are none, or too
    many.
    """
    free = problem.points.free
    side = problem.free_resolution
    if len(free) > 0 and voxels_spanned(bounds_of(free), side) >= _MOST_VOXELS:
        lower, upper = problem.workspace.bounds
        reach = margin + problem.sdf.diameter
        free = free[((free >= lower - reach) & (free <= upper + reach)).all(axis=1)]
    if len(free) == 0 or voxels_spanned(bounds_of(free), side) >= _MOST_VOXELS:
        return None
    return VoxelGrid.around(free, side)


def _values(sdf: SdfGrid) -> Any:
    """Return signed distances (nodes,) in 32 bits, which a processor's cache has room for."""
    return sdf.values.astype(np.float32).reshape(-1)


def _inside(sdf: SdfGrid, tolerance: float) -> tuple[FloatArray, FloatArray]:
    """Return points (P, 3) inside of the object, the deepest first, and costs (P,), metres."""
    deep = np.argwhere(sdf.values <= _DEEP * min(float(sdf.values.min()), 0.0))
    if len(deep) > _MOST_NODES:
        deep = deep[np.arange(_MOST_NODES) * len(deep) // _MOST_NODES]
    nodes = deep[farthest_points(deep.astype(np.float64), _MOST_INSIDE)]
    depths = -sdf.values[tuple(nodes.T)]
    order = np.argsort(-depths, kind="stable")
    nodes, depths = nodes[order], depths[order]
    costs = _WEIGHT * depths + _BEYOND * np.maximum(depths - tolerance, 0.0)
    return sdf.origin + nodes * sdf.resolution, costs


class Found(NamedTuple):
    """Scratch for samples and points that are looked up."""

    maps: Any  # (12 SAMPLES,), from points inside to steps of voxels, row by row; float32
    totals: FloatArray  # (SAMPLES,), costs of the first points inside
    nodes: Any  # (SAMPLES,), nearest nodes, of samples or points; uint32
    beyond: Any  # (SAMPLES,), how far points are out of the grid, axis by axis, metres; float32


@inner
def cost_of_first(score, block, count, found):
    """Fill totals with the costs of the first points inside, in so many poses of a block.

    The first 12 rows of a block, each of SAMPLES numbers, are poses. Most poses are ruled out by
    these costs, which are summed point by point, for vector instructions.
    """
    inside = score.inside
    totals = found.totals
    nodes = found.nodes
    for n in range(count):
        totals[n] = 0.0
    _map_to_voxels(score.voxels, score.inside_origin, block, count, found.maps)
    for m in range(min(_FIRST, inside.shape[1])):
        _look_up_samples(
            score.voxels, found.maps, inside[0, m], inside[1, m], inside[2, m], count, nodes
        )
        cost = score.costs[m]
        for n in range(count):
            totals[n] += cost * np.float64(score.is_free[nodes[n]])


@inner
def _map_to_voxels(voxels, origin, block, count, maps):
    """Fill maps with R^T (y + o - t) in steps of voxels, for points y relative to an origin o."""
    scale = voxels.inverse
    a, b, c = voxels.first
    o, p, q = origin
    for n in range(count):
        r0, r1, r2 = block[n], block[SAMPLES + n], block[2 * SAMPLES + n]
        r3, r4, r5 = block[3 * SAMPLES + n], block[4 * SAMPLES + n], block[5 * SAMPLES + n]
        r6, r7, r8 = block[6 * SAMPLES + n], block[7 * SAMPLES + n], block[8 * SAMPLES + n]
        x, y, z = block[9 * SAMPLES + n], block[10 * SAMPLES + n], block[11 * SAMPLES + n]
        x, y, z = o - x, p - y, q - z
        maps[n] = np.float32(scale * r0)
        maps[SAMPLES + n] = np.float32(scale * r3)
        maps[2 * SAMPLES + n] = np.float32(scale * r6)
        maps[3 * SAMPLES + n] = np.float32(scale * r1)
        maps[4 * SAMPLES + n] = np.float32(scale * r4)
        maps[5 * SAMPLES + n] = np.float32(scale * r7)
        maps[6 * SAMPLES + n] = np.float32(scale * r2)
        maps[7 * SAMPLES + n] = np.float32(scale * r5)
        maps[8 * SAMPLES + n] = np.float32(scale * r8)
        maps[9 * SAMPLES + n] = np.float32(scale * (r0 * x + r3 * y + r6 * z - a))
        maps[10 * SAMPLES + n] = np.float32(scale * (r1 * x + r4 * y + r7 * z - b))
        maps[11 * SAMPLES + n] = np.float32(scale * (r2 * x + r5 * y + r8 * z - c))


@inner
def _look_up_samples(box, maps, x, y, z, count, nodes):
    """Fill in the nodes nearest to one point in so many maps."""
    p, q, r = np.float32(box.most[0]), np.float32(box.most[1]), np.float32(box.most[2])
    across, along = np.int32(box.across), np.int32(box.along)
    for n in range(count):
        a = maps[n] * x + maps[SAMPLES + n] * y + maps[2 * SAMPLES + n] * z
        b = maps[3 * SAMPLES + n] * x + maps[4 * SAMPLES + n] * y + maps[5 * SAMPLES + n] * z
        c = maps[6 * SAMPLES + n] * x + maps[7 * SAMPLES + n] * y + maps[8 * SAMPLES + n] * z
        a = min(max(a + maps[9 * SAMPLES + n], _ZERO), p)
        b = min(max(b + maps[10 * SAMPLES + n], _ZERO), q)
        c = min(max(c + maps[11 * SAMPLES + n], _ZERO), r)
        i, j, k = np.int32(a + _HALF), np.int32(b + _HALF), np.int32(c + _HALF)
        nodes[n] = np.uint32(np.int32(np.int32(i * across) + np.int32(j * along)) + k)


@leaf
def score_below(score, pose, total, limit, found):
    """Return the score of a pose, metres times A; infinite if it is surely above the limit.

    total: of the first points inside, see cost_of_first.
    """
    total += _PER_NAT * prior_energy(score.prior, pose)
    known = score.known
    to_nodes = _to_nodes(score.box, pose, score.known_origin)
    _look_up(score.box, to_nodes, known, 0, known.shape[1], found)
    worst = 0.0
    for n in range(known.shape[1]):
        node = found.nodes[n]
        off = score.values[node] + found.beyond[n] - score.known_sdf[n]
        cost = min(np.float64(abs(off)), _REACH)
        if score.off_normal[n] > 0.0:
            cost += _normal_cost(score, pose, n, node)
        total += cost
        worst = max(worst, cost)
    total -= score.left_out * worst
    inside = score.inside
    if inside.shape[1] > _FIRST:
        to_nodes = _to_nodes(score.voxels, inverted(pose), score.inside_origin)
        for first in range(_FIRST, inside.shape[1], _AT_ONCE):
            if total > limit:
                return np.inf
            size = min(_AT_ONCE, inside.shape[1] - first)
            _look_up(score.voxels, to_nodes, inside, first, size, found)
            for n in range(size):
                total += np.float64(score.is_free[found.nodes[n]]) * score.costs[first + n]
    return total


@leaf
def _to_nodes(box, pose, origin):
    """Return the map from coordinates about an origin to steps of a box, in 32 bits."""
    x, y, z = moved(pose, origin[0], origin[1], origin[2])
    f = np.float32
    scale = box.inverse
    first = box.first
    return (
        f(scale * pose[0]), f(scale * pose[1]), f(scale * pose[2]),
        f(scale * pose[3]), f(scale * pose[4]), f(scale * pose[5]),
        f(scale * pose[6]), f(scale * pose[7]), f(scale * pose[8]),
        f(scale * (x - first[0])), f(scale * (y - first[1])), f(scale * (z - first[2])),
    )  # fmt: skip


@inner
def _look_up(box, to_nodes, points, first, count, found):
    """Fill in the nodes nearest to points, and how far out of the box these are.

    The compiler makes vector instructions of it.
    """
    nodes = found.nodes
    beyond = found.beyond
    step = np.float32(1.0 / box.inverse)
    p, q, r = np.float32(box.most[0]), np.float32(box.most[1]), np.float32(box.most[2])
    across, along = np.int32(box.across), np.int32(box.along)
    for n in range(count):
        x, y, z = points[0, first + n], points[1, first + n], points[2, first + n]
        x, y, z = moved(to_nodes, x, y, z)
        u, v, w = min(max(x, _ZERO), p), min(max(y, _ZERO), q), min(max(z, _ZERO), r)
        i, j, k = np.int32(u + _HALF), np.int32(v + _HALF), np.int32(w + _HALF)
        nodes[n] = np.uint32(np.int32(np.int32(i * across) + np.int32(j * along)) + k)
        beyond[n] = (abs(x - u) + abs(y - v) + abs(z - w)) * step


@leaf
def _normal_cost(score, pose, n, node):
    """Return the cost of a known point's normal beside the gradient at the node nearest to it."""
    normals = score.normals
    x, y, z = turned(pose, normals[0, n], normals[1, n], normals[2, n])
    _, u, v, w = at_node(score.table, node)
    return min(score.off_normal[n] * (1.0 - (x * u + y * v + z * w)), _MOST_OFF_NORMAL)
