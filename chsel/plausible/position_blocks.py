"""Blocks of positions, and what the signed distance of a point can be anywhere in a block.

A point that is moved by all positions of a block stays within the block's radius of where the
block's centre moves it: the values of the grid around that place bound its signed distance.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter1d

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.problem.sdf_grid import SdfGrid

_HALVINGS = 3  # of a block, into up to eight
_TOPS = 48  # uppermost blocks at least
_REACH = 6.0  # cells that a radius may span, else cells are joined
_PADDING = 2  # cells around the SDF grid, beyond the radius
_LEAST_OUTWARD = 1e-9


class Blocks(NamedTuple):
    """Positions in a forest of N blocks: the uppermost blocks first, single positions last."""

    centres: FloatArray  # (3, N), m
    layers: IntArray  # (L + 1,) the first block of each layer, then N
    starts: IntArray  # (N + 1,) the first block within each
    position: IntArray  # (N,) number of a block's only position, -1 for a block of several
    radii: FloatArray  # (L,) of the blocks of each layer, m


def blocks_of(positions: FloatArray, margin: float) -> Blocks:
    """The blocks of positions (P, 3); every radius has a margin in metres added."""
    layers = [[np.arange(len(positions))]]
    counts: list[list[int]] = []
    while any(len(block) > 1 for block in layers[-1]):
        split = [_split(positions, block, _HALVINGS) for block in layers[-1]]
        counts.append([len(parts) for parts in split])
        layers.append([part for parts in split for part in parts])
    first = next((n for n, layer in enumerate(layers) if len(layer) >= _TOPS), len(layers) - 1)
    layers, counts = layers[first:], counts[first:]
    spheres = [[_centre_and_radius(positions[block]) for block in layer] for layer in layers]
    children = [n for layer in counts for n in layer] + [0] * len(layers[-1])
    position = np.full(len(children), -1)
    position[-len(layers[-1]) :] = [block[0] for block in layers[-1]]
    radii = np.array([max(radius for _, radius in layer) for layer in spheres])
    return Blocks(
        centres=np.array([centre for layer in spheres for centre, _ in layer]).T.copy(),
        layers=np.concatenate([[0], np.cumsum([len(layer) for layer in layers])]),
        starts=len(layers[0]) + np.concatenate([[0], np.cumsum(children)]),
        position=position,
        radii=radii * (1.0 + 1e-9) + margin,
    )


def _split(positions: FloatArray, block: IntArray, halvings: int) -> list[IntArray]:
    """Halve a block along its longest side, and its halves again."""
    if halvings == 0 or len(block) == 1:
        return [block]
    extent = np.ptp(positions[block], axis=0)
    order = np.argsort(positions[block, int(np.argmax(extent))], kind="stable")
    middle = (len(block) + 1) // 2
    halves = block[order[:middle]], block[order[middle:]]
    return [part for half in halves for part in _split(positions, half, halvings - 1)]


def _centre_and_radius(points: FloatArray) -> tuple[FloatArray, float]:
    """Of a sphere around points (P, 3)."""
    if len(points) == 1:
        return points[0], 0.0
    centre = (points.min(axis=0) + points.max(axis=0)) / 2.0
    return centre, float(np.sqrt(((points - centre) ** 2).sum(axis=1).max()))


BOUNDS_LAYER = np.dtype(
    [(f"corner_{axis}", np.float64) for axis in "xyz"]  # of the first cell, object frame, m
    + [("inverse", np.float64)]  # cells per metre
    + [(f"most_{axis}", np.float32) for axis in "xyz"]  # the greatest index of a cell
    + [("across", np.int32)]  # steps in the table to the next cell on the first axis,
    + [("along", np.int32)]  # and on the second
    + [("row", np.int32)]  # of the first cell in the table
    + [("unknown", np.int32)]  # row of what bounds nothing
    + [("unsure", np.float32)]  # cells: nearer to the border of a cell, its bounds do not hold
)


class DistanceBounds(NamedTuple):
    """How far from a value v the signed distance is at least within a radius of points of a cell.

    A grid of cells for the radius of each layer of blocks, which reaches beyond the SDF's; beyond
    its outermost cells, the distance is no less than there. With a common v of all points, the
    table has max(least - v, v - most, 0) and 0, else the least distance and minus the most.
    """

    layers: Any  # (L,) of BOUNDS_LAYER
    table: Any  # (2, cells), m, the layers one after the other; float32
    common: bool  # whether v is that of all points


def bounds_of(
    sdf: SdfGrid,
    lookup: str,
    outside: str,
    radii: FloatArray,
    *,
    value: float | None,
    slack: float,
) -> DistanceBounds:
    """Bounds of what a grid reads within each of the radii (L,), in metres, of any point.

    The last radius is that of single positions: no more than what rounding moves them. value: v,
    None if points differ. slack: cells that a point may be away from where it is looked up.
    """
    key = ("bounds", lookup, outside, tuple(radii.tolist()), value, slack)
    return sdf.derived(key, lambda: _bounds(sdf, lookup, outside, radii, value, slack))


def _bounds(
    sdf: SdfGrid,
    lookup: str,
    outside: str,
    radii: FloatArray,
    value: float | None,
    slack: float,
) -> DistanceBounds:
    lowest, highest, corner = _cells(sdf, lookup)
    deep = outside == "surface_point" and _points_outward(sdf)
    # With gradients that point away from the grid's box, the nearest surface point is nearer to
    # the box's inside, so that a way out of the box adds to the way to the surface.
    adds = deep or outside == "bounding_box"
    layers, tables, row = np.zeros(len(radii), dtype=BOUNDS_LAYER), [], 0
    for n, radius in enumerate(radii.tolist()):
        factor = max(1, int(radius / (_REACH * sdf.resolution)))
        size, unsure = factor * sdf.resolution, -1.0
        if n < len(radii) - 1:
            radius += slack * size
            low = _least_around(_least_of_joined(lowest, factor), size, radius)
            high = -_least_around(_least_of_joined(-highest, factor), size, radius)
        else:
            low, high, unsure = lowest.copy(), highest, slack + radius / size
        if not deep:
            _open_border(low, size, radius)
        padding = math.ceil(radius / size) + _PADDING
        low, high = _padded(sdf, low, high, corner, size, radius, padding=padding, adds=adds)
        _, ny, nz = low.shape
        unknown = row + low.size
        shape = np.array(low.shape) - 1
        first = corner - padding * size
        layers[n] = (*first, 1.0 / size, *shape, ny * nz, nz, row, unknown, unsure)
        tables.append(_table(low.reshape(-1), high.reshape(-1), value))
        row = unknown + 1
    return DistanceBounds(layers, np.concatenate(tables, axis=1), value is not None)


def _padded(
    sdf: SdfGrid,
    low: FloatArray,
    high: FloatArray,
    corner: FloatArray,
    size: float,
    radius: float,
    *,
    padding: int,
    adds: bool,
) -> tuple[FloatArray, FloatArray]:
    """Bounds of cells (nx, ny, nz) with those of so many around; `adds`: see `_bounds`.

    Where all within the radius is beyond the SDF grid at a distance d, its distance is at least
    |s|, or the root of d^2 + s^2, with the lower bound s at the nearest point of the grid, if that
    is above 0. Where the greatest distance is positive, some of it may be beyond the grid, where
    it does not hold.
    """
    gaps = []
    for axis in range(3):
        cells = np.arange(-padding, low.shape[axis] + padding)
        first, last = (sdf.bounds[:, axis] - corner[axis]) / size
        gaps.append(np.maximum(np.maximum(first - (cells + 1), cells - last), 0.0) ** 2)
    away = np.sqrt(gaps[0][:, None, None] + gaps[1][:, None] + gaps[2]) * (size - 1e-6 * size)
    away = np.maximum(away - radius, 0.0)
    low, high = np.pad(low, padding, mode="edge"), np.pad(high, padding, mode="edge")
    beyond = np.sqrt((away**2 if adds else 0.0) + np.maximum(low, 0.0) ** 2)
    high = np.where((high < 0.0) & (away == 0.0), high, np.inf)
    return np.where(away > 0.0, beyond, low), high


def _table(low: FloatArray, high: FloatArray, value: float | None) -> Any:
    """The table (2, cells + 1) of a layer, see DistanceBounds, rounded down; last: no bound."""
    if value is None:
        return _rounded(np.append([low, -high], [[-np.inf], [-np.inf]], axis=1))
    bound = np.maximum(np.maximum(low - value, value - high), 0.0)
    table = np.zeros((2, len(low) + 1), dtype=np.float32)
    table[0, :-1] = np.maximum(_rounded(bound), 0.0)
    return table


def _cells(sdf: SdfGrid, lookup: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Least and greatest value that each cell reads, and the corner (3,) of the first cell."""
    values = sdf.values
    if lookup == "nearest":
        return values, values, sdf.origin - 0.5 * sdf.resolution
    nx, ny, nz = (count - 1 for count in sdf.shape)
    corners = [values[i : i + nx, j : j + ny, k : k + nz] for i, j, k in np.ndindex(2, 2, 2)]
    rounding = 1e-12 * (1.0 + np.abs(values).max())  # of interpolation
    low, high = np.minimum.reduce(corners), np.maximum.reduce(corners)
    return low - rounding, high + rounding, sdf.origin


def _least_of_joined(values: FloatArray, factor: int) -> FloatArray:
    """Least values of cubes of `factor` cells along each side."""
    padded = np.pad(values, [(0, -count % factor) for count in values.shape], mode="edge")
    a, b, c = (count // factor for count in padded.shape)
    return padded.reshape(a, factor, b, factor, c, factor).min(axis=(1, 3, 5))


def _least_around(values: FloatArray, size: float, radius: float) -> FloatArray:
    """The least value of all cells that have a point within a radius of a point of each cell."""
    reach = int(np.floor(radius / size)) + 1
    gap = np.maximum(np.abs(np.arange(-reach, reach + 1)) - 1, 0) * size
    left = radius**2 - gap[:, None] ** 2 - gap**2
    nx, ny, _ = values.shape
    columns: dict[int, FloatArray] = {}
    out = np.full(values.shape, np.inf)
    for i, j in np.argwhere(left >= 0.0):
        length = int(np.floor(np.sqrt(left[i, j]) / size)) + 1
        if length not in columns:
            column = minimum_filter1d(values, 2 * length + 1, axis=2, mode="nearest")
            pad = (reach, reach), (reach, reach), (0, 0)
            columns[length] = np.pad(column, pad, constant_values=np.inf)
        np.minimum(out, columns[length][i : i + nx, j : j + ny], out=out)
    return out


def _open_border(low: FloatArray, size: float, radius: float) -> None:
    """Beyond the grid any distance down to 0 may be read: also by what comes near its border."""
    depth = int(np.floor(radius / size)) + 1
    for axis in range(3):
        index = np.arange(low.shape[axis])
        near = (index < depth) | (index >= low.shape[axis] - depth)
        part = np.moveaxis(low, axis, 0)
        part[near] = np.minimum(part[near], 0.0)


def _points_outward(sdf: SdfGrid) -> bool:
    """Whether the gradients on every face of the grid point out of it."""
    for axis in range(3):
        for end, sign in ((0, -1.0), (-1, 1.0)):
            face = np.take(sdf.gradients[..., axis], end, axis=axis)
            if (sign * face).min() <= _LEAST_OUTWARD:
                return False
    return True


def _rounded(values: FloatArray) -> Any:
    """Lower numbers of 32 bits."""
    return np.nextafter(values.astype(np.float32), np.float32(-np.inf))
