"""Signed distances and gradients as kernels read them from a grid."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import Box, CellSet, box_of, cell_set_of
from chsel.numerics.compiler import leaf
from chsel.numerics.pose_tuples import moved
from chsel.problem.sdf_grid import SdfGrid


class DistanceField(NamedTuple):
    """Signed distances and gradients at the nodes of a grid."""

    box: Box  # of the grid
    table: FloatArray  # (4 nodes,): value and gradient of each node, one after the other
    trilinear: bool  # interpolate, else read the nearest node
    box_distance: bool  # how distances continue outside of the grid, see SdfGrid.at


def distance_field(sdf: SdfGrid, lookup: str, *, outside: str) -> DistanceField:
    """Return the signed distance field that kernels read; lookup, outside: see SdfGrid.at."""
    trilinear = lookup == "trilinear"
    box = box_of(sdf.origin, sdf.resolution, shape=sdf.shape, between=trilinear)
    return DistanceField(
        box, sdf.table.reshape(-1), trilinear=trilinear, box_distance=outside == "bounding_box"
    )


def cells_below(sdf: SdfGrid, level: float, *, lookup: str) -> CellSet:
    """Return the cells of a grid that read any value below `level`, derived once."""

    def make() -> CellSet:
        box = box_of(sdf.origin, sdf.resolution, shape=sdf.shape, between=lookup == "trilinear")
        return cell_set_of(box, sdf.active_cells(level, lookup))

    return sdf.derived(("cells below", level, lookup), make)


@leaf
def distance_in_box(field, places, n):
    """Return signed distance and gradient (s, n_x, n_y, n_z) at place n, which is in the box."""
    table, at = field.table, np.uint64(places.cell[n])
    if field.trilinear:
        u, v, w = places.u[n], places.v[n], places.w[n]
        return distance_between_nodes(field.box, table, at, u, v, w)
    return at_node(table, at)


@leaf
def at_node(table, node):
    """Return signed distance and gradient of a node."""
    at = np.uint64(4) * np.uint64(node)
    s, nx = table[at], table[at + np.uint64(1)]
    return s, nx, table[at + np.uint64(2)], table[at + np.uint64(3)]


@leaf
def distance_between_nodes(box, table, base, u, v, w):
    """Return distance and gradient in the cell of lowest node `base`, at fractions u, v, w."""
    # Unsigned, as an index that may be negative costs more instructions than the sum.
    across, along = np.uint64(np.int64(box.across)), np.uint64(np.int64(box.along))
    lowest = np.uint64(base)
    s = 0.0
    nx = 0.0
    ny = 0.0
    nz = 0.0
    for corner in range(8):
        a, b, c = corner >> 2, (corner >> 1) & 1, corner & 1
        weight = (u if a else 1.0 - u) * (v if b else 1.0 - v) * (w if c else 1.0 - w)
        at = lowest + np.uint64(a) * across + np.uint64(b) * along + np.uint64(c)
        d, e, f, g = at_node(table, at)
        s += weight * d
        nx += weight * e
        ny += weight * f
        nz += weight * g
    return s, nx, ny, nz


@leaf
def distance_beyond_box(box_distance, box, inside, x, y, z):
    """Return distance and gradient at a point x, y, z outside, from those nearest in the box."""
    s, nx, ny, nz = inside
    first, last = box.first, box.last
    ax = x - min(max(x, first[0]), last[0])
    ay = y - min(max(y, first[1]), last[1])
    az = z - min(max(z, first[2]), last[2])
    if not box_distance:
        length = max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
        ax += s * (nx / length)
        ay += s * (ny / length)
        az += s * (nz / length)
    length = max(np.sqrt(ax * ax + ay * ay + az * az), 1e-12)
    return length, ax / length, ay / length, az / length


@leaf
def distance_in_place(field, pose, x, y, z, places, n):
    """Return distance and gradient of a world point x, y, z, whose place is the n-th."""
    inside = distance_in_box(field, places, n)
    if places.beyond[n] > 0.0:
        x, y, z = moved(pose, x, y, z)
        return distance_beyond_box(field.box_distance, field.box, inside, x, y, z)
    return inside


@leaf
def distance_at(field, pose, x, y, z):
    """Return interpolated signed distance at a world point."""
    box, table = field.box, field.table
    a, b, c = moved(pose, x, y, z)
    cell, is_beyond = cell_of(box, a, b, c)
    s = value_between_nodes(table, *cell)
    if is_beyond:
        _, nx, ny, nz = _row_in_cell(box, table, cell)
        s = distance_beyond_box(field.box_distance, box, (s, nx, ny, nz), a, b, c)[0]
    return s


@leaf
def distance_with_gradient(field, pose, x, y, z):
    """Return interpolated signed distance and gradient (s, n_x, n_y, n_z) at a world point."""
    box, table = field.box, field.table
    a, b, c = moved(pose, x, y, z)
    cell, is_beyond = cell_of(box, a, b, c)
    s = value_between_nodes(table, *cell)
    _, nx, ny, nz = _row_in_cell(box, table, cell)
    if is_beyond:
        return distance_beyond_box(field.box_distance, box, (s, nx, ny, nz), a, b, c)
    return s, nx, ny, nz


@leaf
def cell_of(box, a, b, c):
    """Return the arguments of `value_between_nodes`, and whether a point is beyond the box.

    The arguments are those of the nearest point of the box then.
    """
    first = box.first
    last = box.last
    most = box.most
    inverse = box.inverse
    d = min(max(first[0], a), last[0])
    e = min(max(first[1], b), last[1])
    f = min(max(first[2], c), last[2])
    u, v, w = (d - first[0]) * inverse, (e - first[1]) * inverse, (f - first[2]) * inverse
    i = min(np.floor(u), most[0])
    j = min(np.floor(v), most[1])
    k = min(np.floor(w), most[2])
    across, along = int(box.across), int(box.along)
    at = int(i) * across + int(j) * along + int(k)
    return (at, across, along, u - i, v - j, w - k), a != d or b != e or c != f


@leaf
def _row_in_cell(box, table, cell):
    at, _, _, u, v, w = cell
    return distance_between_nodes(box, table, at, u, v, w)


@leaf
def value_between_nodes(table, at, across, along, u, v, w):
    """Return the distance in the cell of lowest node `at`, at fractions u, v, w of its sides."""
    low, high = 1.0 - w, w
    next_node = np.uint64(4)
    at, along = next_node * np.uint64(at), next_node * np.uint64(along)
    a = low * table[at] + high * table[at + next_node]
    b = low * table[at + along] + high * table[at + along + next_node]
    at += next_node * np.uint64(across)
    c = low * table[at] + high * table[at + next_node]
    d = low * table[at + along] + high * table[at + along + next_node]
    return (1.0 - u) * ((1.0 - v) * a + v * b) + u * ((1.0 - v) * c + v * d)
