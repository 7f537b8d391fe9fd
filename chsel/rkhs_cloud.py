"""The observed cloud as a function of a reproducing kernel Hilbert space (see rkhs_field)."""

from __future__ import annotations

import math

import numpy as np

from chsel.arrays import FloatArray, IntArray
from chsel.errors import SettingError
from chsel.kernels.gaussian_blur import splat, sum_of_pairs, sum_of_products
from chsel.rkhs_field import MOST_NODES, Kernel, blurred_along, blurred_in_ball

_FEW, _MANY = 2000, 50_000  # points that are, and that may be, taken one by one
_FAR = 8.0  # ell; nothing is left of a kernel there
_SHARED_FINENESS = 4  # nodes per ell that points are shared out among
_ON_LATTICE = 1e-6  # spacings that a point may be away from a node


def cloud_norm(points: FloatArray, kernel: Kernel, lattice: float) -> float:
    """<f, f> of a cloud (N, 3): the sum over all pairs, one by one if they are few.

    Of more, the sum over a grid: of spacing `lattice`, metres, if every point is at a node, which
    is as exact as a field; else of a quarter of ell, with points shared out among the nodes
    around, within 1 %. Points that span too large a grid are taken one by one, too.
    """
    if len(points) <= _FEW:
        return _pair_by_pair(points, kernel)
    nodes, spacing, narrow = _nodes_of(points, lattice), lattice, kernel
    if nodes is None:
        spacing = kernel.ell / _SHARED_FINENESS
        narrow = _narrowed(kernel, spacing)
    first = points.min(axis=0)
    with np.errstate(over="ignore"):
        sides = np.floor((points.max(axis=0) - first) / spacing + 0.5) + 2.0
    reach = len(narrow.weights(spacing)[0]) // 2
    if not math.prod((sides + 2.0 * reach).tolist()) <= MOST_NODES:
        return _pair_by_pair(points, kernel)
    grid = np.zeros([int(side) for side in sides])
    if nodes is None:
        splat(points, first, 1.0 / spacing, grid)
    else:
        np.add.at(grid, tuple(nodes.T), 1.0)
    inside = _blurred_alike(grid, narrow, spacing).reshape(-1)
    return narrow.amplitude * sum_of_products(grid.reshape(-1), inside)


def _pair_by_pair(points: FloatArray, kernel: Kernel) -> float:
    if len(points) > _MANY:
        raise SettingError(
            f"{len(points)} points of one class are far apart; accepted: at most {_MANY:_}, or "
            "points within a box that is small beside ell"
        )
    radius = min(kernel.radius, _FAR * kernel.ell)
    return kernel.amplitude * sum_of_pairs(points, kernel.ell, radius, 0, len(points))


def _narrowed(kernel: Kernel, spacing: float) -> Kernel:
    """The kernel that is widened to this one by sharing out points among nodes.

    Either point of a pair is spread with a variance of spacing^2 / 6 along an axis, in the mean.
    """
    ell = math.sqrt(kernel.ell * kernel.ell - spacing * spacing / 3.0)
    widening = kernel.ell / ell
    gain = widening * widening * widening
    return Kernel(ell, kernel.amplitude * gain, kernel.radius)


def _nodes_of(points: FloatArray, lattice: float) -> IntArray | None:
    """Indices (N, 3) of lattice nodes from the first on, or None if points are elsewhere."""
    with np.errstate(over="ignore", invalid="ignore"):
        steps = (points - points.min(axis=0)) / lattice
        nodes = np.rint(steps)
        if not (np.abs(steps - nodes) < _ON_LATTICE).all() or nodes.max() >= 2.0**20:
            return None
    return nodes.astype(np.int64)


def _blurred_alike(grid: FloatArray, kernel: Kernel, spacing: float) -> FloatArray:
    """A grid blurred, at its own nodes."""
    weights, slopes = kernel.weights(spacing)
    reach = len(weights) // 2
    nx, ny, nz = grid.shape
    inside = tuple(slice(reach, reach + side) for side in grid.shape)
    if kernel.radius < math.inf:
        around = [side + 2 * reach for side in grid.shape]
        parts = blurred_in_ball(grid, weights, slopes, around, 1, spacing, kernel)
        return parts[0][inside].copy()
    part = blurred_along(grid.reshape(nx * ny, nz, 1), weights, 1, nz + 2 * reach)[:, inside[2]]
    part = part.reshape(nx, ny, nz)
    part = blurred_along(part, weights, 1, ny + 2 * reach)[:, inside[1]].reshape(1, nx, ny * nz)
    return blurred_along(part, weights, 1, nx + 2 * reach)[0, inside[0]].copy()


def blocks_of(points: FloatArray, ell: float, lattice: float) -> tuple[FloatArray, FloatArray, int]:
    """Points (N, 3) left alone, centres (C, 3) of full cubes of lattice points, points per side.

    A cube's side is at most half of ell, so that its sum of kernels is that of one wider kernel
    (see `of_block`). A cloud of few points, or off the lattice, has no cubes.
    """
    side, none = math.floor(0.5 * ell / lattice), np.zeros((0, 3))
    nodes = _nodes_of(points, lattice) if len(points) > _FEW and side > 1 else None
    if nodes is None:
        return points, none, 1
    cubes = nodes // side
    _, count_y, count_z = cubes.max(axis=0) + 1
    keys = (cubes[:, 0] * count_y + cubes[:, 1]) * count_z + cubes[:, 2]
    _, first, cube, counts = np.unique(
        keys, return_index=True, return_inverse=True, return_counts=True
    )
    full = counts == side**3
    centres = (cubes[first[full]] * side + (side - 1) / 2.0) * lattice + points.min(axis=0)
    return points[~full[cube]], centres, side


def of_block(kernel: Kernel, lattice: float, side: int) -> Kernel:
    """The kernel of a cube of side^3 lattice points seen as one point at its centre.

    Its variance is that of the kernel and of the cube together, which along every direction is
    lattice^2 (side^2 - 1) / 12; its integral that of all. It differs in fourth moments, by less
    than 1e-3 of the cube's sum while the cube's side is at most half of ell.
    """
    spread = lattice * lattice * (side * side - 1) / 12.0
    ell = math.sqrt(kernel.ell * kernel.ell + spread)
    narrowing = kernel.ell / ell
    gain = side**3 * narrowing * narrowing * narrowing
    return Kernel(ell, kernel.amplitude * gain)
