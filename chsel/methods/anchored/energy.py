"""The energy of poses (see `chsel.problem.noise`) in kernels: one pose at a time, up to a limit."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_kernels import Model
from chsel.cost.cost_settings import CostSettings
from chsel.cost.free_kernels import is_apart, remember
from chsel.numerics.arrays import FloatArray, scratch
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.elementary import exp, log
from chsel.numerics.near_points import NearPoints, gather, near_points_for, select, to_cells
from chsel.numerics.pose_tuples import moved, pose_at, rigid, turned
from chsel.numerics.threads import parallel_for
from chsel.problem.noise import EXTENT, LATER, SHARE, WRONG_NORMALS, NoiseModel
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses
from chsel.problem.prior_kernels import Prior, prior_energy, prior_of
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_lookup import (
    cell_of,
    distance_at,
    distance_with_gradient,
    value_between_nodes,
)

# Where these numbers are from: docs/anchored.md, "Numbers that are no settings".
_ROWS_PER_LEVEL = 4.0  # of tables, in the least s_k
_BEYOND = 6.0  # of the greatest s_k: residuals beyond cost no more
_AT_ONCE = 16  # known points between two comparisons with the limit
_LEVELS = 8  # K of the likelihood, as kernels take constants from kernel files alone
_LEAST_PRODUCT = 1e-300  # of densities, by the largest
_LEAST_GRADIENT = 1e-12  # length of one that has a direction
_ALL = -1  # instead of the number of packets that were gathered


class Likelihood(NamedTuple):
    """A noise model of M known points as kernels read it."""

    densities: FloatArray  # (rows K,), of residuals, 1/m: a row of K for each step of them
    precisions: FloatArray  # (K,), 1/m^2
    weights: FloatArray  # (K,)
    scales: FloatArray  # (M,), inverse of the greatest density of each known point, m
    normals: FloatArray  # (3, M), of known points, world
    variances: FloatArray  # (M,), of normals on flat faces, radians^2; 0 where there is none
    foreign: float  # density of contacts with other objects, 1/m
    per_metre: float  # rows
    last: float  # row that can be interpolated to
    shared: float  # metres
    power: float  # t
    softness: float  # metres
    wrong: float  # nats
    later: float  # share of costs beyond
    prior: Prior  # on the pose, a further factor


def likelihood_of(noise: NoiseModel, known: KnownPoints, *, prior: Prior) -> Likelihood:
    """Return tables for known points, in their order, and a prior."""
    step = noise.sigmas[0] / _ROWS_PER_LEVEL
    rows = int(_BEYOND * noise.sigmas[-1] / step) + 2
    sizes = step * np.arange(rows, dtype=np.float64)
    densities = replace(noise, shared=0.0).densities(sizes)
    variances = noise.normal_variances(known.normal_noise)
    return Likelihood(
        densities=densities.reshape(rows * _LEVELS),
        precisions=1.0 / np.array(noise.sigmas) ** 2,
        weights=np.array(noise.weights),
        scales=1.0 / noise.greatest(variances),
        normals=known.normals.T.copy(),
        variances=variances,
        foreign=SHARE / EXTENT,
        per_metre=1.0 / step,
        last=rows - 1.000001,
        shared=noise.shared,
        power=noise.power(len(known.known)),
        softness=noise.softness,
        wrong=noise.wrong,
        later=LATER,
        prior=prior,
    )


class Scratch(NamedTuple):
    """Scratch arrays of one thread."""

    near: NearPoints  # the free points gathered
    memory: FloatArray  # (12,), where the object was then, see remember and travel
    levels: FloatArray  # (K,), products of densities, then posterior weights


class Energy:
    """The energy of poses by the points of a problem."""

    def __init__(
        self, problem: RegistrationProblem, known: KnownPoints, *, noise: NoiseModel
    ) -> None:
        """known: the problem's points, in the order in which they are looked up."""
        settings = CostSettings(penetration_tolerance=0.0)
        side = problem.free_resolution
        self._cost = CompiledCost(problem.sdf, known, settings=settings, free_resolution=side)
        self._sdf = problem.sdf
        self._known = known
        self._prior = prior_of(problem.prior, problem.sdf)
        self._set(noise)

    def _set(self, noise: NoiseModel) -> None:
        self.model: Model = self._cost.at_level(self._sdf, -noise.shared)
        self.likelihood = likelihood_of(noise, self._known, prior=self._prior)

    def by(self, noise: NoiseModel) -> Energy:
        """Return the energy by another noise model."""
        other = copy(self)
        other._set(noise)
        return other

    def scratch(self) -> Scratch:
        """Return scratch of one thread."""
        near = near_points_for(self.model.free.tree, 1)
        return Scratch(near, scratch(12), levels=scratch(_LEVELS))

    def of(self, poses: Poses) -> FloatArray:
        """Return energies (B,) of poses."""
        energies = np.empty(len(poses))

        def run(first: int, last: int, work: Any) -> None:
            energies_of(self.model, self.likelihood, poses.numbers, energies, first, last, work)

        parallel_for(run, len(poses), scratch=self.scratch, least=50)
        return energies


@compiled
def energies_of(model, likelihood, poses, out, first, last, work):
    """Fill out (B,) with the energies of poses (B, 12), from `first` to before `last`."""
    for n in range(first, last):
        pose = pose_at(poses, n)
        known = known_energy(model, likelihood, pose, np.inf, work.levels)
        gather_free(model, pose, 0.0, work)
        out[n] = energy_below(model, likelihood, pose, known, np.inf, work)[0]


@leaf
def known_energy(model, likelihood, pose, limit, levels):
    """Return the energy of known points and of the prior; infinite if surely above a limit.

    levels (K,) become the posterior weights of the levels of noise.
    """
    known = model.known
    table = likelihood.densities
    foreign = likelihood.foreign
    power = likelihood.power
    count, size = known.shape[1], np.uint64(_LEVELS)
    offset = prior_energy(likelihood.prior, pose)
    if offset > limit:
        return np.inf
    for k in range(size):
        levels[k] = 1.0
    for first in range(0, count, _AT_ONCE):
        for n in range(first, min(first + _AT_ONCE, count)):
            point = known[0, n], known[1, n], known[2, n]
            s, factor = distance_and_factor(model, likelihood, pose, n, point)
            at, part = _row(likelihood, s - model.known_sdf[n])
            scale = likelihood.scales[n]
            for k in range(size):
                low = table[at + k]
                density = low + part * (table[at + size + k] - low)
                levels[k] *= scale * (density * factor + foreign)
        largest = 0.0
        for k in range(size):
            largest = max(largest, levels[k])
        offset -= power * log(largest)
        if offset > limit:  # densities are at most 1 by their scales
            return np.inf
        for k in range(size):
            levels[k] /= largest
    total = 0.0
    for k in range(size):
        if power < 1.0:
            levels[k] = exp(power * log(max(levels[k], _LEAST_PRODUCT)))
        levels[k] *= likelihood.weights[k]
        total += levels[k]
    for k in range(size):
        levels[k] /= total
    return offset - log(total)


@leaf
def distance_and_factor(model, likelihood, pose, n, point):
    """Return the signed distance at the n-th known point, and the factor F of its normal."""
    if likelihood.variances[n] == 0.0:
        return distance_at(model.field, pose, point[0], point[1], point[2]), 1.0
    looked_up = distance_with_gradient(model.field, pose, point[0], point[1], point[2])
    return looked_up[0], normal_beside(likelihood, pose, n, looked_up)[0]


@leaf
def normal_beside(likelihood, pose, n, looked_up):
    """Return F, and the derivative of -log F by 1 - cos, for the n-th known point's normal.

    looked_up: distance and gradient there. Then the normal, and the gradient's direction, in the
    object's frame.
    """
    _, x, y, z = looked_up
    length = np.sqrt(x * x + y * y + z * z)
    unit = 1.0 / max(length, _LEAST_GRADIENT)
    x, y, z = x * unit, y * unit, z * unit
    normals = likelihood.normals
    u, v, w = turned(pose, normals[0, n], normals[1, n], normals[2, n])
    b = 0.5 / (likelihood.variances[n] + max(1.0 - length, 0.0))
    off = 1.0 + b * (1.0 - (u * x + v * y + w * z))
    peak = 1.0 + 2.0 * b
    density = (1.0 - WRONG_NORMALS) * peak * peak / ((1.0 + b) * (off * off * off))
    factor = density + WRONG_NORMALS
    return factor, density / factor * 3.0 * b / off, (u, v, w), (x, y, z)


@leaf
def _row(likelihood, residual):
    """Return the index of a residual's row in tables, and its fraction of the step beyond."""
    size = max(abs(residual) - likelihood.shared, 0.0)
    row = min(size * likelihood.per_metre, likelihood.last)
    at = np.uint64(row)
    return at * np.uint64(_LEVELS), row - np.float64(at)


@leaf
def known_slope(likelihood, residual, factor, levels):
    """Return the derivative of the energy by half of a squared residual, and of log F.

    levels: posterior weights. The second one is minus the chance that it is on the object.
    """
    at, part = _row(likelihood, residual)
    table, size = likelihood.densities, np.uint64(_LEVELS)
    slope = 0.0
    chance = 0.0
    for k in range(size):
        low = table[at + k]
        density = factor * (low + part * (table[at + size + k] - low))
        share = levels[k] * density / (density + likelihood.foreign)
        chance += share
        slope += share * likelihood.precisions[k]
    return likelihood.power * slope, likelihood.power * chance


@leaf
def _depth_cost(likelihood, depth):
    """Return the cost of a free or occupied point so deep on the wrong side, metres."""
    ratio = depth / likelihood.softness
    return min(0.5 * ratio * ratio, likelihood.wrong)


@leaf
def _depth_energy(likelihood, costs):
    """Return the energy of all points on the wrong side, whose costs have this sum."""
    beyond = likelihood.later * (costs - likelihood.wrong)
    return likelihood.power * min(costs, likelihood.wrong + beyond)


@leaf
def depth_slope(likelihood, depth, costs):
    """Return the derivative of _depth_energy by half of one squared depth."""
    ratio, softness = depth / likelihood.softness, likelihood.softness
    if 0.5 * ratio * ratio >= likelihood.wrong:
        return 0.0
    share = 1.0 if costs <= likelihood.wrong else likelihood.later
    return share * likelihood.power / (softness * softness)


@leaf
def energy_below(model, likelihood, pose, known, limit, work):
    """Return an energy of `known_energy` plus that of occupied and of gathered free points.

    It is infinite above a limit. Also return the sum of the costs of the latter.
    """
    occupied = model.occupied
    table = model.field.table
    costs = 0.0
    for n in range(occupied.shape[1]):
        s = distance_at(model.field, pose, occupied[0, n], occupied[1, n], occupied[2, n])
        costs += _depth_cost(likelihood, max(s + model.alpha, 0.0))
    across, along = np.int64(model.field.box.across), np.int64(model.field.box.along)
    total = known + _depth_energy(likelihood, costs)
    for n in range(look_around(model, pose, work)):
        if not total <= limit:
            break
        cell, u, v, w = free_cell(model, pose, free_point(model, work, n))
        if cell >= 0:
            s = value_between_nodes(table, cell, across, along, u, v, w)
            costs += _depth_cost(likelihood, max(model.alpha - s, 0.0))
            total = known + _depth_energy(likelihood, costs)
    return total if total <= limit else np.inf, costs


@inner
def gather_free(model, pose, slack, work):
    """Gather the free points that can matter until the object moves by a slack, metres."""
    free, points = model.free, work.near
    remember(free, pose, work.memory)
    to_cell, rounding = to_cells(free.tree, free.cells.box, pose)
    if len(free.tree.order) == 0:
        points.number[0] = 0
    elif rounding < 0.0 or not rigid(pose):
        points.number[0] = _ALL
    elif is_apart(free, pose, slack + rounding):
        points.number[0] = 0
    else:
        gather(free.tree, free.cells, to_cell, slack + rounding, points, 0)


@leaf
def look_around(model, pose, work):
    """Fill hits with those gathered that may cost something at a pose; return their number."""
    free, points = model.free, work.near
    if points.number[0] == 0:
        return 0
    to_cell, rounding = to_cells(free.tree, free.cells.box, pose)
    if points.number[0] != _ALL and rounding >= 0.0:
        return select(free.tree, free.cells, to_cell, rounding, points, 0)
    count = len(free.tree.order)
    for at in range(count):
        points.hits[at] = at
    return count


@leaf
def free_point(model, work, n):
    """Return the n-th of the hits: a point of the world."""
    at, points = np.uint64(work.near.hits[n]), model.free.tree.points
    return points[0, at], points[1, at], points[2, at]


@leaf
def free_cell(model, pose, point):
    """Return the lowest node of a point's cell, -1 if free points cost nothing, and fractions."""
    x, y, z = moved(pose, point[0], point[1], point[2])
    (cell, _, _, u, v, w), is_beyond = cell_of(model.field.box, x, y, z)
    if is_beyond or model.free.cells.steps[np.uint64(cell)] > 0:
        cell = -1
    return cell, u, v, w
