"""The best of many poses by a coarse score, in 32 bits, one pose after the other."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.pose_tuples import moved, origin_within, pose_at, turned

UNIT = 2.0**-14  # metres that scores count in, so that a table of 16 bits reaches 2 m
NO_POSE = 2**62  # above the keys of all poses
_ZERO, _HALF = np.float32(0.0), np.float32(0.5)


class Box32(NamedTuple):
    """The nodes of a grid, each with a cell around it."""

    first: Any  # (3,), the first node, metres
    inverse: Any  # nodes per metre
    most: Any  # (3,), the greatest index per axis
    across: Any  # steps in a flat array to the next node on the first axis,
    along: Any  # and on the second


class CoarseScore(NamedTuple):
    """What poses are scored by: some known points, and points inside of the object."""

    lower: Any  # (3,), where the object's origin may be
    upper: Any  # (3,)
    grid: Box32  # of signed distances
    values: Any  # (nodes,) in UNITs, read at the nearest node
    contacts: Any  # (3, A), world
    known_sdf: Any  # (A,), in UNITs
    reach: Any  # UNITs beyond which a known point costs no more
    left_out: int  # contacts that cost the most and do not count: 0 or 1
    inside: Any  # (P, 3), object frame
    weights: Any  # (P,), cost of each in free space, in UNITs of the sum over contacts
    voxels: Box32
    is_free: Any  # (voxels,)


@compiled
def keep_best(score, poses, first, keys):
    """Put the keys of poses (N, 12) into a heap of keys, worst first, in place of worse ones.

    A key is 2^32 x score + number, for poses numbered from `first` on: equal scores have an order.
    """
    nodes = np.empty(len(score.known_sdf), dtype=np.uint32)
    beyond = np.empty(len(nodes), dtype=np.float32)
    for n in range(len(poses)):
        pose = pose_at(poses, n)
        if origin_within(pose, score.lower, score.upper):
            _locate(score.grid, pose, score.contacts, nodes, beyond)
            key = (_coarse_score(score, pose, nodes, beyond, keys[0] >> 32) << 32) + first + n
            if key < keys[0]:
                _replace_worst(keys, key)


@leaf
def _replace_worst(keys, key):
    """Put a key into a heap in place of the first one."""
    at, child = 0, 1
    while child < len(keys):
        if child + 1 < len(keys) and keys[child + 1] > keys[child]:
            child += 1
        if key >= keys[child]:
            break
        keys[at] = keys[child]
        at, child = child, 2 * child + 1
    keys[at] = key


@inner
def _locate(grid, pose, contacts, nodes, beyond):
    """Fill in the nodes (A,) nearest to contacts (3, A), and how far these are out of the grid.

    The compiler makes vector instructions of it, as it has no lookups.
    """
    step = np.float32(1.0) / grid.inverse / np.float32(UNIT)
    for n in range(len(nodes)):
        x, y, z = moved(pose, contacts[0, n], contacts[1, n], contacts[2, n])
        x, y, z = x - grid.first[0], y - grid.first[1], z - grid.first[2]
        x, y, z = x * grid.inverse, y * grid.inverse, z * grid.inverse
        u, v, w = _clipped(x, grid.most[0]), _clipped(y, grid.most[1]), _clipped(z, grid.most[2])
        beyond[n] = (abs(x - u) + abs(y - v) + abs(z - w)) * step
        nodes[n] = _node(grid, u, v, w)


@leaf
def _coarse_score(score, pose, nodes, beyond, limit):
    """The score of a pose, or a part of it if it is above the limit."""
    total, worst = np.int64(0), np.int64(0)
    for n in range(len(nodes)):
        off = np.float32(score.values[nodes[n]]) + (beyond[n] - score.known_sdf[n])
        cost = np.int64(min(abs(off), score.reach))
        total, worst = total + cost, max(worst, cost)
    total -= score.left_out * worst
    voxels, most, inside = score.voxels, score.voxels.most, score.inside
    to_voxels = _voxels_from_object(voxels, pose)
    for n in range(len(inside)):
        if total > limit:
            break
        x, y, z = moved(to_voxels, inside[n, 0], inside[n, 1], inside[n, 2])
        x, y, z = _clipped(x, most[0]), _clipped(y, most[1]), _clipped(z, most[2])
        total += score.is_free[_node(voxels, x, y, z)] * score.weights[n]
    return total


@leaf
def _voxels_from_object(box, pose):
    """R^T and -R^T t in steps of a box, as a pose."""
    scale = box.inverse
    a, b, c = pose[0] * scale, pose[3] * scale, pose[6] * scale
    d, e, f = pose[1] * scale, pose[4] * scale, pose[7] * scale
    g, h, i = pose[2] * scale, pose[5] * scale, pose[8] * scale
    x, y, z = turned((a, b, c, d, e, f, g, h, i), pose[9], pose[10], pose[11])
    x, y, z = -x - box.first[0] * scale, -y - box.first[1] * scale, -z - box.first[2] * scale
    return a, b, c, d, e, f, g, h, i, x, y, z


@leaf
def _clipped(x, most):
    return min(max(x, _ZERO), most)


@leaf
def _node(box, x, y, z):
    """Where the node nearest to a place in a box is in a flat array."""
    across = np.int32(x + _HALF) * box.across + np.int32(y + _HALF) * box.along
    return np.uint32(across + np.int32(z + _HALF))  # not counted from the end
