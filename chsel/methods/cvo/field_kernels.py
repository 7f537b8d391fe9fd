"""Sums of a field over points that a pose moves, block by block: first which are in it, then those.

Numbers of a field are of 32 bits, sums of 64.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import Box, Places, locate, places_for
from chsel.numerics.compiler import inner, leaf
from chsel.numerics.pose_tuples import moved

_BLOCK = 512  # points that are located at once


class ClassTerm(NamedTuple):
    """One class of points and its field."""

    points: FloatArray  # (3, N), world, metres
    box: Box
    table: Any  # (nodes, 4), f and its gradient at the nodes of the box; float32
    values: Any  # (nodes,), f alone; float32
    weight: float  # W of the class


class CvoScratch(NamedTuple):
    """Scratch of one thread."""

    places: Places
    within: Any  # (_BLOCK,) points within a field; int32


def scratch() -> CvoScratch:
    """Scratch of one thread."""
    return CvoScratch(places_for(_BLOCK), np.empty(_BLOCK, dtype=np.int32))


@inner
def _find_within(scratch, count):
    """Fill scratch.within with those of the first located points that are in the field."""
    within, beyond, total = scratch.within, scratch.places.beyond, np.uint64(0)
    for n in range(count):
        within[total] = n
        total += np.uint64(beyond[n] == 0.0)
    return np.int64(total)


@inner
def sum_at(term, pose, scratch):
    """W times the sum of f(p_i), p_i = R x_i + t; 0 beyond the field."""
    box, values, points, places = term.box, term.values, term.points, scratch.places
    across, along = np.uint64(box.across), np.uint64(box.along)
    cell, u, v, w, within = places.cell, places.u, places.v, places.w, scratch.within
    total = 0.0
    for start in range(0, points.shape[1], _BLOCK):
        end = min(start + _BLOCK, points.shape[1])
        xs, ys, zs = points[0, start:end], points[1, start:end], points[2, start:end]
        locate(pose, box, xs, ys, zs, places, end - start)
        for i in range(_find_within(scratch, end - start)):
            n = np.uint64(within[i])
            at = np.uint64(cell[n])
            near = _along(values, at, along, v[n], w[n])
            far = _along(values, at + across, along, v[n], w[n])
            total += _between(near, far, u[n])
    return term.weight * total


@leaf
def _along(values, at, along, v, w):
    """f between the four nodes around, of those that share the first index."""
    one = np.uint64(1)
    near = _between(values[at], values[at + one], w)
    return _between(near, _between(values[at + along], values[at + along + one], w), v)


@leaf
def _between(near, far, share):
    return np.float64(near) + share * (np.float64(far) - np.float64(near))


@inner
def moments_at(term, pose, scratch):
    """W times sums of f, grad f and p x grad f at p_i = R x_i + t, in the object frame."""
    box, points, places = term.box, term.points, scratch.places
    u, v, w, within = places.u, places.v, places.w, scratch.within
    across, along = np.uint64(box.across), np.uint64(box.along)
    value = gx = gy = gz = p = q = r = 0.0
    for start in range(0, points.shape[1], _BLOCK):
        end = min(start + _BLOCK, points.shape[1])
        xs, ys, zs = points[0, start:end], points[1, start:end], points[2, start:end]
        locate(pose, box, xs, ys, zs, places, end - start)
        for i in range(_find_within(scratch, end - start)):
            n = np.uint64(within[i])
            at = np.uint64(places.cell[n])
            s, nx, ny, nz = _row_between(term.table, at, across, along, u[n], v[n], w[n])
            a, b, c = moved(pose, xs[n], ys[n], zs[n])
            value += s
            gx, gy, gz = gx + nx, gy + ny, gz + nz
            p, q, r = p + (b * nz - c * ny), q + (c * nx - a * nz), r + (a * ny - b * nx)
    m = term.weight
    return m * value, m * gx, m * gy, m * gz, m * p, m * q, m * r


@leaf
def _row_between(table, base, across, along, u, v, w):
    """f and its gradient in the cell whose lowest node is `base`, in that order of additions."""
    s = nx = ny = nz = 0.0
    for corner in range(8):
        a, b, c = corner >> 2, (corner >> 1) & 1, corner & 1
        weight = (u if a else 1.0 - u) * (v if b else 1.0 - v) * (w if c else 1.0 - w)
        at = base + np.uint64(a) * across + np.uint64(b) * along + np.uint64(c)
        s += weight * np.float64(table[at, 0])
        nx += weight * np.float64(table[at, 1])
        ny += weight * np.float64(table[at, 2])
        nz += weight * np.float64(table[at, 3])
    return s, nx, ny, nz
