"""Clouds of points as functions f = sum_j k(., z_j) of a reproducing kernel Hilbert space.

A cloud in the object frame becomes a table of f on a grid: nodes of the SDF, blurred. Of the
observed cloud the norm alone is needed, and cubes of free points in place of the points, which are
many. Numbers of a field are of 32 bits, sums of 64.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from chsel.errors import SettingError
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.numerics.cell_set import Box, box_of
from chsel.numerics.compiler import compiled, inner
from chsel.numerics.elementary import exp, exps
from chsel.numerics.pose_tuples import moved, pose_at
from chsel.numerics.threads import spread
from chsel.problem.poses import Poses
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.sdf_lookup import cell_of, distance_between_nodes, value_between_nodes

MOST_NODES = 30_000_000
FINENESS = 10  # at least so many nodes of a field per ell, if the SDF has them
TRUNCATION = 3.5  # ell; beyond it lie 0.02 % of a Gaussian on either side
_FEW, _MANY = 2000, 50_000  # points that are, and that may be, taken one by one
_FAR = 8.0  # ell; nothing is left of a kernel there
_SNAPPED_FINENESS = 4  # nodes per ell that points are moved to
_ON_LATTICE = 1e-6  # spacings that a point may be away from a node


@dataclass(frozen=True)
class Kernel:
    """k(x, z) = amplitude exp(-|x - z|^2 / (2 ell^2)), metres."""

    ell: float
    amplitude: float = 1.0

    def widened(self, variance: float, mass: float = 1.0) -> Kernel:
        """Spread by that variance along each axis, m^2, which may be negative; `mass` of them."""
        ell = math.sqrt(self.ell * self.ell + variance)
        ratio = self.ell / ell
        return Kernel(ell, self.amplitude * (mass * ratio * ratio * ratio))

    def reach(self, spacing: float, stride: int = 1) -> int:
        """K: how many nodes it reaches, a multiple of the stride."""
        nodes = math.ceil(TRUNCATION * self.ell / spacing)
        return -(-nodes // stride) * stride

    def weights(self, spacing: float, reach: int) -> FloatArray:
        """exp(-x^2 / (2 ell^2)) at x = -K .. K spacings (2 K + 1,)."""
        x = np.arange(-reach, reach + 1) * spacing
        return exps(-0.5 * (x / self.ell) * (x / self.ell))


class ClassTerm(NamedTuple):
    """One class of points and its field."""

    points: FloatArray  # (3, N), world, metres
    box: Box
    table: Any  # (4 nodes,), f and its gradient at each node of the box; float32
    weight: float  # W of the class


class Product(NamedTuple):
    """F(X) = sum over classes of W sum_i f(R x_i + t)."""

    free: ClassTerm
    cubes: ClassTerm  # centres of cubes of free points
    surface: ClassTerm


def values_of(product: Product, poses: FloatArray) -> FloatArray:
    """F (B,) at poses (B, 12)."""
    out = np.empty(len(poses))
    spread(partial(_fill_values, product, poses, out), len(poses), lambda: None)
    return out


@compiled
def _fill_values(product, poses, out, first, last, _):
    """Fill out (B,) with F at poses (B, 12), from `first` to before `last`."""
    for n in range(first, last):
        out[n] = product_at(product, pose_at(poses, n))


@inner
def product_at(product, pose):
    """F at a pose."""
    total = 0.0
    for term in product:
        total += _sum_at(term, pose)
    return total


@inner
def _sum_at(term, pose):
    """W times the sum of f(p_i), p_i = R x_i + t; 0 beyond the field."""
    points, total = term.points, 0.0
    for n in range(points.shape[1]):
        a, b, c = moved(pose, points[0, n], points[1, n], points[2, n])
        cell, is_beyond = cell_of(term.box, a, b, c)
        if not is_beyond:
            total += value_between_nodes(term.table, *cell)
    return term.weight * total


@inner
def moments_at(term, pose):
    """W times sums of f, grad f and p x grad f at p_i = R x_i + t, in the object frame."""
    points, table, m = term.points, term.table, term.weight
    value = gx = gy = gz = p = q = r = 0.0
    for n in range(points.shape[1]):
        a, b, c = moved(pose, points[0, n], points[1, n], points[2, n])
        (at, _, _, u, v, w), is_beyond = cell_of(term.box, a, b, c)
        if not is_beyond:
            s, nx, ny, nz = distance_between_nodes(term.box, table, at, u, v, w)
            value += s
            gx, gy, gz = gx + nx, gy + ny, gz + nz
            p, q, r = p + (b * nz - c * ny), q + (c * nx - a * nz), r + (a * ny - b * nx)
    return m * value, m * gx, m * gy, m * gz, m * p, m * q, m * r


@dataclass(frozen=True, eq=False)
class ClassField:
    """f of one class of a cloud in the object frame."""

    box: Box
    table: Any  # (4 nodes,), see ClassTerm
    norm: float  # <f, f>

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


def _class_field(sdf: SdfGrid, members: BoolArray, kernel: Kernel) -> ClassField:
    """Of the nodes with a flag (nx, ny, nz)."""
    spacing = sdf.resolution
    stride = max(1, math.floor(kernel.ell / (FINENESS * spacing) + 1e-9))
    reach = kernel.reach(spacing, stride)
    shape = [-(-(count - 1 + 2 * reach) // stride) + 1 for count in sdf.shape]
    if math.prod(shape) > MOST_NODES:
        raise SettingError(
            f"ell {kernel.ell} m makes a field of {math.prod(shape):.1e} nodes around an SDF of "
            f"resolution {spacing} m; accepted: at most {MOST_NODES:.0e}, so a smaller ell"
        )
    source, table = members.astype(np.float64), np.empty((*shape, 4), dtype=np.float32)
    table[..., 0] = value = kernel.amplitude * _blurred(source, kernel, spacing, shape, stride)
    for axis in range(3):  # ell^2 grad f = sum k(., z) z - f p
        z, p = (np.ogrid[tuple(map(slice, counts))][axis] for counts in (sdf.shape, shape))
        moment = kernel.amplitude * _blurred(source * z, kernel, spacing, shape, stride)
        slope = moment - (p * stride - reach) * value
        table[..., axis + 1] = spacing / (kernel.ell * kernel.ell) * slope
    box = box_of(sdf.origin - reach * spacing, stride * spacing, shape, between=True)
    field = ClassField(box, table.reshape(-1), 0.0)
    nothing = field.term(np.zeros((0, 3)), 0.0)
    own = field.term(sdf.origin + np.argwhere(members) * spacing, 1.0)
    norm = values_of(Product(own, nothing, nothing), Poses.of(np.eye(4)[None]).numbers)
    return ClassField(box, field.table, float(norm[0]))


def cloud_norm(points: FloatArray, kernel: Kernel, lattice: float) -> float:
    """<f, f> of a cloud (N, 3): the sum over all pairs, one by one if they are few.

    Of more, the sum over a grid: of spacing `lattice`, metres, if every point is at a node, which
    is as exact as a field; else of a quarter of ell, with points moved to the nearest nodes,
    within 1 %. Points that span too large a grid are taken one by one, too.
    """
    if len(points) <= _FEW:
        return _pair_by_pair(points, kernel)
    first, spacing, narrow = points.min(axis=0), lattice, kernel
    nodes = _nodes_of(points, lattice)
    if nodes is None:
        spacing = kernel.ell / _SNAPPED_FINENESS
        narrow = kernel.widened(-spacing * spacing / 6.0)  # either point moves by half of it
    with np.errstate(over="ignore"):
        steps = np.rint((points - first) / spacing)
    sides, reach = steps.max(axis=0) + 1.0, narrow.reach(spacing)
    if not math.prod((sides + 2.0 * reach).tolist()) <= MOST_NODES:
        return _pair_by_pair(points, kernel)
    grid = np.zeros(sides.astype(np.int64))
    np.add.at(grid, tuple(steps.astype(np.int64).T), 1.0)
    around = [side + 2 * reach for side in grid.shape]
    inside = tuple(slice(reach, reach + side) for side in grid.shape)
    terms = (grid * _blurred(grid, narrow, spacing, around, 1)[inside]).reshape(-1)
    return narrow.amplitude * float(np.cumsum(terms)[-1])  # added in their order


def _pair_by_pair(points: FloatArray, kernel: Kernel) -> float:
    if len(points) > _MANY:
        raise SettingError(
            f"{len(points)} points of one class are far apart; accepted: at most {_MANY:_}, or "
            "points within a box that is small beside ell"
        )
    return kernel.amplitude * _sum_of_pairs(points, kernel.ell, _FAR * kernel.ell)


@compiled
def _sum_of_pairs(points: FloatArray, ell: float, radius: float) -> float:
    """Sum over pairs of points (N, 3) closer than `radius` of exp(-|x - y|^2 / (2 ell^2)).

    Of every point with itself and, twice, with those after it.
    """
    total = 0.0
    for i in range(len(points)):
        total += 1.0
        for j in range(i + 1, len(points)):
            x, y = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1]
            z = points[i, 2] - points[j, 2]
            squared = x * x + y * y + z * z
            if squared < radius * radius:
                total += 2.0 * exp(-0.5 * squared / (ell * ell))
    return total


def _nodes_of(points: FloatArray, lattice: float) -> IntArray | None:
    """Indices (N, 3) of lattice nodes from the first on, or None if points are elsewhere."""
    with np.errstate(over="ignore", invalid="ignore"):
        steps = (points - points.min(axis=0)) / lattice
        nodes = np.rint(steps)
        if not (np.abs(steps - nodes) < _ON_LATTICE).all() or nodes.max() >= 2.0**20:
            return None
    return nodes.astype(np.int64)


def full_cubes(
    points: FloatArray, kernel: Kernel, lattice: float
) -> tuple[FloatArray, FloatArray, Kernel]:
    """Points (N, 3) left alone, centres (C, 3) of full cubes of lattice points, a cube's kernel.

    A cube counts as one point of a wider kernel, which has the variance of the kernel and of the
    cube together, and differs in fourth moments: by less than 1e-3 of the cube's sum, as its side
    is at most half of ell. A cloud of few points, or off the lattice, has no cubes.
    """
    side = math.floor(0.5 * kernel.ell / lattice)
    nodes = _nodes_of(points, lattice) if len(points) > _FEW and side > 1 else None
    if nodes is None:
        return points, np.zeros((0, 3)), kernel
    corners, cube, counts = np.unique(
        nodes // side, axis=0, return_inverse=True, return_counts=True
    )
    full = counts == side**3
    centres = (corners[full] * side + (side - 1) / 2.0) * lattice + points.min(axis=0)
    wide = kernel.widened(lattice * lattice * (side * side - 1) / 12.0, side**3)
    return points[~full[cube.reshape(-1)]], centres, wide


def _blurred(
    source: FloatArray, kernel: Kernel, spacing: float, shape: list[int], stride: int
) -> FloatArray:
    """A source (nx, ny, nz) blurred, without the amplitude, at nodes of `shape` (3,).

    These lie every `stride` nodes of the source, the first K nodes before its first.
    """
    weights = kernel.weights(spacing, kernel.reach(spacing, stride))
    for axis in (2, 1, 0):
        source = _along(axis, source, weights, shape[axis], stride)
    return source


def _along(
    axis: int, source: FloatArray, weights: FloatArray, length: int, stride: int
) -> FloatArray:
    """Source (nx, ny, nz) blurred along an axis, which then has that length."""
    before, after = source.shape[:axis], source.shape[axis + 1 :]
    rows = source.reshape(math.prod(before), source.shape[axis], math.prod(after))
    out = np.empty((len(rows), length, rows.shape[2]))
    spread(partial(_blur_rows, rows, weights, stride, out), length, lambda: None)
    return out.reshape(*before, length, *after)


@compiled
def _blur_rows(source, weights, stride, out, first, last, _):
    """Fill out (A, m, C), from row `first` to before `last`, with source (A, n, C) blurred.

    Row o of the result is at row o stride - K of the source. Rows add up in their order.
    """
    reach = len(weights) // 2
    across, rows, along = source.shape
    for a in range(across):
        for o in range(first, last):
            at = o * stride - reach
            target = out[a, o]
            target[:] = 0.0
            for s in range(max(at - reach, 0), min(at + reach + 1, rows)):
                weight = weights[at - s + reach]
                line = source[a, s]
                for c in range(along):
                    target[c] += weight * line[c]
