"""Clouds of points as functions f = sum_j k(., z_j) of a reproducing kernel Hilbert space.

A cloud in the object frame becomes a table of f on a grid; of the observed cloud the norm alone is
needed, and cubes of free points in place of the points, which are many.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from chsel.errors import SettingError
from chsel.methods.cvo.cvo_kernels import Product, products
from chsel.methods.cvo.field_kernels import ClassTerm, scratch
from chsel.methods.cvo.gaussian_blur import (
    Kernel,
    blurred,
    blurred_with_gradient,
    splat,
    sum_of_pairs,
)
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.numerics.cell_set import Box, box_of
from chsel.problem.sdf_grid import SdfGrid

MOST_NODES = 30_000_000
FINENESS = 10  # at least so many nodes of a field per ell, if the SDF has them
_FEW, _MANY = 2000, 50_000  # points that are, and that may be, taken one by one
_FAR = 8.0  # ell; nothing is left of a kernel there
_SHARED_FINENESS = 4  # nodes per ell that points are shared out among
_ON_LATTICE = 1e-6  # spacings that a point may be away from a node


@dataclass(frozen=True, eq=False)
class ClassField:
    """f of one class of a cloud in the object frame."""

    box: Box
    table: Any  # (nodes, 4), f and its gradient at the nodes of the box, 32 bit
    values: Any  # (nodes,), f alone, 32 bit
    norm: float  # <f, f>

    def term(self, points: FloatArray, weight: float) -> ClassTerm:
        """Its part of F, for points (N, 3) of the same class in the world."""
        return ClassTerm(points.T.copy(), self.box, self.table, self.values, weight)


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
    stride = max(1, math.floor(kernel.ell / (FINENESS * sdf.resolution) + 1e-9))
    weights = kernel.weights(sdf.resolution, stride)
    shape = [-(-(count - 1 + 2 * weights.reach) // stride) + 1 for count in sdf.shape]
    if not math.prod(shape) <= MOST_NODES:
        raise SettingError(
            f"ell {kernel.ell} m makes a field of {math.prod(shape):.1e} nodes around an SDF of "
            f"resolution {sdf.resolution} m; accepted: at most {MOST_NODES:.0e}, so a smaller ell"
        )
    table = np.empty((math.prod(shape), 4), dtype=np.float32)
    parts = blurred_with_gradient(members.astype(np.float64), weights, shape, stride)
    for channel, part in enumerate(parts):
        scale = kernel.amplitude / (kernel.ell * kernel.ell if channel else 1.0)
        table[:, channel] = scale * part.reshape(-1)
    first = sdf.origin - weights.reach * sdf.resolution
    box = box_of(first, stride * sdf.resolution, shape, between=True)
    nodes = sdf.origin + np.argwhere(members) * sdf.resolution
    values = table[:, 0].copy()
    norm = _sum_over(ClassField(box, table, values, 0.0), nodes)
    return ClassField(box, table, values, norm)


def _sum_over(field: ClassField, points: FloatArray) -> float:
    """Sum of a field over points (N, 3) of its frame."""
    nothing = field.term(np.zeros((0, 3)), 0.0)
    pose = np.concatenate([np.eye(3).reshape(-1), np.zeros(3)])[None]
    out = np.empty(1)
    products(Product(field.term(points, 1.0), nothing, nothing), pose, out, 0, 1, scratch())
    return float(out[0])


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
    weights, first = narrow.weights(spacing), points.min(axis=0)
    with np.errstate(over="ignore"):
        sides = np.floor((points.max(axis=0) - first) / spacing + 0.5) + 2.0
    if not math.prod((sides + 2.0 * weights.reach).tolist()) <= MOST_NODES:
        return _pair_by_pair(points, kernel)
    grid = np.zeros([int(side) for side in sides])
    if nodes is None:
        splat(points, first, 1.0 / spacing, grid)
    else:
        np.add.at(grid, tuple(nodes.T), 1.0)
    terms = (grid * blurred(grid, weights)).reshape(-1)
    return narrow.amplitude * float(np.cumsum(terms)[-1])  # added in their order


def _pair_by_pair(points: FloatArray, kernel: Kernel) -> float:
    if len(points) > _MANY:
        raise SettingError(
            f"{len(points)} points of one class are far apart; accepted: at most {_MANY:_}, or "
            "points within a box that is small beside ell"
        )
    radius = min(kernel.radius, _FAR * kernel.ell)
    return kernel.amplitude * sum_of_pairs(points, kernel.ell, radius)


def _narrowed(kernel: Kernel, spacing: float) -> Kernel:
    """The kernel that is widened to this one by sharing out points among nodes.

    Either point of a pair is spread with a variance of spacing^2 / 6 along an axis, on average.
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


def full_cubes(
    points: FloatArray, ell: float, lattice: float
) -> tuple[FloatArray, FloatArray, int]:
    """Points (N, 3) left alone, centres (C, 3) of full cubes of lattice points, points per side.

    A cube's side is at most half of ell, so that its sum of kernels is that of one wider kernel
    (see `cube_kernel`). A cloud of few points, or off the lattice, has no cubes.
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


def cube_kernel(kernel: Kernel, lattice: float, side: int) -> Kernel:
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
