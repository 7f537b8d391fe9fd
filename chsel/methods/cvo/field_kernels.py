"""Sums of a field over points that a pose moves: terms first, then their sums in order.

So the memory that terms are read from is waited for once. Numbers of a field are of 32 bits, sums
of 64.
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
    terms: FloatArray  # (_BLOCK, 8), f, its gradient and their moments, of each


def scratch() -> CvoScratch:
    """Scratch of one thread."""
    within = np.empty(_BLOCK, dtype=np.int32)
    return CvoScratch(places_for(_BLOCK), within, np.empty((_BLOCK, 8)))


@inner
def sum_at(term, pose, scratch):
    """W times the sum of f(p_i), p_i = R x_i + t; 0 beyond the field."""
    box, values, points, places = term.box, term.values, term.points, scratch.places
    across, along = np.uint64(box.across), np.uint64(box.along)
    beyond, cell, u, v, w = places.beyond, places.cell, places.u, places.v, places.w
    total = 0.0
    for start in range(0, points.shape[1], _BLOCK):
        end = min(start + _BLOCK, points.shape[1])
        xs, ys, zs = points[0, start:end], points[1, start:end], points[2, start:end]
        locate(pose, box, xs, ys, zs, places, end - start)
        for n in range(end - start):
            at = np.uint64(cell[n])
            near = _along(values, at, along, v[n], w[n])
            far = _along(values, at + across, along, v[n], w[n])
            value = _between(near, far, u[n])
            beyond[n] = value if beyond[n] == 0.0 else 0.0
        for n in range(end - start):
            total += beyond[n]
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
    box, points, places, terms = term.box, term.points, scratch.places, scratch.terms
    u, v, w, within = places.u, places.v, places.w, scratch.within
    across, along = np.uint64(box.across), np.uint64(box.along)
    value = gx = gy = gz = p = q = r = 0.0
    for start in range(0, points.shape[1], _BLOCK):
        end = min(start + _BLOCK, points.shape[1])
        xs, ys, zs = points[0, start:end], points[1, start:end], points[2, start:end]
        locate(pose, box, xs, ys, zs, places, end - start)
        count = 0
        for n in range(end - start):
            within[count] = n
            count += 1 if places.beyond[n] == 0.0 else 0
        for i in range(count):
            n = within[i]
            at = np.uint64(places.cell[n])
            s, nx, ny, nz = _row_between(term.table, at, across, along, u[n], v[n], w[n])
            a, b, c = moved(pose, xs[n], ys[n], zs[n])
            row = terms[i]
            row[0], row[1], row[2], row[3] = s, nx, ny, nz
            row[4], row[5], row[6] = b * nz - c * ny, c * nx - a * nz, a * ny - b * nx
        for i in range(count):
            row = terms[i]
            value += row[0]
            gx, gy, gz = gx + row[1], gy + row[2], gz + row[3]
            p, q, r = p + row[4], q + row[5], r + row[6]
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
