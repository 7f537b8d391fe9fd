"""Labelled clouds as functions of a reproducing kernel Hilbert space, summed up on grids.

A cloud is f = sum_j k(., z_j) with k(x, z) = A exp(-|x - z|^2 / (2 ell^2)), class by class: the
labels of two classes are so far apart that their kernel is 0. What a cloud in the object frame
contributes is thus a static field, the blurred indicator of its nodes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from chsel.arrays import FloatArray
from chsel.errors import SettingError
from chsel.kernels.cvo import ClassTerm, Product, products, scratch
from chsel.kernels.elementary import log
from chsel.kernels.gaussian_blur import (
    add_columns,
    blur_axis,
    fill_gaussian,
)
from chsel.kernels.region import Box, box_of
from chsel.sdf import SdfGrid
from chsel.threads import spread

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


def _add_columns(  # type: ignore[no-untyped-def]
    columns, slopes, offsets, weights, stride, spacing, out, first, last, _
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
