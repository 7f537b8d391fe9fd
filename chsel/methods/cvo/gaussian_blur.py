"""Grids blurred by a Gaussian or by one that ends at a radius, and sums over pairs of points.

A result has its nodes every `stride` nodes of the source; its first one lies K nodes of the source
before the first of the source, with K the reach of the weights (2 K + 1,).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from chsel.errors import SettingError
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.compiler import compiled, leaf
from chsel.numerics.elementary import exp, log
from chsel.numerics.threads import spread

TRUNCATION = 3.5  # ell; beyond it lie 0.02 % of a Gaussian on either side
_MOST_REACH = 100_000


class Weights(NamedTuple):
    """A Gaussian along an axis, at x = -K .. K spacings."""

    values: FloatArray  # (2 K + 1,), exp(-x^2 / (2 ell^2))
    slopes: FloatArray  # (2 K + 1,), -x times that: its derivative by x, times ell^2
    spacing: float  # metres
    radius: float  # metres, where the kernel of three dimensions ends; may be infinite

    @property
    def reach(self) -> int:
        """K."""
        return len(self.values) // 2


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

    def weights(self, spacing: float, stride: int = 1) -> Weights:
        """Its weights without the amplitude; K is a multiple of the stride."""
        radius = min(self.radius, TRUNCATION * self.ell)
        reach = radius / spacing
        if not reach <= _MOST_REACH:
            raise SettingError(
                f"ell {self.ell} m reaches over {reach:.1e} nodes of {spacing} m; "
                f"accepted: at most {_MOST_REACH:_}, so a smaller ell"
            )
        most = -(-math.ceil(reach) // stride) * stride
        x = np.arange(-most, most + 1) * spacing
        values = np.array([exp(e) for e in (-0.5 * (x / self.ell) * (x / self.ell)).tolist()])
        return Weights(values, -x * values, spacing, radius if self.radius < math.inf else math.inf)


def blurred_with_gradient(
    source: FloatArray, weights: Weights, shape: list[int], stride: int
) -> list[FloatArray]:
    """Value and gradient times ell^2, each of `shape` (3,), of a source (nx, ny, nz) blurred."""
    if weights.radius < math.inf:
        return list(_blurred_in_ball(source, weights, shape, stride))
    value, slope = weights.values, weights.slopes
    z, dz = (_along(2, source, kernel, shape, stride) for kernel in (value, slope))
    zy, zdy = (_along(1, z, kernel, shape, stride) for kernel in (value, slope))
    dzy = _along(1, dz, value, shape, stride)
    parts = (zy, value), (zy, slope), (zdy, value), (dzy, value)
    return [_along(0, part, kernel, shape, stride) for part, kernel in parts]


def blurred(source: FloatArray, weights: Weights) -> FloatArray:
    """The source (nx, ny, nz) blurred, at its own nodes."""
    reach = weights.reach
    shape = [side + 2 * reach for side in source.shape]
    if weights.radius < math.inf:
        inside = tuple(slice(reach, reach + side) for side in source.shape)
        return _blurred_in_ball(source, weights, shape, 1)[0][inside].copy()
    for axis in (2, 1, 0):
        nodes = np.arange(reach, reach + source.shape[axis])
        source = _along(axis, source, weights.values, shape, 1).take(nodes, axis)
    return source


def _along(
    axis: int, source: FloatArray, weights: FloatArray, shape: list[int], stride: int
) -> FloatArray:
    """Source (nx, ny, nz) blurred along an axis, which then has the length that `shape` has."""
    before, after = source.shape[:axis], source.shape[axis + 1 :]
    rows = source.reshape(math.prod(before), source.shape[axis], math.prod(after))
    out = np.empty((len(rows), shape[axis], rows.shape[2]))
    spread(partial(_blur_rows, rows, weights, stride, out), shape[axis], lambda: None)
    return out.reshape(*before, shape[axis], *after)


class _Columns(NamedTuple):
    """Columns along z that are added to all columns of a result at some distances."""

    values: FloatArray  # (nx, ny, mz), the source blurred along z
    slopes: FloatArray  # (nx, ny, mz), and with its slopes
    offsets: IntArray  # (P, 2), spacings along x and y from a column to those that it reaches
    weights: FloatArray  # (2 K + 1,), along x and y
    spacing: float
    stride: int


def _blurred_in_ball(
    source: FloatArray, weights: Weights, shape: list[int], stride: int
) -> FloatArray:
    """Value and gradient times ell^2 (4, *shape) of a kernel that ends at a radius.

    For every length that a column along z may have within the ball: the source blurred along z
    that far, then added up over the columns at the distances that leave this length.
    """
    reach, spacing = weights.reach, weights.spacing
    offsets = np.indices((2 * reach + 1, 2 * reach + 1)).reshape(2, -1).T - reach  # (P, 2)
    squares = (offsets * offsets)[:, 0], (offsets * offsets)[:, 1]
    left = (weights.radius / spacing) ** 2 - squares[0] - squares[1]
    length = np.ceil(np.sqrt(np.maximum(left, 0.0))) - 1.0  # the most spacings below the radius
    values, slopes = np.zeros((2, *source.shape[:2], shape[2]))
    out = np.zeros((4, *shape))
    padded = np.pad(source, ((0, 0), (0, 0), (2 * reach, 2 * reach + stride)))
    for depth in range(int(length.max(initial=-1.0)) + 1):
        for offset in (depth, -depth)[: 1 + (depth > 0)]:
            start = reach - offset
            part = padded[:, :, start : start + stride * (shape[2] - 1) + 1 : stride]
            values += weights.values[offset + reach] * part
            slopes += weights.slopes[offset + reach] * part
        reached = offsets[length == depth]
        columns = _Columns(values, slopes, reached, weights.values, spacing, stride)
        spread(partial(_add_columns, columns, out), shape[0], lambda: None)
    return out


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


@compiled
def _add_columns(columns, out, first, last, _):
    """Add to out (4, mx, my, mz), from plane `first` to before `last`, the columns around."""
    weights, offsets, stride = columns.weights, columns.offsets, columns.stride
    reach = (len(weights) - 1) // 2
    nx, ny, mz = columns.values.shape
    for o in range(first, last):
        for p in range(out.shape[2]):
            value, by_x = out[0, o, p], out[1, o, p]
            by_y, by_z = out[2, o, p], out[3, o, p]
            for n in range(len(offsets)):
                dx, dy = offsets[n, 0], offsets[n, 1]
                i, j = o * stride - reach - dx, p * stride - reach - dy
                if 0 <= i < nx and 0 <= j < ny:
                    weight = weights[dx + reach] * weights[dy + reach]
                    x, y = dx * columns.spacing, dy * columns.spacing
                    column, slope = columns.values[i, j], columns.slopes[i, j]
                    for k in range(mz):
                        near = weight * column[k]
                        value[k] += near
                        by_x[k] -= x * near
                        by_y[k] -= y * near
                        by_z[k] += weight * slope[k]


@compiled
def sum_of_pairs(points: FloatArray, ell: float, radius: float) -> float:
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


@compiled
def splat(points, origin, inverse, weights):
    """Share points (N, 3) out among the eight nodes around each, added to weights (nx, ny, nz).

    origin (3,): the first node. inverse: nodes per metre.
    """
    nx, ny, nz = weights.shape
    for n in range(len(points)):
        a = (points[n, 0] - origin[0]) * inverse
        b = (points[n, 1] - origin[1]) * inverse
        c = (points[n, 2] - origin[2]) * inverse
        i, j, k = _below(a, nx), _below(b, ny), _below(c, nz)
        u, v, w = a - i, b - j, c - k
        for corner in range(8):
            p, q, r = corner >> 2, (corner >> 1) & 1, corner & 1
            share = (u if p else 1.0 - u) * (v if q else 1.0 - v) * (w if r else 1.0 - w)
            weights[i + p, j + q, k + r] += share


@leaf
def _below(g, count):
    """The lower of the two nodes around a grid coordinate."""
    return min(max(np.int64(np.floor(g)), 0), count - 2)
