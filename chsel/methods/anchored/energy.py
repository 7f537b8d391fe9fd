"""The energy of poses (see `chsel.problem.noise`) in kernels: one pose at a time, up to a limit."""

from __future__ import annotations

import math
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
from chsel.numerics.elementary import exp, exps, log, logs
from chsel.numerics.near_points import NearPoints, gather, near_points_for, select, to_cells
from chsel.numerics.pose_tuples import moved, pose_at, rigid
from chsel.numerics.threads import parallel_for
from chsel.problem.noise import EXTENT, LATER, SHARE, NoiseModel
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_lookup import cell_of, distance_at, value_between_nodes

# Where these numbers are from: docs/anchored.md, "Numbers that are no settings".
_ROWS_PER_LEVEL = 4.0  # of tables, in the least s_k
_BEYOND = 6.0  # of the greatest s_k: residuals beyond cost no more
_AT_ONCE = 16  # known points between two comparisons with the limit
_LEVELS = 8  # K of the likelihood, as kernels take constants from kernel files alone
_LOG_LEVELS = 2.0794415416798357  # ln K
_ALL = -1  # instead of the number of packets that were gathered


class Likelihood(NamedTuple):
    """A noise model as kernels read it: costs of residuals in tables, a row of K for each step."""

    costs: FloatArray  # (rows K,), nats: 0 for a residual of 0 at the least noise
    slopes: FloatArray  # (rows K,), derivatives of costs by half of the squared residual, 1/m^2
    log_weights: FloatArray  # (K,)
    per_metre: float  # rows
    last: float  # row that can be interpolated to
    shared: float  # metres
    power: float  # t
    softness: float  # metres
    wrong: float  # nats
    later: float  # share of costs beyond


def likelihood_of(noise: NoiseModel, known: int) -> Likelihood:
    """Return tables for so many known points."""
    step = noise.sigmas[0] / _ROWS_PER_LEVEL
    rows = int(_BEYOND * noise.sigmas[-1] / step) + 2
    sizes = step * np.arange(rows, dtype=np.float64)
    sigmas = np.array(noise.sigmas)
    costs = replace(noise, shared=0.0).costs(sizes)
    peak = (1.0 - SHARE) / (math.sqrt(2.0 * math.pi) * sigmas[0])
    foreign = SHARE / EXTENT / (peak + SHARE / EXTENT)
    slopes = (1.0 - foreign * exps(costs)) / sigmas**2
    return Likelihood(
        costs=costs.reshape(rows * _LEVELS),
        slopes=slopes.reshape(rows * _LEVELS),
        log_weights=logs(np.array(noise.weights)),
        per_metre=1.0 / step,
        last=rows - 1.000001,
        shared=noise.shared,
        power=noise.power(known),
        softness=noise.softness,
        wrong=noise.wrong,
        later=LATER,
    )


class Scratch(NamedTuple):
    """Scratch arrays of one thread."""

    near: NearPoints  # the free points gathered
    memory: FloatArray  # (12,), where the object was then, see remember and travel
    sums: FloatArray  # (K,), of costs, then posterior weights


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
        self._count = len(known.known)
        self._set(noise)

    def _set(self, noise: NoiseModel) -> None:
        self.model: Model = self._cost.at_level(self._sdf, -noise.shared)
        self.likelihood = likelihood_of(noise, self._count)

    def by(self, noise: NoiseModel) -> Energy:
        """Return the energy by another noise model."""
        other = copy(self)
        other._set(noise)
        return other

    def scratch(self) -> Scratch:
        """Return scratch of one thread."""
        near = near_points_for(self.model.free.tree, 1)
        return Scratch(near, scratch(12), sums=scratch(_LEVELS))

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
        known = known_energy(model, likelihood, pose, np.inf, work.sums)
        gather_free(model, pose, 0.0, work)
        out[n] = energy_below(model, likelihood, pose, known, np.inf, work)[0]


@leaf
def known_energy(model, likelihood, pose, limit, sums):
    """Return the energy of known points; infinite if it is surely above a limit.

    sums (K,) become the posterior weights of the levels.
    """
    field = model.field
    known = model.known
    levels = np.uint64(_LEVELS)
    costs, count = likelihood.costs, known.shape[1]
    for k in range(levels):
        sums[k] = 0.0
    for first in range(0, count, _AT_ONCE):
        for n in range(first, min(first + _AT_ONCE, count)):
            s = distance_at(field, pose, known[0, n], known[1, n], known[2, n])
            at, part = _row(likelihood, s - model.known_sdf[n])
            for k in range(levels):
                low = costs[at + k]
                sums[k] += low + part * (costs[at + levels + k] - low)
        least = np.inf
        for k in range(levels):
            least = min(least, likelihood.power * sums[k] - likelihood.log_weights[k])
        if least - _LOG_LEVELS > limit:  # costs are not negative
            return np.inf
    least, total = np.inf, 0.0
    for k in range(levels):
        sums[k] = likelihood.power * sums[k] - likelihood.log_weights[k]
        least = min(least, sums[k])
    for k in range(levels):
        sums[k] = exp(least - sums[k])
        total += sums[k]
    for k in range(levels):
        sums[k] /= total
    return least - log(total)


@leaf
def _row(likelihood, residual):
    """Return the index of a residual's row in tables, and its fraction of the step beyond."""
    size = max(abs(residual) - likelihood.shared, 0.0)
    row = min(size * likelihood.per_metre, likelihood.last)
    at = np.uint64(row)
    return at * np.uint64(_LEVELS), row - np.float64(at)


@leaf
def known_slope(likelihood, residual, weights):
    """Return the derivative of the energy by half of a squared residual; weights: of the levels."""
    at, part = _row(likelihood, residual)
    slopes = likelihood.slopes
    levels = np.uint64(_LEVELS)
    total = 0.0
    for k in range(levels):
        low = slopes[at + k]
        total += weights[k] * (low + part * (slopes[at + levels + k] - low))
    return likelihood.power * total


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
    """Return an energy of known points plus that of occupied and of gathered free ones.

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
