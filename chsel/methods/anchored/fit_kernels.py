"""Levenberg-Marquardt steps that fit poses to known points and out of free space.

The residuals are s - v of every known point, the depth below a level of every free point that is
deeper, and how far every occupied one is above it, all of the same weight.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.cost.cost_kernels import Model, remember, travel
from chsel.methods.anchored.energy_kernels import found_around
from chsel.numerics.arrays import FloatArray
from chsel.numerics.cell_set import locate
from chsel.numerics.compiler import compiled, inner, leaf, spliced
from chsel.numerics.octree import Candidates, walk
from chsel.numerics.pose_tuples import pose_at
from chsel.problem.sdf_lookup import distance_in_box, distance_with_gradient

_SLACK = 0.04  # metres that a pose may move before they are gathered again
_FIRST_DAMPING = 1e-2  # of the mean of the diagonal
_LESS, _MORE = 0.3, 5.0  # damping, after a step that was good or bad
_MOST_DAMPING = 1e6
_ENOUGH = 1e-4  # relative gain below which a pose has converged


class Twists(NamedTuple):
    """The ways that a pose may move: basis (d, 6), turns by radians in its first three columns.

    pivot: the point of the object about which it turns. most_shift, most_turn: of a step, metres
    and radians.
    """

    basis: FloatArray
    pivot: tuple[float, float, float]
    most_shift: float
    most_turn: float


class Fit(NamedTuple):
    """Scratch of one thread.

    found: free points around a pose; memory (12,): which one. normal (d, d), right (d,): of the
    normal equations, below the diagonal. solved (d, d), row (d,): of their solution. twist (6,).
    """

    found: Candidates
    memory: FloatArray
    normal: FloatArray
    right: FloatArray
    solved: FloatArray
    twist: FloatArray
    row: FloatArray


def fit_for(model: Model, dimension: int) -> Fit:
    """Scratch for one thread, for twists of so many dimensions."""
    return Fit(
        found_around(model),
        np.empty(12),
        np.empty((dimension, dimension)),
        np.empty(dimension),
        np.empty((dimension, dimension)),
        np.empty(6),
        np.empty(dimension),
    )


@compiled
def fit_poses(model, twists, poses, iterations, first, last, fit):
    """Move poses (B, 12) from `first` to `last` by up to so many steps."""
    for n in range(first, last):
        pose = _fitted(model, twists, pose_at(poses, n), iterations, fit)
        for i in range(12):
            poses[n, i] = pose[i]


@inner
def _fitted(model, twists, pose, iterations, fit):
    dimension = len(twists.basis)
    memory, found = fit.memory, fit.found
    count = _gather(model, pose, memory, found)
    squares = _squares(model, twists, pose, found, count, fit, True)
    damping = _FIRST_DAMPING
    for _ in range(iterations):
        if squares == 0.0:
            break
        trace = 0.0
        for i in range(dimension):
            trace += fit.normal[i, i]
        if not _solve(fit, damping * trace / dimension + 1e-12):
            break
        trial = _moved_by(twists, pose, fit)
        if travel(model.free, trial, memory) > _SLACK:
            count = _gather(model, trial, memory, found)
        tried = _squares(model, twists, trial, found, count, fit, False)
        if tried < squares:
            gain = squares - tried
            pose = trial
            squares = _squares(model, twists, pose, found, count, fit, True)
            damping *= _LESS
            if gain < _ENOUGH * tried:
                break
        else:
            damping *= _MORE
            if damping > _MOST_DAMPING:
                break
    return pose


@spliced
def _gather(model, pose, memory, found):
    remember(model.free, pose, memory)
    return walk(model.free.tree, model.free.region, pose, _SLACK + model.free.margin, found)


@inner
def _squares(model, twists, pose, found, count, fit, with_normal):
    """The sum of squared residuals; fills the normal equations, if wanted."""
    field, box, table = model.field, model.field.box, model.field.table
    total, dimension = 0.0, len(twists.basis)
    if with_normal:
        for i in range(dimension):
            fit.right[i] = 0.0
            for j in range(i + 1):
                fit.normal[i, j] = 0.0
    clearance, places = model.free.region.clearance, found.places
    locate(pose, model.free.region.box, found.x, found.y, found.z, places, count)
    for n in range(count):
        if clearance[places.cell[n]] < 0.0 and places.beyond[n] == 0.0:
            s, nx, ny, nz = distance_in_box(field.trilinear, box, table, places, n)
            residual = s - model.alpha
            if residual < 0.0:
                total += residual * residual
                if with_normal:
                    _add(
                        twists, pose, found.x[n], found.y[n], found.z[n], nx, ny, nz, residual, fit
                    )
    for n in range(model.known.shape[1]):
        x, y, z = model.known[0, n], model.known[1, n], model.known[2, n]
        s, nx, ny, nz = distance_with_gradient(field, pose, x, y, z)
        residual = s - model.known_sdf[n]
        total += residual * residual
        if with_normal:
            _add(twists, pose, x, y, z, nx, ny, nz, residual, fit)
    for n in range(model.occupied.shape[1]):
        x, y, z = model.occupied[0, n], model.occupied[1, n], model.occupied[2, n]
        s, nx, ny, nz = distance_with_gradient(field, pose, x, y, z)
        residual = s + model.alpha
        if residual > 0.0:
            total += residual * residual
            if with_normal:
                _add(twists, pose, x, y, z, nx, ny, nz, residual, fit)
    return total


@inner
def _add(twists, pose, x, y, z, nx, ny, nz, residual, fit):
    """Add a residual at a world point with gradient n in the object frame."""
    u = pose[0] * x + pose[1] * y + pose[2] * z + pose[9] - twists.pivot[0]
    v = pose[3] * x + pose[4] * y + pose[5] * z + pose[10] - twists.pivot[1]
    w = pose[6] * x + pose[7] * y + pose[8] * z + pose[11] - twists.pivot[2]
    a, b, c = v * nz - w * ny, w * nx - u * nz, u * ny - v * nx
    basis, row = twists.basis, fit.row
    for i in range(len(basis)):
        turn = a * basis[i, 0] + b * basis[i, 1] + c * basis[i, 2]
        row[i] = turn + nx * basis[i, 3] + ny * basis[i, 4] + nz * basis[i, 5]
    for i in range(len(basis)):
        fit.right[i] += row[i] * residual
        for j in range(i + 1):
            fit.normal[i, j] += row[i] * row[j]


@inner
def _solve(fit, damping):
    """Fill row with - (N + damping I)^-1 r by Cholesky; False if that is not positive definite."""
    count = len(fit.right)
    lower, row = fit.solved, fit.row
    for i in range(count):
        for j in range(i + 1):
            total = fit.normal[i, j] + (damping if i == j else 0.0)
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                lower[i, i] = np.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    for i in range(count):
        total = -fit.right[i]
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
    """The pose moved by the twist that was solved for, shortened to what a step may be."""
    basis, twist = twists.basis, fit.twist
    for i in range(6):
        twist[i] = 0.0
        for j in range(len(basis)):
            twist[i] += fit.row[j] * basis[j, i]
    turn = np.sqrt(twist[0] * twist[0] + twist[1] * twist[1] + twist[2] * twist[2])
    shift = np.sqrt(twist[3] * twist[3] + twist[4] * twist[4] + twist[5] * twist[5])
    part = min(1.0, twists.most_turn / max(turn, 1e-300), twists.most_shift / max(shift, 1e-300))
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
    a = 1.0 - factor * (y * y + z * z)
    b = factor * (x * y - z)
    c = factor * (x * z + y)
    d = factor * (x * y + z)
    e = 1.0 - factor * (x * x + z * z)
    f = factor * (y * z - x)
    g = factor * (x * z - y)
    h = factor * (y * z + x)
    i = 1.0 - factor * (x * x + y * y)
    u, v, w = pose[9] - pivot[0], pose[10] - pivot[1], pose[11] - pivot[2]
    return (
        a * pose[0] + b * pose[3] + c * pose[6],
        a * pose[1] + b * pose[4] + c * pose[7],
        a * pose[2] + b * pose[5] + c * pose[8],
        d * pose[0] + e * pose[3] + f * pose[6],
        d * pose[1] + e * pose[4] + f * pose[7],
        d * pose[2] + e * pose[5] + f * pose[8],
        g * pose[0] + h * pose[3] + i * pose[6],
        g * pose[1] + h * pose[4] + i * pose[7],
        g * pose[2] + h * pose[5] + i * pose[8],
        a * u + b * v + c * w + pivot[0] + shift[0],
        d * u + e * v + f * w + pivot[1] + shift[1],
        g * u + h * v + i * w + pivot[2] + shift[2],
    )
