"""Which points of a lattice lie in given cells, looked up cell by cell.

A lattice coarser than the diagonal of a cell has at most one point in a cell: the one nearest to
the cell's centre. For few cells this is faster than culling many points.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import Box, Region, box_of, locate, triple
from chsel.numerics.compiler import compiled, spliced
from chsel.numerics.octree import Tree, copy_centre, rounding_margin

MOST_CELLS = 300  # for which this is faster than a walk of the tree
_TOLERANCE = 1e-6  # of the spacing: how far points may be off the lattice
_MOST_NODES_PER_POINT = 64


class LatticePoints(NamedTuple):
    """Points of a tree on a lattice, and the cells of a region; without cells it is not used."""

    box: Box  # the lattice with an empty layer around it
    point_at: Any  # (nodes,) number of the point there in the tree's order, -1 for none; int32
    centres: FloatArray  # (3, A) of the region's cells
    cells: Any  # (A,) flat indices of the region's cells, int32


NO_LATTICE = LatticePoints(
    box=box_of(np.zeros(3), 1.0, (1, 1, 1)),
    point_at=np.zeros(0, dtype=np.int32),
    centres=np.zeros((3, 0)),
    cells=np.zeros(0, dtype=np.int32),
)


def lattice_of(tree: Tree, spacing: float, region: Region) -> LatticePoints | None:
    """The tree's points as a lattice; None unless they form one that is coarse enough."""
    nodes = len(tree.starts) - 1
    points = tree.spheres[:3, nodes:]
    if points.shape[1] == 0:
        return None
    room = 0.5 * spacing - 0.5 * np.sqrt(3.0) / region.box.inverse
    lowest, highest = points.min(axis=1), points.max(axis=1)
    if not room > 2.0 * _TOLERANCE * spacing + rounding_margin(np.array([lowest, highest])):
        return None
    origin = lowest - spacing
    shape = np.rint((highest - origin) / spacing) + 2.0
    nodes_of_lattice = float(shape[0] * shape[1] * shape[2])
    if not nodes_of_lattice <= _MOST_NODES_PER_POINT * points.shape[1] + 1e6:
        return None
    point_at = np.full(int(nodes_of_lattice), -1, dtype=np.int32)
    if not _fill(points, origin, spacing, triple(shape), _TOLERANCE, point_at):
        return None
    box = box_of(origin, spacing, shape)
    cells = np.flatnonzero(region.clearance < 0.0)
    return LatticePoints(box, point_at, cell_centres(region), cells.astype(np.int32))


def cell_centres(region: Region) -> FloatArray:
    """Centres (3, A) of the cells of a region, in the order of their indices."""
    box, cells = region.box, np.flatnonzero(region.clearance < 0.0)
    plane, k = np.divmod(cells, int(box.along))
    index = np.stack([*np.divmod(plane, int(box.across / box.along)), k])
    return np.array(box.first)[:, None] + (index + 0.5 * box.between) / box.inverse


@compiled
def _fill(points, origin, spacing, counts, tolerance, point_at):
    """Number the nodes by the points (3, N) on them; False if one is off, or a node has two."""
    for n in range(points.shape[1]):
        node = 0.0
        for axis in range(3):
            place = (points[axis, n] - origin[axis]) / spacing
            nearest = np.rint(place)
            if not abs(place - nearest) <= tolerance:
                return False
            node = node * counts[axis] + nearest
        if point_at[int(node)] >= 0:
            return False
        point_at[int(node)] = n
    return True


@spliced
def look_up(lattice, tree, region, move, back, candidates):
    """Collect the points that lie in the region once moved, in ascending order; returns how many.

    Their numbers among the points are in candidates.kept.
    move: the map of points into the region's frame; back: its inverse. Both must be rigid.
    """
    spheres, nodes = tree.spheres, len(tree.starts) - 1
    centres, cells, point_at = lattice.centres, lattice.cells, lattice.point_at
    count = len(cells)
    places, numbers, wanted = candidates.places, candidates.kept, candidates.nodes
    x, y, z = candidates.x, candidates.y, candidates.z
    locate(back, lattice.box, centres[0], centres[1], centres[2], places, count)
    total = 0
    for n in range(count):
        point = point_at[places.cell[n]]
        wanted[total], numbers[total] = cells[n], point
        total += 1 if point >= 0 else 0
    for n in range(total):
        copy_centre(spheres, nodes + numbers[n], candidates, n)
    locate(move, region.box, x, y, z, places, total)
    count = 0
    for n in range(total):  # a point beside the cell that it was looked up for is left out
        numbers[count] = numbers[n]
        count += 1 if places.cell[n] == wanted[n] else 0
    _sort(numbers, count)
    for n in range(count):
        copy_centre(spheres, nodes + numbers[n], candidates, n)
    return count


@spliced
def _sort(numbers, count):
    """Insertion sort: there are few, and mostly in order."""
    for n in range(1, count):
        number, place = numbers[n], n
        while place > 0 and numbers[place - 1] > number:
            numbers[place] = numbers[place - 1]
            place -= 1
        numbers[place] = number
