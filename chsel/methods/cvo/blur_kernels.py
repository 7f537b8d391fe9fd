"""Sums of Gaussians around the nodes of a grid, with their gradients, at the nodes of another."""

from __future__ import annotations

import numpy as np

from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import compiled, leaf
from chsel.numerics.elementary import exp


@compiled
def fill_gaussian(spacing, ell, weights, slopes):
    """Fill weights (2 K + 1,) with exp(-x^2 / (2 ell^2)) at x = -K .. K spacings, and slopes.

    slopes (2 K + 1,): its derivative by x, times ell^2.
    """
    reach = (len(weights) - 1) // 2
    for i in range(len(weights)):
        x = (i - reach) * spacing
        weights[i] = exp(-0.5 * (x / ell) * (x / ell))
        slopes[i] = -x * weights[i]


@compiled
def blur_axis(source, weights, stride, first, last, out):
    """Fill out (A, m, C), from row `first` to before `last`, with source (A, n, C) blurred.

    Row o of the result is at row o stride - K of the source; weights (2 K + 1,) as of
    `fill_gaussian`, of the offset from the source to the result. Rows add up in their order.
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
def add_columns(columns, slopes, offsets, weights, stride, spacing, first, last, out):
    """Add to out (4, mx, my, mz), from plane `first` to before `last`, blurred columns around.

    columns, slopes (nx, ny, mz): the source blurred along z, and the same with its slopes. offsets
    (P, 2): how many spacings along x and y the result is away from a column that reaches it.
    weights (2 K + 1,): as of `fill_gaussian`. The result: value, then gradient times ell^2.
    """
    reach = (len(weights) - 1) // 2
    nx, ny, mz = columns.shape
    for o in range(first, last):
        for p in range(out.shape[2]):
            value, by_x = out[0, o, p], out[1, o, p]
            by_y, by_z = out[2, o, p], out[3, o, p]
            for n in range(len(offsets)):
                dx, dy = offsets[n, 0], offsets[n, 1]
                i, j = o * stride - reach - dx, p * stride - reach - dy
                if 0 <= i < nx and 0 <= j < ny:
                    weight = weights[dx + reach] * weights[dy + reach]
                    x, y = dx * spacing, dy * spacing
                    column, slope = columns[i, j], slopes[i, j]
                    for k in range(mz):
                        near = weight * column[k]
                        value[k] += near
                        by_x[k] -= x * near
                        by_y[k] -= y * near
                        by_z[k] += weight * slope[k]


@compiled
def sum_of_pairs(points: FloatArray, ell: float, radius: float, first: int, last: int) -> float:
    """Sum over pairs of points (N, 3) closer than `radius` of exp(-|x - y|^2 / (2 ell^2)).

    Of every point from `first` to before `last` with itself and, twice, with those after it.
    """
    total = 0.0
    for i in range(first, last):
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


@compiled
def sum_of_products(left: FloatArray, right: FloatArray) -> float:
    """Sum of left (N,) times right (N,), in their order."""
    total = 0.0
    for n in range(len(left)):
        total += left[n] * right[n]
    return total
