"""The plausible set by brute force, less what cannot be in it (CHSEL, Sec. III and V).

A block of positions is passed over if the least that the known points can cost anywhere in it is
too much already; the bounds allow for rounding, and what remains is costed as if alone.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.cell_set import Box, Region, locate
from chsel.numerics.compiler import compiled, inner, leaf, spliced
from chsel.numerics.octree import Candidates, Tree, candidates_for, walk
from chsel.numerics.pose_tuples import finite, pose_at, rigid
from chsel.problem.sdf_lookup import DistanceField, distance_beyond_box, distance_in_box

_MOST_DISTINCT = 32  # violations that are told apart one by one


class Evaluation(NamedTuple):
    """All that the evaluation cost of a pose hangs on.

    tree: free points, and region: the cells of the object where a free point can violate. level:
    free points violate at a signed distance of `level` or less, occupied ones at -level or more;
    each costs `violation`. divisors: of free, occupied and known sums. occupied (3, K), known
    (3, M), known_sdf (M,). inside (3, I): points inside of the object, and voxels with the number
    of one free point in each (-1: none), by which most violating poses are found fast.
    """

    field: DistanceField
    tree: Tree
    region: Region
    occupied: FloatArray
    known: FloatArray
    known_sdf: FloatArray
    level: float
    violation: float
    divisors: tuple[float, float, float]
    inside: FloatArray
    voxels: Box
    point_in: Any


class Blocks(NamedTuple):
    """Positions in blocks of blocks: a forest, its uppermost blocks first, its positions last.

    centres (3, N): of blocks, metres. layer (N,): of each block; blocks of a layer have the same
    radius. starts (N + 1,): the first block within each. tops: how many uppermost blocks there
    are. position (N,): the number of a block's position, -1 for a block of several.
    """

    centres: FloatArray
    layer: IntArray
    starts: IntArray
    tops: int
    position: IntArray


class Bounds(NamedTuple):
    """What the signed distance is at least and at most within a radius of the points of a cell.

    A layer for every radius: numbers (L, 16) are the corner of its grid of cells, cells per metre,
    the box of the signed distance grid in cells (its lower side, its upper sides per axis), the
    greatest index per axis, steps in the table along two axes, its first row in the table, its
    radius, and how near to the border of a cell, in cells, its bounds do not hold. table
    (cells, 2). Beyond the box, the distance is at least the root of reach * d^2 + s^2, with d
    that to the box, and s what the table has for the box's nearest point, if above 0.
    """

    numbers: FloatArray
    table: Any
    reach: float


class Scan(NamedTuple):
    """Which poses to look at, and what lets them in.

    rotations (R, 9), positions (P, 3): world_from_object, every one with every other. known
    (3, M), known_sdf (M,): in the order in which they tell most. limit: costs are below it.
    known_limit: more than the sum over known points of any pose below it, rounding included.
    """

    rotations: FloatArray
    positions: FloatArray
    known: FloatArray
    known_sdf: FloatArray
    limit: float
    known_limit: float


class Room(NamedTuple):
    """Scratch of one thread, and what it has found: numbers and costs of poses (C,)."""

    found: Candidates
    turned: FloatArray
    stack: IntArray
    pose: IntArray
    cost: FloatArray


def room_for(model: Evaluation, known: int, blocks: int, capacity: int) -> Room:
    """Scratch for one thread that can find so many poses before it must be emptied."""
    points = model.tree.spheres, model.occupied, model.known
    size = max(_MOST_DISTINCT + 1, *(array.shape[1] for array in points))
    stack = np.empty(blocks, dtype=np.int64)
    pose = np.empty(capacity, dtype=np.int64)
    return Room(candidates_for(size), np.empty((3, known)), stack, pose, np.empty(capacity))


@inner
def cost_below(model, pose, limit, found):
    """The evaluation cost of a pose; infinite if it is not below the limit."""
    if not finite(pose):
        return np.inf
    total = _known_sum(model, pose, found)
    if not _cost(model, 0, 0, total) < limit:
        return np.inf
    occupied = _occupied_count(model, pose, found)
    if not _cost(model, 0, occupied, total) < limit:
        return np.inf
    if rigid(pose) and not _few_violations(model, pose, occupied, total, limit, found):
        return np.inf
    cost = _cost(model, _free_count(model, pose, found), occupied, total)
    return cost if cost < limit else np.inf


@leaf
def _cost(model, free, occupied, total):
    cost = model.violation * (free / model.divisors[0])
    cost += model.violation * (occupied / model.divisors[1])
    return cost + total / model.divisors[2]


@spliced
def _known_sum(model, pose, found):
    """sum |s - v| over the points of known signed distance, in their order."""
    known, total = model.known, 0.0
    locate(pose, model.field.box, known[0], known[1], known[2], found.places, known.shape[1])
    for n in range(known.shape[1]):
        s = _distance(model.field, pose, known[0, n], known[1, n], known[2, n], found.places, n)
        total += abs(s - model.known_sdf[n])
    return total


@spliced
def _occupied_count(model, pose, found):
    occupied, count = model.occupied, 0
    places, number = found.places, occupied.shape[1]
    locate(pose, model.field.box, occupied[0], occupied[1], occupied[2], places, number)
    for n in range(number):
        x, y, z = occupied[0, n], occupied[1, n], occupied[2, n]
        count += 1 if _distance(model.field, pose, x, y, z, places, n) >= -model.level else 0
    return count


@leaf
def _distance(field, pose, x, y, z, places, n):
    """Signed distance at the n-th of the places, that of a world point."""
    inside = distance_in_box(field.trilinear, field.box, field.table, places, n)
    if places.beyond[n] > 0.0:
        a = pose[0] * x + pose[1] * y + pose[2] * z + pose[9]
        b = pose[3] * x + pose[4] * y + pose[5] * z + pose[10]
        c = pose[6] * x + pose[7] * y + pose[8] * z + pose[11]
        inside = distance_beyond_box(field.box_distance, field.box, inside, a, b, c)
    return inside[0]


@spliced
def _few_violations(model, pose, occupied, total, limit, found):
    """False if the free points near some points inside of the object are too many violations."""
    spheres, nodes = model.tree.spheres, len(model.tree.starts) - 1
    voxels, inside, hits = model.voxels, model.inside, 0
    for n in range(inside.shape[1]):
        x, y, z = inside[0, n] - pose[9], inside[1, n] - pose[10], inside[2, n] - pose[11]
        a = pose[0] * x + pose[3] * y + pose[6] * z - voxels.first[0]
        b = pose[1] * x + pose[4] * y + pose[7] * z - voxels.first[1]
        c = pose[2] * x + pose[5] * y + pose[8] * z - voxels.first[2]
        a = min(max(np.rint(a * voxels.inverse), 0.0), voxels.most[0])
        b = min(max(np.rint(b * voxels.inverse), 0.0), voxels.most[1])
        c = min(max(np.rint(c * voxels.inverse), 0.0), voxels.most[2])
        point = model.point_in[int(a * voxels.across + b * voxels.along + c)]
        if point >= 0 and hits < _MOST_DISTINCT and _is_new(found.kept, hits, point):
            node = nodes + point
            found.x[0], found.y[0], found.z[0] = (
                spheres[0, node],
                spheres[1, node],
                spheres[2, node],
            )
            locate(pose, model.region.box, found.x, found.y, found.z, found.places, 1)
            if _violates(model, found.places, 0):
                found.kept[hits] = point
                hits += 1
                if not _cost(model, hits, occupied, total) < limit:
                    return False
    return True


@leaf
def _is_new(kept, count, point):
    new = True
    for n in range(count):
        new &= kept[n] != point
    return new


@leaf
def _violates(model, places, n):
    """Whether a free point at the n-th of the places is inside; nothing beyond the grid is."""
    if model.region.clearance[places.cell[n]] >= 0.0 or places.beyond[n] > 0.0:
        return False
    field = model.field
    return distance_in_box(field.trilinear, field.box, field.table, places, n)[0] <= model.level


@spliced
def _free_count(model, pose, found):
    slack = 0.0 if rigid(pose) else np.inf
    count = walk(model.tree, model.region, pose, slack, found)
    locate(pose, model.region.box, found.x, found.y, found.z, found.places, count)
    violations = 0
    for n in range(count):
        violations += 1 if _violates(model, found.places, n) else 0
    return violations


@compiled
def costs_below(model, poses, limit, out, first, last, found):
    """Fill out (B,) with the costs below a limit, else inf, of poses (B, 12) from first to last."""
    for n in range(first, last):
        out[n] = cost_below(model, pose_at(poses, n), limit, found)


@compiled
def scan_rotations(model, blocks, bounds, scan, first, last, room):
    """Find the poses below the limit with rotations from `first` to before `last`.

    Returns the rotation to go on with, and how many poses are in the room; it ends before `last`
    where the room may not do for another rotation. Pose n is rotation n // P at position n % P.
    """
    positions, rotations, known = scan.positions, scan.rotations, scan.known
    stack, turned, found = room.stack, room.turned, room.found
    starts, centres, count = blocks.starts, blocks.centres, 0
    for n in range(first, last):
        if len(room.pose) - count < len(positions):
            return n, count
        # object_from_world is the transpose.
        a, d, g = rotations[n, 0], rotations[n, 1], rotations[n, 2]
        b, e, h = rotations[n, 3], rotations[n, 4], rotations[n, 5]
        c, f, i = rotations[n, 6], rotations[n, 7], rotations[n, 8]
        for m in range(known.shape[1]):
            x, y, z = known[0, m], known[1, m], known[2, m]
            turned[0, m] = a * x + b * y + c * z
            turned[1, m] = d * x + e * y + f * z
            turned[2, m] = g * x + h * y + i * z
        height = blocks.tops
        for node in range(height):
            stack[node] = node
        while height > 0:
            height -= 1
            node = stack[height]
            x, y, z = centres[0, node], centres[1, node], centres[2, node]
            x, y, z = a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z
            if _may_hold(bounds, blocks.layer[node], scan, turned, x, y, z):
                position = blocks.position[node]
                if position < 0:
                    for child in range(starts[node], starts[node + 1]):
                        stack[height] = child
                        height += 1
                else:
                    x, y, z = positions[position]
                    u, v, w = a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z
                    pose = (a, b, c, d, e, f, g, h, i, -u, -v, -w)
                    cost = cost_below(model, pose, scan.limit, found)
                    if cost < scan.limit:
                        room.pose[count] = n * len(positions) + position
                        room.cost[count] = cost
                        count += 1
    return last, count


@leaf
def _may_hold(bounds, layer, scan, turned, x, y, z):
    """Whether known points, turned and moved to a block's centre, leave it below the limit."""
    numbers, table = bounds.numbers, bounds.table
    x, y, z = x + numbers[layer, 0], y + numbers[layer, 1], z + numbers[layer, 2]
    inverse, low = numbers[layer, 3], numbers[layer, 4]
    high_x, high_y, high_z = numbers[layer, 5], numbers[layer, 6], numbers[layer, 7]
    most_x, most_y, most_z = numbers[layer, 8], numbers[layer, 9], numbers[layer, 10]
    across, along, row = numbers[layer, 11], numbers[layer, 12], numbers[layer, 13]
    radius, unsure, total = numbers[layer, 14], numbers[layer, 15], 0.0
    for m in range(turned.shape[1]):
        u = (turned[0, m] - x) * inverse
        v = (turned[1, m] - y) * inverse
        w = (turned[2, m] - z) * inverse
        p, q, r = min(max(u, low), high_x), min(max(v, low), high_y), min(max(w, low), high_z)
        cell = min(np.floor(p), most_x) * across + min(np.floor(q), most_y) * along
        at = int(row + cell + min(np.floor(r), most_z))
        least, most = float(table[at, 0]), float(table[at, 1])
        if unsure > 0.0 and (
            (abs(u - np.rint(u)) < unsure and u == p)
            or (abs(v - np.rint(v)) < unsure and v == q)
            or (abs(w - np.rint(w)) < unsure and w == r)
        ):
            continue
        squared = (u - p) * (u - p) + (v - q) * (v - q) + (w - r) * (w - r)
        if squared > 0.0:
            away = np.sqrt(squared) / inverse - radius
            if away > 0.0:  # all of the block is beyond the grid
                least = max(least, 0.0)
                least = np.sqrt(bounds.reach * away * away + least * least)
                most = np.inf
        value = scan.known_sdf[m]
        # Where `most` is positive, the block may reach beyond the grid, where it does not hold.
        below = value - most if most < 0.0 else 0.0
        total += max(max(least - value, below), 0.0)
        if total > scan.known_limit:
            return False
    return True
