"""Levenberg-Marquardt steps that fit poses to known points and out of free space.

The residuals are s - v of every known point, the depth below a level of every free point that is
deeper, and the height above it of every occupied point that is higher. Each costs a robust loss,
by iteratively reweighted least squares (Holland and Welsch, 1977).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.cost.cost_kernels import Model
from chsel.methods.anchored.fine_cells import FineCells
from chsel.methods.anchored.surrounding_kernels import (
    Surrounding,
    gather,
    hit,
    look_around,
    place_of,
    surrounding_for,
    travel_since_gathering,
)
from chsel.numerics.arrays import FloatArray, scratch
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.pose_tuples import composed, moved, pose_at
from chsel.problem.sdf_lookup import distance_between_nodes, distance_with_gradient

_MOST_SHIFT, _MOST_TURN = 0.08, 0.5  # of a step, metres and radians
_SLACK = 0.02  # metres that a pose may move before they are gathered again
_FIRST_DAMPING = 1e-2  # of the mean of the diagonal
_LESS, _MORE = 0.3, 5.0  # factors of the damping, after a step that was good or bad
_MOST_DAMPING = 1e6
_ENOUGH = 1e-4  # relative gain below which a pose has converged


class Twists(NamedTuple):
    """The ways that a pose may move."""

    basis: FloatArray  # (d, 6), turns in radians, then shifts in metres
    pivot: tuple[float, float, float]  # the point of the object about which it turns


class Loss(NamedTuple):
    """What residuals cost: quadratic up to a knee (Huber, 1964), then linear, then a constant."""

    knee: float  # metres
    cap: float  # metres; at least the knee
    most_wrong: float  # what a free or occupied point costs an energy at most, metres


class Fit(NamedTuple):
    """Scratch of one thread. Only the lower triangles of matrices are used."""

    near: Surrounding
    sums: FloatArray  # (8, 6): over residuals, of products of their rates of change by twists, of
    # these rates times the residuals; and the rates of one
    normal: FloatArray  # (2, d, d), of the normal equations at a pose and at one that is tried
    right: FloatArray  # (2, d)
    factor: FloatArray  # (d, d), of Cholesky
    row: FloatArray  # (d,), the solution
    twist: FloatArray  # (6,)


def fit_for(model: Model, fine: FineCells, d: int) -> Fit:
    """Scratch for one thread, for twists of d dimensions. fine: see surrounding_for."""
    normal, right, factor = scratch(2, d, d), scratch(2, d), scratch(d, d)
    sums, row, twist = scratch(8, 6), scratch(d), scratch(6)
    return Fit(surrounding_for(model, fine), sums, normal, right, factor, row, twist)


@leaf
def cost_of_residual(loss, residual):
    """The loss, in metres: the size of a residual less half a knee, where that is linear."""
    size = min(abs(residual), loss.cap)
    return size - 0.5 * loss.knee if size > loss.knee else 0.5 * size * size / loss.knee


@leaf
def _weight(loss, residual):
    """The derivative of the loss by half of the residual's square."""
    size = abs(residual)
    return 1.0 / max(size, loss.knee) if size < loss.cap else 0.0


@compiled
def fit_poses(model, loss, twists, poses, iterations, first, last, fit):
    """Move poses (B, 12) from `first` to `last` by up to so many steps."""
    for n in range(first, last):
        pose = _fitted(model, loss, twists, pose_at(poses, n), iterations, fit)
        for i in range(12):
            poses[n, i] = pose[i]


@inner
def _fitted(model, loss, twists, pose, iterations, fit):
    dimension = len(twists.basis)
    gather(model, pose, _SLACK, fit.near)
    at, damping = 0, _FIRST_DAMPING
    losses = _losses(model, loss, twists, pose, fit, at)
    for _ in range(iterations):
        if losses == 0.0:
            break
        trace = 0.0
        for i in range(dimension):
            trace += fit.normal[at, i, i]
        if not _solve(fit, at, damping * trace / dimension + 1e-12):
            break
        trial = _moved_by(twists, pose, fit)
        if travel_since_gathering(model, trial, fit.near) > _SLACK:
            gather(model, trial, _SLACK, fit.near)
        tried = _losses(model, loss, twists, trial, fit, 1 - at)
        if tried < losses:
            gain = losses - tried
            pose, losses, at = trial, tried, 1 - at
            damping *= _LESS
            if gain < _ENOUGH * tried:
                break
        else:
            damping *= _MORE
            if damping > _MOST_DAMPING:
                break
    return pose


@inner
def _losses(model, loss, twists, pose, fit, at):
    """The sum of the losses; fills the normal equations at a place, 0 or 1."""
    field, sums, total = model.field, fit.sums, 0.0
    for i in range(7):
        for j in range(6):
            sums[i, j] = 0.0
    for n in range(look_around(model, pose, fit.near)):
        point = hit(model, fit.near, n)
        cell, u, v, w = place_of(model, pose, point)
        if cell >= 0:
            looked_up = distance_between_nodes(field.box, field.table, cell, u, v, w)
            residual = looked_up[0] - model.alpha
            if residual < 0.0:
                total += cost_of_residual(loss, residual)
                _add(sums, twists.pivot, pose, point, looked_up, residual, _weight(loss, residual))
    for n in range(model.known.shape[1]):
        point = model.known[0, n], model.known[1, n], model.known[2, n]
        looked_up = distance_with_gradient(field, pose, point[0], point[1], point[2])
        residual = looked_up[0] - model.known_sdf[n]
        total += cost_of_residual(loss, residual)
        _add(sums, twists.pivot, pose, point, looked_up, residual, _weight(loss, residual))
    for n in range(model.occupied.shape[1]):
        point = model.occupied[0, n], model.occupied[1, n], model.occupied[2, n]
        looked_up = distance_with_gradient(field, pose, point[0], point[1], point[2])
        residual = looked_up[0] + model.alpha
        if residual > 0.0:
            total += cost_of_residual(loss, residual)
            _add(sums, twists.pivot, pose, point, looked_up, residual, _weight(loss, residual))
    _restrict(twists, fit, at)
    return total


@leaf
def _add(sums, pivot, pose, point, looked_up, residual, weight):
    """Add a residual at a world point, where a distance and its gradient were looked up."""
    u, v, w = moved(pose, point[0], point[1], point[2])
    u, v, w = u - pivot[0], v - pivot[1], w - pivot[2]
    _, nx, ny, nz = looked_up
    rates = sums[7]
    rates[0], rates[1], rates[2] = v * nz - w * ny, w * nx - u * nz, u * ny - v * nx
    rates[3], rates[4], rates[5] = nx, ny, nz
    for i in range(6):
        weighted = weight * rates[i]
        sums[6, i] += weighted * residual
        for j in range(i + 1):
            sums[i, j] += weighted * rates[j]


@inner
def _restrict(twists, fit, at):
    """Fill the normal equations from sums over all twists: B N B^T and B r."""
    basis, sums, product = twists.basis, fit.sums, fit.sums[7]
    for i in range(6):
        for j in range(i):
            sums[j, i] = sums[i, j]
    for i in range(len(basis)):
        for k in range(6):
            product[k] = 0.0
            for m in range(6):
                product[k] += basis[i, m] * sums[m, k]
        for j in range(i + 1):
            total = 0.0
            for k in range(6):
                total += product[k] * basis[j, k]
            fit.normal[at, i, j] = total
        total = 0.0
        for k in range(6):
            total += basis[i, k] * sums[6, k]
        fit.right[at, i] = total


@inner
def _solve(fit, at, damping):
    """Fill row with -(N + damping I)^-1 r by Cholesky; False if N is not positive definite so."""
    count = len(fit.row)
    lower, row = fit.factor, fit.row
    for i in range(count):
        for j in range(i + 1):
            total = fit.normal[at, i, j] + (damping if i == j else 0.0)
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                lower[i, i] = np.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    for i in range(count):
        total = -fit.right[at, i]
        for k in range(i):
            total -= lower[i, k] * row[k]
        row[i] = total / lower[i, i]
    for n in range(count):
        i = count - 1 - n
        total = row[i]
        for k in range(i + 1, count):
            total -= lower[k, i] * row[k]
        row[i] = total / lower[i, i]
    return True


@inner
def _moved_by(twists, pose, fit):
    """The pose moved by the twist of the solution, shortened to what a step may be."""
    basis, twist = twists.basis, fit.twist
    for i in range(6):
        twist[i] = 0.0
        for j in range(len(basis)):
            twist[i] += fit.row[j] * basis[j, i]
    turn = np.sqrt(twist[0] * twist[0] + twist[1] * twist[1] + twist[2] * twist[2])
    shift = np.sqrt(twist[3] * twist[3] + twist[4] * twist[4] + twist[5] * twist[5])
    part = min(1.0, _MOST_TURN / max(turn, 1e-300), _MOST_SHIFT / max(shift, 1e-300))
    for i in range(6):
        twist[i] *= part
    return moved_about(
        pose, twists.pivot, (twist[0], twist[1], twist[2]), (twist[3], twist[4], twist[5])
    )


@leaf
def moved_about(pose, pivot, turn, shift):
    """x -> E (R x + t - p) + p + u: a pose turned about a point of the object, and shifted.

    E turns about `turn`, by twice the arctangent of half of its length (Cayley).
    """
    x, y, z = 0.5 * turn[0], 0.5 * turn[1], 0.5 * turn[2]
    factor = 2.0 / (1.0 + x * x + y * y + z * z)
    turning = (
        1.0 - factor * (y * y + z * z), factor * (x * y - z), factor * (x * z + y),
        factor * (x * y + z), 1.0 - factor * (x * x + z * z), factor * (y * z - x),
        factor * (x * z - y), factor * (y * z + x), 1.0 - factor * (x * x + y * y),
    )  # fmt: skip
    from_pivot = pose[9] - pivot[0], pose[10] - pivot[1], pose[11] - pivot[2]
    result = composed(turning + pivot, pose[:9] + from_pivot)
    translation = result[9] + shift[0], result[10] + shift[1], result[11] + shift[2]
    return result[:9] + translation
