"""The relaxed cost of one pose and its gradient (CHSEL, Eqs. 7 to 10), exactly culled.

Sums run over free points in the order of their tree, then over occupied and known points in theirs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.cell_set import Region, locate
from chsel.numerics.compiler import compiled, inner, leaf, spliced
from chsel.numerics.lattice import LatticePoints, look_up
from chsel.numerics.octree import Candidates, Tree, candidates_for, walk
from chsel.numerics.pose_tuples import (
    Pose,
    Triple,
    finite,
    inverted,
    pose_at,
    rigid,
    turned_back,
)
from chsel.problem.sdf_lookup import DistanceField, distance_in_box, distance_in_place

MOST_SLACK = 0.03  # metres
STEPS_AHEAD = 3.0  # that gathered neighbours should last


class FreeTerm(NamedTuple):
    """The points that the free term looks up, and the region where they cost something.

    "The object" is, for free points, the region; for interior points, all of them.
    """

    interior: bool  # interior points of the object in free voxels, else free points in the object
    tree: Tree  # over free points of the world, or over interior points in the object frame
    region: Region  # cells of the object that read values below alpha, or free voxels of the world
    weights: FloatArray  # (N,) of interior points
    normals: FloatArray  # (N, 3) of interior points
    centre: Triple  # of a sphere around the object, in its frame
    radius: float
    slack: float  # 0, or infinite to leave out no point
    margin: float  # more metres than rounding moves a point
    lattice: LatticePoints  # of free points; without cells, the tree is walked


class Model(NamedTuple):
    """All that the relaxed cost of a pose depends on, but the pose; see CostSettings."""

    field: DistanceField
    free: FreeTerm
    occupied: FloatArray  # (3, K), world
    known: FloatArray  # (3, M), world
    known_sdf: FloatArray  # (M,)
    alpha: float
    free_scale: float
    occupied_scale: float
    known_scale: float
    known_tolerance: float
    exact_gradient: bool


class CostAndGradient(NamedTuple):
    """The relaxed cost of a pose, and its gradient by the pose's 12 numbers."""

    cost: float
    by_pose: Pose


_NOTHING = CostAndGradient(0.0, (0.0,) * 12)


class Neighbours(NamedTuple):
    """The points that can matter while a pose moves little (after Verlet, 1967); see remember."""

    candidates: Candidates
    number: IntArray  # (1,) how many there are
    slack: FloatArray  # (1,) metres that the object may move until they are gathered anew, or -1
    gathered: FloatArray  # (12,) where the object was when they were gathered
    last: FloatArray  # (12,) where it was at the last evaluation


def neighbours_of(model: Model) -> Neighbours:
    """Scratch for one thread."""
    points = model.free.tree.spheres, model.occupied, model.known
    size = max(len(model.free.lattice.cells), *(array.shape[1] for array in points))
    number, slack = np.zeros(1, dtype=np.int64), np.full(1, -1.0)
    return Neighbours(candidates_for(size), number, slack, np.zeros(12), np.zeros(12))


@compiled
def costs_of_poses(model, poses, out, first, last, near):
    """Fill out (B,) with the costs of poses (B, 12), from `first` to before `last`."""
    for n in range(first, last):
        out[n] = evaluate(model, pose_at(poses, n), near, 0.0).cost


@inner
def evaluate(model, pose, near, most_slack):
    """The cost of a pose and its gradient; an infinite cost if the pose is not finite.

    most_slack: MOST_SLACK in a sequence of poses close to each other, which is faster then; 0.0
    otherwise. The result is the same to the bit.
    """
    free, candidates = model.free, near.candidates
    if not finite(pose):
        return CostAndGradient(np.inf, _NOTHING.by_pose)
    move = inverted(pose) if free.interior else pose
    if len(free.lattice.cells) > 0 and rigid(pose):
        back = inverted(pose)
        count = look_up(free.lattice, free.tree, free.region, move, back, candidates)
    else:
        slack = _slack_to_gather(free, pose, near, most_slack)
        if slack >= 0.0:
            near.number[0] = walk(free.tree, free.region, move, slack, candidates)
        count = near.number[0]
    x, y, z, places = candidates.x, candidates.y, candidates.z, candidates.places
    locate(move, free.region.box, x, y, z, places, count)
    if free.interior:
        sums = _interior_sums(free, pose, candidates, count)
    else:
        sums = _free_sums(model, candidates, count)
    sums = _with_occupied(sums, model, pose, places)
    return _with_known(sums, model, pose, places)


@leaf
def forget(near):
    """Make the next evaluation gather its neighbours anew."""
    near.slack[0] = -1.0


@spliced
def _slack_to_gather(free, pose, near, most_slack):
    """The slack to gather points with; negative if those gathered last are all that matter."""
    slack = free.slack
    if not rigid(pose) or most_slack == 0.0:  # distances do not hold, or are not worth it
        slack = slack if rigid(pose) else np.inf
        near.slack[0] = -1.0
    else:
        stride = travel(free, pose, near.last)
        if near.slack[0] < 0.0 or travel(free, pose, near.gathered) > near.slack[0]:
            stride = stride if near.slack[0] >= 0.0 else np.inf
            near.slack[0] = min(STEPS_AHEAD * stride, most_slack) if stride < most_slack else 0.0
            slack = max(near.slack[0] + free.margin, free.slack)
            remember(free, pose, near.gathered)
        else:
            slack = -1.0
        remember(free, pose, near.last)
    return slack


@spliced
def travel(free, pose, memory):
    """How far in the world any point of the object moved since a pose was remembered, at most.

    As far as its centre, and for a turn D = R - R' by |D| radius; the spectral norm of the
    difference of two rotations is its Frobenius norm over sqrt(2).
    """
    x, y, z = _centre_in_world(free, pose)
    dx, dy, dz = x - memory[0], y - memory[1], z - memory[2]
    turn = 0.0
    for i in range(9):
        turn += (pose[i] - memory[3 + i]) * (pose[i] - memory[3 + i])
    return np.sqrt(dx * dx + dy * dy + dz * dz) + np.sqrt(0.5 * turn) * free.radius


@spliced
def remember(free, pose, memory):
    """Fill memory (12,) with the object's centre in the world and its rotation."""
    memory[0], memory[1], memory[2] = _centre_in_world(free, pose)
    for i in range(9):
        memory[3 + i] = pose[i]


@leaf
def _centre_in_world(free, pose):
    """R^T (c - t)."""
    x, y, z = free.centre
    return turned_back(pose, x - pose[9], y - pose[10], z - pose[11])


@spliced
def _free_sums(model, candidates, count):
    """lambda sum max(0, alpha - s), with gradient -lambda max(0, alpha - s) n (Eq. 8)."""
    clearance, places = model.free.region.clearance, candidates.places
    sums = _NOTHING
    for n in range(count):
        if clearance[places.cell[n]] < 0.0 and places.beyond[n] == 0.0:
            s, nx, ny, nz = distance_in_box(model.field, places, n)
            violation = max(model.alpha - s, 0.0)
            size = -model.free_scale * _slope(model, violation)
            value = model.free_scale * violation
            x, y, z = candidates.x[n], candidates.y[n], candidates.z[n]
            sums = _added(sums, value, size * nx, size * ny, size * nz, x, y, z)
    return sums


@spliced
def _interior_sums(free, pose, candidates, count):
    """A weight w at y = R^T (m - t), with gradient w R^T n by y: inwards, out of the free voxel."""
    clearance, weights, normals = free.region.clearance, free.weights, free.normals
    places, nodes = candidates.places, len(free.tree.starts) - 1
    sums = _NOTHING
    for at in range(count):
        if clearance[places.cell[at]] < 0.0 and places.beyond[at] == 0.0:
            n = candidates.kept[at] - nodes
            weight = weights[n]
            gx, gy, gz = weight * normals[n, 0], weight * normals[n, 1], weight * normals[n, 2]
            by_world = turned_back(pose, gx, gy, gz)
            x, y, z = candidates.x[at], candidates.y[at], candidates.z[at]
            local = x - pose[9], y - pose[10], z - pose[11]
            sums = _added_outer(sums, weight, (-gx, -gy, -gz), local, by_world)
    return sums


@spliced
def _with_occupied(sums, model, pose, places):
    """lambda sum max(0, alpha + s), with gradient lambda max(0, alpha + s) n (Eq. 9)."""
    xs, ys, zs = model.occupied[0], model.occupied[1], model.occupied[2]
    locate(pose, model.field.box, xs, ys, zs, places, len(xs))
    for n in range(len(xs)):
        x, y, z = xs[n], ys[n], zs[n]
        s, nx, ny, nz = distance_in_place(model.field, pose, x, y, z, places, n)
        violation = max(model.alpha + s, 0.0)
        size = model.occupied_scale * _slope(model, violation)
        value = model.occupied_scale * violation
        sums = _added(sums, value, size * nx, size * ny, size * nz, x, y, z)
    return sums


@spliced
def _with_known(sums, model, pose, places):
    """sum |s - v|, with gradient (s - v) n, over points of known signed distance (Eq. 10)."""
    xs, ys, zs = model.known[0], model.known[1], model.known[2]
    locate(pose, model.field.box, xs, ys, zs, places, len(xs))
    for n in range(len(xs)):
        x, y, z = xs[n], ys[n], zs[n]
        s, nx, ny, nz = distance_in_place(model.field, pose, x, y, z, places, n)
        difference = s - model.known_sdf[n]
        excess = max(abs(difference) - model.known_tolerance, 0.0)
        size = model.known_scale * _slope(model, excess)
        size = size if difference > 0.0 else -size
        value = model.known_scale * excess
        sums = _added(sums, value, size * nx, size * ny, size * nz, x, y, z)
    return sums


@leaf
def _slope(model, violation):
    """The violation itself, as the paper defines the gradient, or that of its value."""
    if model.exact_gradient:
        return 1.0 if violation > 0.0 else 0.0
    return violation


@leaf
def _added(sums, value, gx, gy, gz, x, y, z):
    """Sums with a value and its object-frame gradient g at a world point."""
    return _added_outer(sums, value, (gx, gy, gz), (gx, gy, gz), (x, y, z))


@leaf
def _added_outer(sums, value, by_translation, a, b):
    """Sums with a value, its gradient by the translation, and that by the rotation, a b^T."""
    g = sums.by_pose
    return CostAndGradient(
        sums.cost + value,
        (
            g[0] + a[0] * b[0],
            g[1] + a[0] * b[1],
            g[2] + a[0] * b[2],
            g[3] + a[1] * b[0],
            g[4] + a[1] * b[1],
            g[5] + a[1] * b[2],
            g[6] + a[2] * b[0],
            g[7] + a[2] * b[1],
            g[8] + a[2] * b[2],
            g[9] + by_translation[0],
            g[10] + by_translation[1],
            g[11] + by_translation[2],
        ),
    )
