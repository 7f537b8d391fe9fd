"""The relaxed cost of one pose and its gradient (CHSEL, Eqs. 7 to 10), exactly culled.

Sums run over free points in the order of their tree, then occupied, then known points in theirs.
The sums are 13: the value, the gradient by the translation, that by the rotation's rows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import Region, locate
from chsel.numerics.compiler import inner, leaf, spliced
from chsel.numerics.lattice import Lattice, look_up
from chsel.numerics.octree import Found, Tree, found_for, walk
from chsel.numerics.pose_tuples import finite, rigid
from chsel.problem.sdf_lookup import DistanceField, distance_beyond_box, distance_in_box

MOST_SLACK = 0.03  # metres
STEPS_AHEAD = 3.0  # that a list of neighbours should last
_NOTHING = (0.0,) * 13
_COUNT, _SLACK = 0, 1  # what the memory holds there
_GATHERED, _LAST = 2, 14  # where the memory holds the object's places and rotations


class FreeTerm(NamedTuple):
    """The points that free space is asked at, and the region where that costs something.

    interior False: free points of the world, and the cells of the object below alpha. interior
    True: points inside of the object, with weights (N,) and normals (N, 3), and free voxels of
    the world. centre, radius: a sphere in the object frame that holds the object's side. slack: 0,
    or infinite to leave out no point. margin: more metres than rounding moves a point. lattice: of
    the free points, if they are asked that way.
    """

    interior: bool
    tree: Tree
    region: Region
    weights: FloatArray
    normals: FloatArray
    centre: tuple[float, float, float]
    radius: float
    slack: float
    margin: float
    lattice: Lattice


class Model(NamedTuple):
    """All that the relaxed cost of a pose hangs on; letters as in CostSettings.

    occupied (3, K), known (3, M): points of the world. known_sdf (M,).
    """

    field: DistanceField
    free: FreeTerm
    occupied: FloatArray
    known: FloatArray
    known_sdf: FloatArray
    alpha: float
    free_scale: float
    occupied_scale: float
    known_scale: float
    known_tolerance: float
    exact_gradient: bool


class Neighbours(NamedTuple):
    """The points that can matter while a pose moves little (after Verlet, 1967).

    found: them. memory (32,): how many, the slack in metres that the object may move before they
    must be gathered again (-1: at once), and the places and rotations of the object when they were
    gathered and at the last evaluation.
    """

    found: Found
    memory: FloatArray


def neighbours_of(model: Model) -> Neighbours:
    """Scratch for one thread."""
    points = model.free.tree.spheres, model.occupied, model.known
    size = max(len(model.free.lattice.cells), *(array.shape[1] for array in points))
    return Neighbours(found_for(size), np.full(32, -1.0))


@leaf
def forget(near):
    """Make the next evaluation gather its neighbours anew."""
    near.memory[_SLACK] = -1.0


@inner
def evaluate(model, pose, near, most_slack):
    """The cost of a pose and its gradient, 13 sums; an infinite cost if it is not finite.

    most_slack: MOST_SLACK in a sequence of poses close to each other, which is faster then; 0.0
    otherwise. The result is the same to the bit.
    """
    free, found, memory = model.free, near.found, near.memory
    if not finite(pose):
        return _added(_NOTHING, np.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    move = _movement(free.interior, pose)
    if len(free.lattice.cells) > 0 and rigid(pose):
        back = _movement(True, pose)
        count = look_up(free.lattice, free.tree, free.region, move, back, found)
    else:
        slack = _slack_to_gather(free, pose, memory, most_slack)
        if slack >= 0.0:
            memory[_COUNT] = walk(free.tree, free.region, move, slack, found)
        count = int(memory[_COUNT])
    locate(move, free.region.box, found.x, found.y, found.z, found.places, count)
    if free.interior:
        sums = _interior_sums(free, pose, found, count)
    else:
        sums = _free_sums(model, found, count)
    sums = _with_occupied(sums, model, pose, found.places)
    return _with_known(sums, model, pose, found.places)


@spliced
def _slack_to_gather(free, pose, memory, most_slack):
    """The slack to gather points with; negative if those gathered last are all that matter."""
    slack = free.slack
    if not rigid(pose) or most_slack == 0.0:  # distances do not hold, or are not worth it
        slack = slack if rigid(pose) else np.inf
        memory[_SLACK] = -1.0
    else:
        place, radius = place_in_world(free.centre, pose), free.radius
        stride = travel(place, radius, pose, memory, _LAST)
        if memory[_SLACK] < 0.0 or travel(place, radius, pose, memory, _GATHERED) > memory[_SLACK]:
            stride = stride if memory[_SLACK] >= 0.0 else np.inf
            memory[_SLACK] = min(STEPS_AHEAD * stride, most_slack) if stride < most_slack else 0.0
            slack = max(memory[_SLACK] + free.margin, free.slack)
            remember(place, pose, memory, _GATHERED)
        else:
            slack = -1.0
        remember(place, pose, memory, _LAST)
    return slack


@spliced
def _free_sums(model, found, count):
    """lambda sum max(0, alpha - s), with gradient -lambda max(0, alpha - s) n (Eq. 8)."""
    box, table, trilinear = model.field.box, model.field.table, model.field.trilinear
    clearance, places = model.free.region.clearance, found.places
    sums = _NOTHING
    for n in range(count):
        if clearance[places.cell[n]] < 0.0 and places.beyond[n] == 0.0:
            s, nx, ny, nz = distance_in_box(trilinear, box, table, places, n)
            violation = max(model.alpha - s, 0.0)
            size = -model.free_scale * _slope(model, violation)
            value = model.free_scale * violation
            x, y, z = found.x[n], found.y[n], found.z[n]
            sums = _added(sums, value, size * nx, size * ny, size * nz, x, y, z)
    return sums


@spliced
def _interior_sums(free, pose, found, count):
    """A weight w at y = R^T (m - t), with gradient w R^T n by y: inwards, out of the free voxel."""
    clearance, weights, normals = free.region.clearance, free.weights, free.normals
    places, nodes = found.places, len(free.tree.starts) - 1
    sums = _NOTHING
    for at in range(count):
        if clearance[places.cell[at]] < 0.0 and places.beyond[at] == 0.0:
            n = found.kept[at] - nodes
            weight = weights[n]
            gx, gy, gz = weight * normals[n, 0], weight * normals[n, 1], weight * normals[n, 2]
            x = pose[0] * gx + pose[3] * gy + pose[6] * gz
            y = pose[1] * gx + pose[4] * gy + pose[7] * gz
            z = pose[2] * gx + pose[5] * gy + pose[8] * gz
            u, v, w = found.x[at] - pose[9], found.y[at] - pose[10], found.z[at] - pose[11]
            sums = _added_outer(sums, weight, (-gx, -gy, -gz), (u, v, w), (x, y, z))
    return sums


@spliced
def _with_occupied(sums, model, pose, places):
    """lambda sum max(0, alpha + s), with gradient lambda max(0, alpha + s) n (Eq. 9)."""
    field, table = model.field, model.field.table
    xs, ys, zs = model.occupied[0], model.occupied[1], model.occupied[2]
    locate(pose, field.box, xs, ys, zs, places, len(xs))
    for n in range(len(xs)):
        x, y, z = xs[n], ys[n], zs[n]
        s, nx, ny, nz = _distance_at(field, table, places, n, pose, x, y, z)
        violation = max(model.alpha + s, 0.0)
        size = model.occupied_scale * _slope(model, violation)
        value = model.occupied_scale * violation
        sums = _added(sums, value, size * nx, size * ny, size * nz, x, y, z)
    return sums


@spliced
def _with_known(sums, model, pose, places):
    """sum |s - v|, with gradient (s - v) n, over points of known signed distance (Eq. 10)."""
    field, table = model.field, model.field.table
    xs, ys, zs = model.known[0], model.known[1], model.known[2]
    locate(pose, field.box, xs, ys, zs, places, len(xs))
    for n in range(len(xs)):
        x, y, z = xs[n], ys[n], zs[n]
        s, nx, ny, nz = _distance_at(field, table, places, n, pose, x, y, z)
        difference = s - model.known_sdf[n]
        excess = max(abs(difference) - model.known_tolerance, 0.0)
        size = model.known_scale * _slope(model, excess)
        size = size if difference > 0.0 else -size
        value = model.known_scale * excess
        sums = _added(sums, value, size * nx, size * ny, size * nz, x, y, z)
    return sums


@spliced
def _distance_at(field, table, places, n, pose, x, y, z):
    """Signed distance and gradient at the n-th of the places, that of a world point x, y, z."""
    inside = distance_in_box(field.trilinear, field.box, table, places, n)
    if places.beyond[n] > 0.0:
        a, b, c = _moved(pose, x, y, z)
        return distance_beyond_box(field.box_distance, field.box, inside, a, b, c)
    return inside


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
def _added_outer(t, value, by_t, a, b):
    """Sums with a value, its gradient by the translation, and that by the rotation, a b^T."""
    return (
        t[0] + value,
        t[1] + by_t[0],
        t[2] + by_t[1],
        t[3] + by_t[2],
        t[4] + a[0] * b[0],
        t[5] + a[0] * b[1],
        t[6] + a[0] * b[2],
        t[7] + a[1] * b[0],
        t[8] + a[1] * b[1],
        t[9] + a[1] * b[2],
        t[10] + a[2] * b[0],
        t[11] + a[2] * b[1],
        t[12] + a[2] * b[2],
    )


@spliced
def _movement(back, pose):
    """The numbers of x -> R x + t, or of the way back m -> R^T m - R^T t."""
    a, b, c = pose[0], pose[1], pose[2]
    d, e, f = pose[3], pose[4], pose[5]
    g, h, i = pose[6], pose[7], pose[8]
    x, y, z = pose[9], pose[10], pose[11]
    if not back:
        return a, b, c, d, e, f, g, h, i, x, y, z
    u, v, w = a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z
    return a, d, g, b, e, h, c, f, i, -u, -v, -w


@leaf
def _moved(move, x, y, z):
    return (
        move[0] * x + move[1] * y + move[2] * z + move[9],
        move[3] * x + move[4] * y + move[5] * z + move[10],
        move[6] * x + move[7] * y + move[8] * z + move[11],
    )


@spliced
def travel(place, radius, pose, memory, at):
    """How far in the world any point of the object's side moved since it was remembered.

    At most: as far as its centre, and for a turn D = R - R' by |D| radius; the spectral norm of
    the difference of two rotations is its Frobenius norm over sqrt(2).
    """
    dx, dy, dz = place[0] - memory[at], place[1] - memory[at + 1], place[2] - memory[at + 2]
    turn = 0.0
    for i in range(9):
        turn += (pose[i] - memory[at + 3 + i]) * (pose[i] - memory[at + 3 + i])
    return np.sqrt(dx * dx + dy * dy + dz * dz) + np.sqrt(0.5 * turn) * radius


@spliced
def remember(place, pose, memory, at):
    memory[at], memory[at + 1], memory[at + 2] = place
    for i in range(9):
        memory[at + 3 + i] = pose[i]


@spliced
def place_in_world(centre, pose):
    """Where in the world the centre of the object's side is: R^T (c - t)."""
    x, y, z = centre[0] - pose[9], centre[1] - pose[10], centre[2] - pose[11]
    return (
        pose[0] * x + pose[3] * y + pose[6] * z,
        pose[1] * x + pose[4] * y + pose[7] * z,
        pose[2] * x + pose[5] * y + pose[8] * z,
    )
