"""Levenberg-Marquardt steps that lower the energy of poses.

The normal equations are those of the energy's residuals, each weighed by the derivative of what it
costs: iteratively reweighted least squares (Holland and Welsch, 1977), and for the mixture over
levels of noise a step of expectation maximisation.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.cost.free_kernels import travel
from chsel.methods.anchored.energy import (
    Energy,
    Scratch,
    depth_slope,
    energy_below,
    gather_free,
    known_energy,
    known_slope,
    normal_beside,
)
from chsel.numerics.arrays import FloatArray, scratch
from chsel.numerics.cell_set import triple
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.pose_tuples import composed, moved, pose_at
from chsel.numerics.threads import parallel_for
from chsel.problem.lookup_blocks import MOST, S, X, Y, Z, block_of, gradient_in_block
from chsel.problem.poses import Poses
from chsel.problem.prior_kernels import add_prior
from chsel.problem.sdf_lookup import distance_with_gradient
from chsel.problem.search_space import SE2Space, SearchSpace

# Where these numbers are from: docs/anchored.md, "Numbers that are no settings".
_LEVER = 0.15  # metres that a radian counts for
_MOST_SHIFT = 0.08  # metres of a step
_MOST_TURN = 0.5  # radians of a step
_SLACK = 0.02  # metres that a pose may move before free points are gathered again
_FIRST_DAMPING = 1e-2  # of the mean of the diagonal
_LESS = 0.3  # factor of the damping after a step that lowered the energy
_MORE = 5.0  # and after one that did not
_MOST_DAMPING = 1e6
_ENOUGH = 1e-3  # relative gain below which a pose has converged


class Twists(NamedTuple):
    """The ways that a pose may move."""

    basis: FloatArray  # (d, 6), turns in radians, then shifts in metres
    pivot: tuple[float, float, float]  # the point of the object about which it turns


def twists_of(space: SearchSpace, pivot: FloatArray) -> Twists:
    """Return the motions of SE(3) or SE(2), about a point (3,) of the object."""
    basis = np.eye(6)
    if isinstance(space, SE2Space):
        basis = np.zeros((3, 6))
        basis[0, :3], basis[1, 3:], basis[2, 3:] = space.axis, space.e_u, space.e_v
    basis[:, :3] /= _LEVER
    return Twists(basis, triple(pivot))


class Fit(NamedTuple):
    """Scratch of one thread. Only the lower triangles of matrices are used."""

    work: Scratch  # of the energy
    sums: FloatArray  # (8, 6): over residuals, of products of their rates of change by twists, of
    # these rates times the residuals; and the rates of one
    normal: FloatArray  # (d, d), of the normal equations
    right: FloatArray  # (d,)
    factor: FloatArray  # (d, d), of Cholesky
    row: FloatArray  # (d,), the solution
    twist: FloatArray  # (6,)


def fitted(energy: Energy, twists: Twists, *, poses: Poses, steps: int) -> Poses:
    """Return poses after at most so many steps that lower their energies."""
    result = np.array(poses.numbers)
    d = len(twists.basis)

    def new_scratch() -> Fit:
        normal = scratch(d, d)
        right = scratch(d)
        factor = scratch(d, d)
        return Fit(
            energy.scratch(),
            scratch(8, 6),
            normal=normal,
            right=right,
            factor=factor,
            row=scratch(d),
            twist=scratch(6),
        )

    def run(first: int, last: int, fit: Any) -> None:
        fit_poses(energy.model, energy.likelihood, twists, result, steps, first, last, fit)

    parallel_for(run, len(result), scratch=new_scratch, least=8)
    return Poses(result)


@compiled
def fit_poses(model, likelihood, twists, poses, steps, first, last, fit):
    """Move poses (B, 12) from `first` to `last` by up to so many steps."""
    for n in range(first, last):
        pose = _fitted(model, likelihood, twists, pose_at(poses, n), steps, fit)
        for i in range(12):
            poses[n, i] = pose[i]


@leaf
def _fitted(model, likelihood, twists, pose, steps, fit):
    """Return a pose after up to so many steps that lower its energy."""
    dimension = len(twists.basis)
    damping = _FIRST_DAMPING
    trial = pose
    energy = np.inf
    for step in range(steps + 1):
        if step == 0 or travel(model.free, trial, fit.work.memory) > _SLACK:
            gather_free(model, trial, _SLACK, fit.work)
        known = known_energy(model, likelihood, trial, energy, fit.work)
        tried, costs = energy_below(model, likelihood, trial, known, energy, fit.work)
        if step == 0 or tried < energy:
            gain = energy - tried
            pose, energy = trial, tried
            if step > 0:
                damping *= _LESS
            if step == steps or gain < _ENOUGH * tried:
                break
            _linearise(model, likelihood, twists, pose, costs, fit)
        else:
            damping *= _MORE
            if step == steps or damping > _MOST_DAMPING:
                break
        trace = 0.0
        for i in range(dimension):
            trace += fit.normal[i, i]
        if not _solve(fit, damping * trace / dimension + 1e-12):
            break
        trial = _moved_by(twists, pose, fit)
    return pose


@leaf
def _linearise(model, likelihood, twists, pose, costs, fit):
    """Fill the normal equations at a pose whose energy was the last that was computed.

    costs: of free and occupied points, see energy_below.
    """
    field = model.field
    sums = fit.sums
    work = fit.work
    for i in range(7):
        for j in range(6):
            sums[i, j] = 0.0
    levels = work.levels
    total = 0.0
    for k in range(len(levels)):
        total += levels[k]
    for k in range(len(levels)):
        levels[k] /= total
    add_prior(likelihood.prior, pose, twists.pivot, sums)
    for n in range(model.known.shape[1]):
        block = block_of(work.known, n)
        point = model.known[0, n], model.known[1, n], model.known[2, n]
        looked_up = gradient_in_block(field, pose, block, n % MOST)
        residual = block[S + n % MOST] - model.known_sdf[n]
        factor = 1.0
        if likelihood.variances[n] > 0.0:
            factor, bend, normal, gradient = normal_beside(likelihood, pose, n, looked_up)
            chance = known_slope(likelihood, residual, factor, work.levels)[1]
            _add_normal(sums, normal, gradient, chance * bend)
        slope = known_slope(likelihood, residual, factor, work.levels)[0]
        _add(sums, twists.pivot, pose, point, looked_up, residual, slope)
    for n in range(work.counts[1]):
        block = block_of(work.free, work.deep[n])
        at = work.deep[n] % MOST
        point = block[X + at], block[Y + at], block[Z + at]
        looked_up = gradient_in_block(field, pose, block, at)
        depth = model.alpha - looked_up[0]
        slope = depth_slope(likelihood, depth, costs)
        _add(sums, twists.pivot, pose, point, looked_up, -depth, slope)
    for n in range(model.occupied.shape[1]):
        point = model.occupied[0, n], model.occupied[1, n], model.occupied[2, n]
        looked_up = distance_with_gradient(field, pose, point[0], point[1], point[2])
        height = looked_up[0] + model.alpha
        if height > 0.0:
            slope = depth_slope(likelihood, height, costs)
            _add(sums, twists.pivot, pose, point, looked_up, height, slope)
    _restrict(twists, fit)


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


@leaf
def _add_normal(sums, normal, gradient, weight):
    """Add weight (1 - m . g), half of |m - g|^2, for a normal m and a gradient g of length 1."""
    a, b, c = normal
    x, y, z = gradient
    sums[6, 0] -= weight * (b * z - c * y)
    sums[6, 1] -= weight * (c * x - a * z)
    sums[6, 2] -= weight * (a * y - b * x)
    sums[0, 0] += weight * (1.0 - a * a)
    sums[1, 1] += weight * (1.0 - b * b)
    sums[2, 2] += weight * (1.0 - c * c)
    sums[1, 0] -= weight * a * b
    sums[2, 0] -= weight * a * c
    sums[2, 1] -= weight * b * c


@inner
def _restrict(twists, fit):
    """Fill the normal equations from sums over all twists: B N B^T and B r."""
    basis = twists.basis
    sums = fit.sums
    product = fit.sums[7]
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
            fit.normal[i, j] = total
        total = 0.0
        for k in range(6):
            total += basis[i, k] * sums[6, k]
        fit.right[i] = total


@inner
def _solve(fit, damping):
    """Fill row with -(N + damping I)^-1 r by Cholesky; False if N is not positive definite so."""
    count = len(fit.row)
    lower, row = fit.factor, fit.row
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
    """Return the pose moved by the twist of the solution, shortened to what a step may be."""
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
    """Return x -> E (R x + t - p) + p + u: a pose turned about a point of the object, and shifted.

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
