"""Blocks of positions, and what the signed distance of a point can be anywhere in a block.

A point that is moved by all positions of a block stays within the block's radius of where the
block's centre moves it: the values of the grid around that place bound its signed distance.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter1d

from chsel.numerics.arrays import FloatArray, IntArray
from chsel.problem.sdf_grid import SdfGrid

_HALVINGS = 3  # of a block, into up to eight
_TOPS = 48  # uppermost blocks at least
_REACH = 6.0  # cells that a radius may span, else cells are joined
_LEAST_OUTWARD = 1e-9
_UNSURE = 1e-6  # cells: nearer to a border than that, a position may be on either side


class Blocks(NamedTuple):
    """Positions in a forest of N blocks: the uppermost blocks first, single positions last."""

    centres: FloatArray  # (3, N), m
    layer: IntArray  # (N,) of each block
    starts: IntArray  # (N + 1,) the first block within each
    tops: int  # number of uppermost blocks
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
        layer=np.repeat(np.arange(len(layers)), [len(layer) for layer in layers]),
        starts=len(layers[0]) + np.concatenate([[0], np.cumsum(children)]),
        tops=len(layers[0]),
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
    + [("low", np.float64)]  # the box of the SDF grid, in cells: its lower side on all axes,
    + [(f"high_{axis}", np.float64) for axis in "xyz"]  # and its upper sides
    + [(f"most_{axis}", np.float64) for axis in "xyz"]  # the greatest index of a cell
    + [("across", np.float64)]  # steps in the table to the next cell on the first axis,
    + [("along", np.float64)]  # and on the second
    + [("row", np.float64)]  # of the first cell in the table
    + [("radius", np.float64)]  # m
    + [("unsure", np.float64)]  # cells: nearer to the border of a cell, its bounds do not hold
)


class DistanceBounds(NamedTuple):
    """What the signed distance is at least and at most within a radius of the points of a cell.

    A grid of cells for the radius of each layer of blocks. Beyond the box of the SDF grid, the
    distance is at least the root of reach * d^2 + s^2, with the distance d to the box and the
    lower bound s at the box's nearest point, if that is above 0.
    """

    layers: Any  # (L,) of BOUNDS_LAYER
    table: Any  # (cells, 2) least and greatest distance, m, the layers one after the other; float32
    reach: float


def bounds_of(sdf: SdfGrid, lookup: str, outside: str, radii: FloatArray) -> DistanceBounds:
    """Bounds of what a grid reads within each of the radii (L,), in metres, of any point.

    The last radius is that of single positions: no more than what rounding moves them.
    """
    key = ("bounds", lookup, outside, tuple(radii.tolist()))
    return sdf.derived(key, lambda: _bounds(sdf, lookup, outside, radii))


def _bounds(sdf: SdfGrid, lookup: str, outside: str, radii: FloatArray) -> DistanceBounds:
    lowest, highest, corner = _cells(sdf, lookup)
    deep = outside == "surface_point" and _points_outward(sdf)
    layers, tables, row = np.zeros(len(radii), dtype=BOUNDS_LAYER), [], 0
    for n, radius in enumerate(radii.tolist()):
        factor = max(1, int(radius / (_REACH * sdf.resolution)))
        size, unsure = factor * sdf.resolution, 0.0
        if n < len(radii) - 1:
            low = _least_around(_least_of_joined(lowest, factor), size, radius)
            high = -_least_around(_least_of_joined(-highest, factor), size, radius)
        else:
            low, high, unsure = lowest.copy(), highest, max(_UNSURE, radius / size)
        if not deep:
            _open_border(low, size, radius)
        _, ny, nz = low.shape
        layers[n] = (
            *corner,
            1.0 / size,
            (sdf.bounds[0] - corner)[0] / size,
            *(sdf.bounds[1] - corner) / size,
            *(np.array(low.shape) - 1),
            ny * nz,
            nz,
            row,
            radius,
            unsure,
        )
        table = np.stack([_rounded(low, -np.inf), _rounded(high, np.inf)], axis=-1)
        tables.append(table.reshape(-1, 2))
        row += low.size
    # With gradients that point away from the grid's box, the nearest surface point is nearer to
    # the box's inside, so that a way out of the box adds to the way to the surface.
    reach = 1.0 if deep or outside == "bounding_box" else 0.0
    return DistanceBounds(layers, np.concatenate(tables), reach)


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


def _rounded(values: FloatArray, towards: float) -> Any:
    """Numbers of 32 bits that are no nearer than `values` on the far side of them."""
    return np.nextafter(values.astype(np.float32), np.float32(towards))
