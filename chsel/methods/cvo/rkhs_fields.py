"""The observed cloud as a function of a reproducing kernel Hilbert space (see rkhs_field)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from chsel.errors import SettingError
from chsel.methods.cvo.blur_kernels import (
    add_columns,
    blur_axis,
    fill_gaussian,
    splat,
    sum_of_pairs,
    sum_of_products,
)
from chsel.methods.cvo.cvo_kernels import ClassTerm, Product, products, scratch
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.cell_set import Box, box_of
from chsel.numerics.elementary import log
from chsel.numerics.threads import spread
from chsel.problem.sdf_grid import SdfGrid

MOST_NODES = 30_000_000
TRUNCATION = 3.5  # ell; beyond it lie 0.02 % of a Gaussian on either side
_MOST_REACH = 100_000
FINENESS = 10  # at least so many nodes of a field per ell, if the SDF has them


@dataclass(frozen=True)
class Kernel:
    """k(x, z) = amplitude exp(-|x - z|^2 / (2 ell^2)), metres; 0 from `radius` on."""

    ell: float
    amplitude: float
    radius: float = math.inf

    @classmethod
    def above(cls, ell: float, amplitude: float, least: float) -> Kernel:
        """0 where it is not above `least`: radius ell sqrt(2 ln(amplitude / least))."""
        if least == 0.0:
            return cls(ell, amplitude)
        return cls(ell, amplitude, ell * math.sqrt(2.0 * log(amplitude / least)))

    def weights(self, spacing: float, stride: int = 1) -> tuple[FloatArray, FloatArray]:
        """exp(-x^2 / (2 ell^2)) and -x times that at x = -K .. K spacings, K a whole stride."""
        reach = min(self.radius, TRUNCATION * self.ell) / spacing
        if not reach <= _MOST_REACH:
            raise SettingError(
                f"ell {self.ell} m reaches over {reach:.1e} nodes of {spacing} m; "
                f"accepted: at most {_MOST_REACH:_}, so a smaller ell"
            )
        reach = -(-math.ceil(reach) // stride) * stride
        weights, slopes = np.empty(2 * reach + 1), np.empty(2 * reach + 1)
        fill_gaussian(spacing, self.ell, weights, slopes)
        return weights, slopes


@dataclass(frozen=True, eq=False)
class ClassField:
    """f = sum_j k(., z_j) of one class of a cloud in the object frame.

    table (nodes, 4): f and its gradient at the nodes of the box, 32 bit. norm: <f, f>.
    """

    box: Box
    table: Any
    norm: float

    def term(self, points: FloatArray, weight: float) -> ClassTerm:
        """Its part of F, for points (N, 3) of the same class in the world."""
        return ClassTerm(points.T.copy(), self.box, self.table, weight)


def surface_field(sdf: SdfGrid, kernel: Kernel, band: float) -> ClassField:
    """Of the nodes of a signed distance grid within `band` metres of the surface."""
    key = "rkhs surface", kernel, band
    return sdf.derived(key, lambda: _class_field(sdf, np.abs(sdf.values) <= band, kernel))


def free_field(sdf: SdfGrid, kernel: Kernel, band: float) -> ClassField:
    """Of the nodes of a signed distance grid more than `band` metres outside."""
    key = "rkhs free", kernel, band
    return sdf.derived(key, lambda: _class_field(sdf, sdf.values > band, kernel))


def _class_field(sdf: SdfGrid, members: Any, kernel: Kernel) -> ClassField:
    stride = max(1, math.floor(kernel.ell / (FINENESS * sdf.resolution) + 1e-9))
    weights, slopes = kernel.weights(sdf.resolution, stride)
    reach = len(weights) // 2
    shape = [-(-(count - 1 + 2 * reach) // stride) + 1 for count in sdf.shape]
    if not math.prod(shape) <= MOST_NODES:
        raise SettingError(
            f"ell {kernel.ell} m makes a field of {math.prod(shape):.1e} nodes around an SDF of "
            f"resolution {sdf.resolution} m; accepted: at most {MOST_NODES:.0e}, so a smaller ell"
        )
    source = members.astype(np.float64)
    if kernel.radius < math.inf:
        ball = blurred_in_ball(source, weights, slopes, shape, stride, sdf.resolution, kernel)
        parts = list(ball)
    else:
        parts = _blurred(source, weights, slopes, shape, stride)
    table = np.empty((math.prod(shape), 4), dtype=np.float32)
    for channel, part in enumerate(parts):
        scale = kernel.amplitude / (kernel.ell * kernel.ell if channel else 1.0)
        table[:, channel] = scale * part.reshape(-1)
    first = sdf.origin - reach * sdf.resolution
    box = box_of(first, stride * sdf.resolution, shape, between=True)
    nodes = sdf.origin + np.argwhere(members) * sdf.resolution
    field = ClassField(box, table, 0.0)
    return ClassField(box, table, _sum_over(field, nodes))


def _sum_over(field: ClassField, points: FloatArray) -> float:
    """Sum of a field over points (N, 3) of its frame."""
    nothing = field.term(np.zeros((0, 3)), 0.0)
    pose = np.concatenate([np.eye(3).reshape(-1), np.zeros(3)])[None]
    out = np.empty(1)
    product = Product(field.term(points, 1.0), nothing, nothing)
    products(product, pose, out, 0, 1, scratch())
    return float(out[0])


def blurred_along(source: FloatArray, weights: FloatArray, stride: int, count: int) -> FloatArray:
    """Source (A, n, C) blurred along its middle axis, of which `count` rows come out."""
    out = np.empty((source.shape[0], count, source.shape[2]))

    def run(first: int, last: int, _: Any) -> None:
        blur_axis(source, weights, stride, first, last, out)

    spread(run, count, lambda: None)
    return out


def _blurred(
    source: FloatArray, weights: FloatArray, slopes: FloatArray, shape: list[int], stride: int
) -> list[FloatArray]:
    """Value and gradient times ell^2 (each of `shape`): three passes, the last axis first."""
    nx, ny, nz = source.shape
    mx, my, mz = shape

    def along_z(kernel: FloatArray) -> FloatArray:
        return blurred_along(source.reshape(nx * ny, nz, 1), kernel, stride, mz).reshape(nx, ny, mz)

    def along_y(part: FloatArray, kernel: FloatArray) -> FloatArray:
        return blurred_along(part, kernel, stride, my).reshape(1, nx, my * mz)

    def along_x(part: FloatArray, kernel: FloatArray) -> FloatArray:
        return blurred_along(part, kernel, stride, mx)

    z, dz = along_z(weights), along_z(slopes)
    zy, zdy, dzy = along_y(z, weights), along_y(z, slopes), along_y(dz, weights)
    return [along_x(zy, weights), along_x(zy, slopes), along_x(zdy, weights), along_x(dzy, weights)]


def _add_columns(
    columns: Any,
    slopes: Any,
    offsets: Any,
    weights: Any,
    stride: Any,
    spacing: Any,
    out: Any,
    first: Any,
    last: Any,
    _: Any,
) -> None:
    add_columns(columns, slopes, offsets, weights, stride, spacing, first, last, out)


def blurred_in_ball(
    source: FloatArray,
    weights: FloatArray,
    slopes: FloatArray,
    shape: list[int],
    stride: int,
    spacing: float,
    kernel: Kernel,
) -> FloatArray:
    """Value and gradient times ell^2 (4, *shape) of a kernel that ends at a radius.

    For every length that a column along z may have within the ball: the source blurred along z
    that far, then added up over the columns at the distances that leave this length.
    """
    reach = len(weights) // 2
    offsets = np.indices((2 * reach + 1, 2 * reach + 1)).reshape(2, -1).T - reach  # (P, 2)
    radius = min(kernel.radius, TRUNCATION * kernel.ell)
    left = (radius / spacing) ** 2 - (offsets * offsets)[:, 0] - (offsets * offsets)[:, 1]
    length = np.ceil(np.sqrt(np.maximum(left, 0.0))) - 1.0  # the most spacings below the radius
    nx, ny, _ = source.shape
    columns, slants = np.zeros((nx, ny, shape[2])), np.zeros((nx, ny, shape[2]))
    out = np.zeros((4, *shape))
    padded = np.pad(source, ((0, 0), (0, 0), (2 * reach, 2 * reach + stride)))
    for depth in range(int(length.max(initial=-1.0)) + 1):
        for offset in (depth, -depth)[: 1 + (depth > 0)]:
            start = reach - offset
            part = padded[:, :, start : start + stride * (shape[2] - 1) + 1 : stride]
            columns += weights[offset + reach] * part
            slants += slopes[offset + reach] * part
        add = partial(_add_columns, columns, slants, offsets[length == depth], weights)
        spread(partial(add, stride, spacing, out), shape[0], lambda: None)
    return out


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
