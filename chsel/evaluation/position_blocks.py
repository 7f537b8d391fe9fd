"""Positions in blocks of blocks, and bounds of the signed distance within a block's radius."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.ndimage import minimum_filter1d

from chsel.arrays import FloatArray
from chsel.kernels.plausible import Blocks, Bounds
from chsel.sdf import SdfGrid

_HALVINGS = 3  # of a block, into up to eight
_TOPS = 48  # uppermost blocks at least
_REACH = 6.0  # cells that a radius may span, else cells are joined
_LEAST_OUTWARD = 1e-9
_UNSURE = 1e-6  # cells: nearer to a border than that, a position may be on either side


def blocks_of(positions: FloatArray, margin: float) -> tuple[Blocks, FloatArray]:
    """The forest of blocks over positions (P, 3), and the radius (L,) of each of its layers.

    margin: metres that every radius is more than it need be.
    """
    layers = [[np.arange(len(positions))]]
    parents: list[list[int]] = []
    while any(len(block) > 1 for block in layers[-1]):
        split = [_split(positions, block, _HALVINGS) for block in layers[-1]]
        parents.append([len(parts) for parts in split])
        layers.append([part for parts in split for part in parts])
    first = next((n for n, layer in enumerate(layers) if len(layer) >= _TOPS), len(layers) - 1)
    layers, counts = layers[first:], parents[first:]
    blocks = [block for layer in layers for block in layer]
    centres = np.array([_centre(positions[block]) for block in blocks])
    layer_of = np.repeat(np.arange(len(layers)), [len(layer) for layer in layers])
    children = np.zeros(len(blocks), dtype=np.int64)
    children[: len(blocks) - len(layers[-1])] = [n for layer in counts for n in layer]
    starts = len(layers[0]) + np.concatenate([[0], np.cumsum(children)])
    position = np.full(len(blocks), -1)
    position[-len(layers[-1]) :] = [block[0] for block in layers[-1]]
    radii = [max(_radius(positions[block]) for block in layer) for layer in layers]
    forest = Blocks(centres.T.copy(), layer_of, starts, len(layers[0]), position)
    return forest, np.array(radii) * (1.0 + 1e-9) + margin


def bounds_of(sdf: SdfGrid, lookup: str, outside: str, radii: FloatArray) -> Bounds:
    """Bounds of what a grid reads within each of the radii (L,), in metres, of any point.

    The last radius is that of single positions: no more than what rounding moves them.
    """
    key = ("bounds", lookup, outside, tuple(radii.tolist()))
    return sdf.derived(key, lambda: _bounds(sdf, lookup, outside, radii))


def _split(positions: FloatArray, block: np.ndarray, halvings: int) -> list[np.ndarray]:
    """Halve a block along its longest side, and its halves again."""
    if halvings == 0 or len(block) == 1:
        return [block]
    extent = np.ptp(positions[block], axis=0)
    order = np.argsort(positions[block, int(np.argmax(extent))], kind="stable")
    middle = (len(block) + 1) // 2
    parts = block[order[:middle]], block[order[middle:]]
    return [piece for part in parts for piece in _split(positions, part, halvings - 1)]


def _centre(points: FloatArray) -> FloatArray:
    if len(points) == 1:
        return points[0]
    return (points.min(axis=0) + points.max(axis=0)) / 2.0


def _radius(points: FloatArray) -> float:
    if len(points) == 1:
        return 0.0
    return float(np.sqrt(((points - _centre(points)) ** 2).sum(axis=1).max()))


def _bounds(sdf: SdfGrid, lookup: str, outside: str, radii: FloatArray) -> Bounds:
    lowest, highest, corner = _cells(sdf, lookup)
    deep = outside == "surface_point" and _points_outward(sdf)
    tables, numbers, row = [], [], 0
    for n, radius in enumerate(radii.tolist()):
        factor = max(1, int(radius / (_REACH * sdf.resolution)))
        size, unsure = factor * sdf.resolution, 0.0
        if n < len(radii) - 1:
            low = _around(_joined(lowest, factor), size, radius)
            high = -_around(_joined(-highest, factor), size, radius)
        else:
            low, high, unsure = lowest.copy(), highest, max(_UNSURE, radius / size)
        if not deep:
            _open_border(low, size, radius)
        box = [*(sdf.bounds[0] - corner)[:1] / size, *(sdf.bounds[1] - corner) / size]
        _, ny, nz = low.shape
        numbers.append(
            [
                *corner,
                1.0 / size,
                *box,
                *(np.array(low.shape) - 1),
                ny * nz,
                nz,
                row,
                radius,
                unsure,
            ]
        )
        table = np.stack([_rounded(low, -np.inf), _rounded(high, np.inf)], axis=-1)
        tables.append(table.reshape(-1, 2))
        row += low.size
    # With gradients that point away from the grid's box, the nearest surface point is nearer to
    # the box's inside, so that a way out of the box adds to the way to the surface.
    reach = 1.0 if deep or outside == "bounding_box" else 0.0
    table = np.concatenate(tables)
    return Bounds(np.array(numbers, dtype=np.float64), table, reach)


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


def _joined(values: FloatArray, factor: int) -> FloatArray:
    """Least values of cubes of so many cells along each side."""
    pad = [(0, -count % factor) for count in values.shape]
    padded = np.pad(values, pad, mode="edge")
    a, b, c = (count // factor for count in padded.shape)
    cubes = padded.reshape(a, factor, b, factor, c, factor)
    return cubes.min(axis=(1, 3, 5))


def _around(values: FloatArray, size: float, radius: float) -> FloatArray:
    """The least value of all cells that have a point within a radius of a point of each cell."""
    reach = int(np.floor(radius / size)) + 1
    gap = np.maximum(np.abs(np.arange(-reach, reach + 1)) - 1, 0) * size
    columns: dict[int, FloatArray] = {}
    out = np.full(values.shape, np.inf)
    shape = values.shape
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            left = radius**2 - gap[i + reach] ** 2 - gap[j + reach] ** 2
            if left < 0.0:
                continue
            length = int(np.floor(np.sqrt(left) / size)) + 1
            if length not in columns:
                columns[length] = minimum_filter1d(values, 2 * length + 1, axis=2, mode="nearest")
            to_x, from_x = _shifted(i, shape[0])
            to_y, from_y = _shifted(j, shape[1])
            target = out[to_x, to_y]
            np.minimum(target, columns[length][from_x, from_y], out=target)
    return out


def _shifted(step: int, count: int) -> tuple[slice, slice]:
    """Where cells are, and those `step` cells on."""
    step = max(-count, min(step, count))
    return slice(max(-step, 0), count - max(step, 0)), slice(max(step, 0), count + min(step, 0))


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
