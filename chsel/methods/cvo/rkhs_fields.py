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
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.elementary import exp, exps, log
from chsel.numerics.pose_tuples import moved, pose_at
from chsel.numerics.threads import spread
from chsel.problem.poses import Poses
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.sdf_lookup import cell_of, distance_between_nodes

MOST_NODES = 30_000_000
FINENESS = 10  # at least so many nodes of a field per ell, if the SDF has them
TRUNCATION = 3.5  # ell; beyond it lie 0.02 % of a Gaussian on either side
_FEW, _MANY = 2000, 50_000  # points that are, and that may be, taken one by one
_FAR = 8.0  # ell; nothing is left of a kernel there
_SHARED_FINENESS = 4  # nodes per ell that points are shared out among
_ON_LATTICE = 1e-6  # spacings that a point may be away from a node


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

    def reach(self, spacing: float, stride: int = 1) -> int:
        """K: how many nodes it reaches, a multiple of the stride."""
        nodes = math.ceil(min(self.radius, TRUNCATION * self.ell) / spacing)
        return -(-nodes // stride) * stride

    def weights(self, spacing: float, reach: int) -> tuple[FloatArray, FloatArray]:
        """Along an axis at x = -K .. K spacings (2 K + 1,), without the amplitude.

        exp(-x^2 / (2 ell^2)), and -x times that: its derivative by x, times ell^2.
        """
        x = np.arange(-reach, reach + 1) * spacing
        values = exps(-0.5 * (x / self.ell) * (x / self.ell))
        return values, -x * values


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
        (at, across, along, u, v, w), is_beyond = cell_of(term.box, a, b, c)
        if not is_beyond:
            near = _side_between(term.table, at, along, v, w)
            total += _between(near, _side_between(term.table, at + across, along, v, w), u)
    return term.weight * total


@leaf
def _side_between(table, at, along, v, w):
    """f between the four nodes around, of those that share the first index."""
    low, high = np.uint64(4 * at), np.uint64(4 * (at + along))
    step = np.uint64(4)
    near = _between(table[low], table[low + step], w)
    return _between(near, _between(table[high], table[high + step], w), v)


@leaf
def _between(near, far, share):
    return np.float64(near) + share * (np.float64(far) - np.float64(near))


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
    table = np.empty((math.prod(shape), 4), dtype=np.float32)
    parts = _blurred_with_gradient(members.astype(np.float64), kernel, spacing, shape, stride)
    for channel, part in enumerate(parts):
        scale = kernel.amplitude / (kernel.ell * kernel.ell if channel else 1.0)
        table[:, channel] = scale * part.reshape(-1)
    box = box_of(sdf.origin - reach * spacing, stride * spacing, shape, between=True)
    field = ClassField(box, table.reshape(-1), 0.0)
    nothing = field.term(np.zeros((0, 3)), 0.0)
    own = field.term(sdf.origin + np.argwhere(members) * spacing, 1.0)
    norm = values_of(Product(own, nothing, nothing), Poses.of(np.eye(4)[None]).numbers)
    return ClassField(box, field.table, float(norm[0]))


def cloud_norm(points: FloatArray, kernel: Kernel, lattice: float) -> float:
    """<f, f> of a cloud (N, 3): the sum over all pairs, one by one if they are few.

    Of more, the sum over a grid: of spacing `lattice`, metres, if every point is at a node, which
    is as exact as a field; else of a quarter of ell, with points shared out among the nodes
    around, within 1 %. Points that span too large a grid are taken one by one, too.
    """
    if len(points) <= _FEW:
        return _pair_by_pair(points, kernel)
    first, spacing, narrow = points.min(axis=0), lattice, kernel
    nodes = _nodes_of(points, lattice)
    if nodes is None:
        spacing = kernel.ell / _SHARED_FINENESS
        narrow = _narrowed(kernel, spacing)
    with np.errstate(over="ignore"):
        sides = np.floor((points.max(axis=0) - first) / spacing + 0.5) + 2.0
    if not math.prod((sides + 2.0 * narrow.reach(spacing)).tolist()) <= MOST_NODES:
        return _pair_by_pair(points, kernel)
    grid = np.zeros([int(side) for side in sides])
    _share_out((points - first) * (1.0 / spacing) if nodes is None else nodes, grid)
    terms = (grid * _blurred(grid, narrow, spacing)).reshape(-1)
    return narrow.amplitude * float(np.cumsum(terms)[-1])  # added in their order


def _pair_by_pair(points: FloatArray, kernel: Kernel) -> float:
    if len(points) > _MANY:
        raise SettingError(
            f"{len(points)} points of one class are far apart; accepted: at most {_MANY:_}, or "
            "points within a box that is small beside ell"
        )
    radius = min(kernel.radius, _FAR * kernel.ell)
    return kernel.amplitude * _sum_of_pairs(points, kernel.ell, radius)


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


def _narrowed(kernel: Kernel, spacing: float) -> Kernel:
    """The kernel that is widened to this one by sharing out points among nodes.

    Either point of a pair is spread with a variance of spacing^2 / 6 along an axis, on average.
    """
    ell = math.sqrt(kernel.ell * kernel.ell - spacing * spacing / 3.0)
    widening = kernel.ell / ell
    gain = widening * widening * widening
    return Kernel(ell, kernel.amplitude * gain, kernel.radius)


def _share_out(points: FloatArray | IntArray, grid: FloatArray) -> None:
    """Add points (N, 3), in spacings from the first node, to the eight nodes around each."""
    below = np.clip(np.floor(points).astype(np.int64), 0, np.array(grid.shape) - 2)
    share = points - below
    for corner in np.ndindex(2, 2, 2):
        x, y, z = np.where(corner, share, 1.0 - share).T
        np.add.at(grid, tuple((below + corner).T), x * y * z)


def _nodes_of(points: FloatArray, lattice: float) -> IntArray | None:
    """Indices (N, 3) of lattice nodes from the first on, or None if points are elsewhere."""
    with np.errstate(over="ignore", invalid="ignore"):
        steps = (points - points.min(axis=0)) / lattice
        nodes = np.rint(steps)
        if not (np.abs(steps - nodes) < _ON_LATTICE).all() or nodes.max() >= 2.0**20:
            return None
    return nodes.astype(np.int64)


def full_cubes(
    points: FloatArray, ell: float, lattice: float
) -> tuple[FloatArray, FloatArray, int]:
    """Points (N, 3) left alone, centres (C, 3) of full cubes of lattice points, points per side.

    A cube's side is at most half of ell, so that its sum of kernels is that of one wider kernel
    (see `cube_kernel`). A cloud of few points, or off the lattice, has no cubes.
    """
    side = math.floor(0.5 * ell / lattice)
    nodes = _nodes_of(points, lattice) if len(points) > _FEW and side > 1 else None
    if nodes is None:
        return points, np.zeros((0, 3)), 1
    cubes = nodes // side
    _, count_y, count_z = cubes.max(axis=0) + 1
    keys = (cubes[:, 0] * count_y + cubes[:, 1]) * count_z + cubes[:, 2]
    _, first, cube, counts = np.unique(
        keys, return_index=True, return_inverse=True, return_counts=True
    )
    full = counts == side**3
    centres = (cubes[first[full]] * side + (side - 1) / 2.0) * lattice + points.min(axis=0)
    return points[~full[cube]], centres, side


def cube_kernel(kernel: Kernel, lattice: float, side: int) -> Kernel:
    """The kernel of a cube of side^3 lattice points seen as one point at its centre.

    Its variance is that of the kernel and of the cube together, which along every direction is
    lattice^2 (side^2 - 1) / 12; its integral that of all. It differs in fourth moments, by less
    than 1e-3 of the cube's sum while the cube's side is at most half of ell.
    """
    variance = lattice * lattice * (side * side - 1) / 12.0
    ell = math.sqrt(kernel.ell * kernel.ell + variance)
    narrowing = kernel.ell / ell
    gain = side**3 * narrowing * narrowing * narrowing
    return Kernel(ell, kernel.amplitude * gain)


def _blurred_with_gradient(
    source: FloatArray, kernel: Kernel, spacing: float, shape: list[int], stride: int
) -> list[FloatArray]:
    """Value and gradient times ell^2, each of `shape` (3,), of a source (nx, ny, nz) blurred.

    Their nodes lie every `stride` nodes of the source, the first K nodes before its first.
    """
    if kernel.radius < math.inf:
        return list(_blurred_in_ball(source, kernel, spacing, shape, stride))
    value, slope = kernel.weights(spacing, kernel.reach(spacing, stride))
    z, dz = (_along(2, source, weights, shape, stride) for weights in (value, slope))
    zy, zdy = (_along(1, z, weights, shape, stride) for weights in (value, slope))
    dzy = _along(1, dz, value, shape, stride)
    parts = (zy, value), (zy, slope), (zdy, value), (dzy, value)
    return [_along(0, part, weights, shape, stride) for part, weights in parts]


def _blurred(source: FloatArray, kernel: Kernel, spacing: float) -> FloatArray:
    """The source (nx, ny, nz) blurred, at its own nodes."""
    reach = kernel.reach(spacing)
    shape = [side + 2 * reach for side in source.shape]
    inside = tuple(slice(reach, reach + side) for side in source.shape)
    if kernel.radius < math.inf:
        return _blurred_in_ball(source, kernel, spacing, shape, 1)[0][inside]
    for axis in (2, 1, 0):
        source = _along(axis, source, kernel.weights(spacing, reach)[0], shape, 1)
    return source[inside]


def _along(
    axis: int, source: FloatArray, weights: FloatArray, shape: list[int], stride: int
) -> FloatArray:
    """Source (nx, ny, nz) blurred along an axis, which then has the length that `shape` has."""
    before, after = source.shape[:axis], source.shape[axis + 1 :]
    rows = source.reshape(math.prod(before), source.shape[axis], math.prod(after))
    out = np.empty((len(rows), shape[axis], rows.shape[2]))
    spread(partial(_blur_rows, rows, weights, stride, out), shape[axis], lambda: None)
    return out.reshape(*before, shape[axis], *after)


@compiled
def _blur_rows(source, weights, stride, out, first, last, _):
    """Fill out (A, m, C), from row `first` to before `last`, with source (A, n, C) blurred.

    Row o of the result is at row o stride - K of the source. Rows add up in their order.
    """
    reach = (len(weights) - 1) // 2
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


def _blurred_in_ball(
    source: FloatArray, kernel: Kernel, spacing: float, shape: list[int], stride: int
) -> FloatArray:
    """Value and gradient times ell^2 (4, *shape) of a kernel that ends at a radius.

    For every length that a column along z may have within the ball: the source blurred along z
    that far, then added up over the columns at the distances that leave this length.
    """
    reach = kernel.reach(spacing, stride)
    values, slopes = kernel.weights(spacing, reach)
    offsets = np.indices((2 * reach + 1, 2 * reach + 1)).reshape(2, -1).T - reach  # (P, 2)
    squares = offsets * offsets
    left = (kernel.radius / spacing) ** 2 - squares[:, 0] - squares[:, 1]
    length = np.ceil(np.sqrt(np.maximum(left, 0.0))) - 1.0  # the most spacings below the radius
    columns, out = np.zeros((2, *source.shape[:2], shape[2])), np.zeros((4, *shape))
    padded = np.pad(source, ((0, 0), (0, 0), (2 * reach, 2 * reach + stride)))
    for depth in range(int(length.max(initial=-1.0)) + 1):
        for offset in (depth, -depth)[: 1 + (depth > 0)]:
            start = reach - offset
            part = padded[:, :, start : start + stride * (shape[2] - 1) + 1 : stride]
            columns[0] += values[offset + reach] * part
            columns[1] += slopes[offset + reach] * part
        reached = offsets[length == depth]
        add = partial(_add_columns, columns, reached, values, spacing, stride, out)
        spread(add, shape[0], lambda: None)
    return out


@compiled
def _add_columns(columns, offsets, weights, spacing, stride, out, first, last, _):
    """Add columns (2, nx, ny, mz), the source blurred along z by values and slopes, to those near.

    out (4, mx, my, mz): from plane `first` to before `last`. offsets (P, 2): spacings from a column
    to those that it reaches.
    """
    reach = (len(weights) - 1) // 2
    _, nx, ny, mz = columns.shape
    for o in range(first, last):
        for p in range(out.shape[2]):
            for n in range(len(offsets)):
                dx, dy = offsets[n, 0], offsets[n, 1]
                i, j = o * stride - reach - dx, p * stride - reach - dy
                if 0 <= i < nx and 0 <= j < ny:
                    weight = weights[dx + reach] * weights[dy + reach]
                    x, y = dx * spacing, dy * spacing
                    for k in range(mz):
                        near = weight * columns[0, i, j, k]
                        out[0, o, p, k] += near
                        out[1, o, p, k] -= x * near
                        out[2, o, p, k] -= y * near
                        out[3, o, p, k] += weight * columns[1, i, j, k]
