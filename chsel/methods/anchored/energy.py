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
from chsel.numerics.arrays import FloatArray, IntArray, scratch
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.elementary import exp, log
from chsel.numerics.near_points import NearPoints, gather, near_points_for, to_cells
from chsel.numerics.pose_tuples import pose_at, rigid, turned
from chsel.numerics.threads import parallel_for
from chsel.problem.lookup_blocks import (
    BEYOND,
    CELL,
    MOST,
    SIZE,
    S,
    X,
    Y,
    Z,
    block_of,
    blocks_of,
    distance_in_block,
    distance_in_box_block,
    gradient_in_block,
    locate_block,
)
from chsel.problem.noise import EXTENT, LATER, SHARE, WRONG_NORMALS, NoiseModel
from chsel.problem.points import KnownPoints
from chsel.problem.poses import Poses
from chsel.problem.prior_kernels import Prior, prior_energy, prior_of
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.sdf_lookup import distance_at

# Where these numbers are from: docs/anchored.md, "Numbers that are no settings".
_ROWS_PER_LEVEL = 4.0  # of tables, in the least s_k
_BEYOND = 6.0  # of the greatest s_k: residuals beyond cost no more
_AT_ONCE = 8  # known points between two comparisons with the limit
_LEVELS = 8  # K of the likelihood, as kernels take constants from kernel files alone
_LEAST_PRODUCT = 1e-300  # of densities, by the largest
_LEAST_GRADIENT = 1e-12  # length of one that has a direction


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

    near: NearPoints  # of the packets of free points
    memory: FloatArray  # (12,), where the object was when they were gathered, see remember
    levels: FloatArray  # (K,), posterior weights, up to a factor
    known: FloatArray  # (B SIZE,), blocks of known points, where looked up last
    free: (
        FloatArray  # (C SIZE,), blocks of the free points gathered, where they were looked up last
    )
    deep: IntArray  # (S,), which of them cost something there
    counts: IntArray  # (2,), how many are gathered, and how many cost something


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
        self._blocks = blocks_of(known.known)
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
        free = len(self.model.free.tree.order)
        return Scratch(
            near,
            scratch(12),
            levels=scratch(_LEVELS),
            known=self._blocks.copy(),
            free=np.empty(-(-free // MOST) * SIZE),
            deep=np.empty(free, dtype=np.int64),
            counts=scratch(2, dtype=np.int64),
        )

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
        known = known_energy(model, likelihood, pose, np.inf, work)
        gather_free(model, pose, 0.0, work)
        out[n] = energy_below(model, likelihood, pose, known, np.inf, work)[0]


@leaf
def known_energy(model, likelihood, pose, limit, work):
    """Return the energy of known points and of the prior; infinite if surely above a limit.

    work.levels (K,) become the posterior weights of the levels of noise, up to a factor, and
    work.known the places of known points.
    """
    count = model.known.shape[1]
    field = model.field
    power = likelihood.power
    offset = prior_energy(likelihood.prior, pose)
    if offset > limit:
        return np.inf
    least = exp((offset - limit) / power)  # density, as all are at most 1 by their scales
    levels = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    for first in range(0, count, MOST):
        size = min(MOST, count - first)
        block = block_of(work.known, first)
        locate_block(field.box, pose, block, size)
        for start in range(0, size, _AT_ONCE):
            for n in range(start, min(start + _AT_ONCE, size)):
                s, factor = _distance_and_factor(model, likelihood, pose, first + n, block, n)
                block[S + n] = s
                at, part = _row(likelihood, s - model.known_sdf[first + n])
                levels = _times_densities(levels, likelihood, at, part, factor, first + n)
            if _largest(levels) < least:
                return np.inf
        largest = _largest(levels)
        offset -= power * log(largest)
        if offset > limit:
            return np.inf
        least = exp((offset - limit) / power)
        levels = _times(levels, 1.0 / largest)
    total = 0.0
    out = work.levels
    for k in range(_LEVELS):
        level = levels[k]
        if power < 1.0:
            level = exp(power * log(max(level, _LEAST_PRODUCT)))
        out[k] = level * likelihood.weights[k]
        total += out[k]
    return offset - log(total)


@leaf
def _times_densities(levels, likelihood, at, part, factor, n):
    """Return levels times the densities of the n-th known point, whose residual has a row."""
    table = likelihood.densities
    foreign = likelihood.foreign
    scale = likelihood.scales[n]
    a, b, c, d, e, f, g, h = _eight(table, at)
    p, q, r, s, t, u, v, w = _eight(table, at + np.uint64(_LEVELS))
    return (
        levels[0] * (scale * ((a + part * (p - a)) * factor + foreign)),
        levels[1] * (scale * ((b + part * (q - b)) * factor + foreign)),
        levels[2] * (scale * ((c + part * (r - c)) * factor + foreign)),
        levels[3] * (scale * ((d + part * (s - d)) * factor + foreign)),
        levels[4] * (scale * ((e + part * (t - e)) * factor + foreign)),
        levels[5] * (scale * ((f + part * (u - f)) * factor + foreign)),
        levels[6] * (scale * ((g + part * (v - g)) * factor + foreign)),
        levels[7] * (scale * ((h + part * (w - h)) * factor + foreign)),
    )


@leaf
def _eight(table, at):
    """Return a row of a table, all loaded before anything is stored."""
    return (
        table[at],
        table[at + np.uint64(1)],
        table[at + np.uint64(2)],
        table[at + np.uint64(3)],
        table[at + np.uint64(4)],
        table[at + np.uint64(5)],
        table[at + np.uint64(6)],
        table[at + np.uint64(7)],
    )


@leaf
def _largest(levels):
    a, b, c, d, e, f, g, h = levels
    return max(max(max(a, b), max(c, d)), max(max(e, f), max(g, h)))


@leaf
def _times(levels, factor):
    a, b, c, d, e, f, g, h = levels
    return (
        a * factor, b * factor, c * factor, d * factor,
        e * factor, f * factor, g * factor, h * factor,
    )  # fmt: skip


@leaf
def _distance_and_factor(model, likelihood, pose, n, block, at):
    """Return the signed distance at the n-th known point, and the factor F of its normal.

    at: its number in a block.
    """
    if likelihood.variances[n] == 0.0:
        return distance_in_block(model.field, pose, block, at), 1.0
    looked_up = gradient_in_block(model.field, pose, block, at)
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

    It is infinite above a limit. Also return the sum of the costs of the latter. work.deep becomes
    the free points that cost something, where the energy is not above the limit.
    """
    occupied = model.occupied
    field = model.field
    steps = model.free.cells.steps
    alpha = model.alpha
    deep = work.deep
    costs = 0.0
    for n in range(occupied.shape[1]):
        s = distance_at(field, pose, occupied[0, n], occupied[1, n], occupied[2, n])
        costs += _depth_cost(likelihood, max(s + alpha, 0.0))
    total = known + _depth_energy(likelihood, costs)
    count = work.counts[0]
    found = 0
    for first in range(0, count, MOST):
        if not total <= limit:
            return np.inf, costs
        size = min(MOST, count - first)
        block = block_of(work.free, first)
        locate_block(field.box, pose, block, size)
        for n in range(size):
            if block[BEYOND + n] == 0.0 and steps[np.uint64(np.int64(block[CELL + n]))] == 0:
                depth = alpha - distance_in_box_block(field, block, n)
                if depth > 0.0:
                    costs += _depth_cost(likelihood, depth)
                    deep[found] = first + n
                    found += 1
        total = known + _depth_energy(likelihood, costs)
    work.counts[1] = found
    return total if total <= limit else np.inf, costs


@inner
def gather_free(model, pose, slack, work):
    """Gather the free points that can matter until the object moves by a slack, metres."""
    free, near = model.free, work.near
    points = free.tree.points
    first = free.tree.first
    remember(free, pose, work.memory)
    to_cell, rounding = to_cells(free.tree, free.cells.box, pose)
    total = len(free.tree.order)
    count = 0
    if rounding < 0.0 or not rigid(pose):
        for at in range(total):
            _put_point(points, at, work.free, count)
            count += 1
    elif total > 0 and not is_apart(free, pose, slack + rounding):
        gather(free.tree, free.cells, to_cell, slack + rounding, near, 0)
        for n in range(near.number[0]):
            packet = near.kept[n]
            end = first[packet + 1] if packet + 1 < len(first) else total
            for at in range(first[packet], end):
                _put_point(points, at, work.free, count)
                count += 1
        if slack > 0.0:
            count = _keep_near(model, pose, slack, work.free, count)
    work.counts[0] = count


@leaf
def _put_point(points, at, blocks, n):
    """Set the n-th point of blocks."""
    to = n // MOST * SIZE + n % MOST
    blocks[to + X] = points[0, at]
    blocks[to + Y] = points[1, at]
    blocks[to + Z] = points[2, at]


@inner
def _keep_near(model, pose, slack, blocks, count):
    """Keep those of `count` points that are within a slack of the object; return how many.

    A point beyond the grid's box is at least as far from the object as the nearest of the box.
    """
    box = model.field.box
    steps = model.free.cells.steps
    reach = slack * (1.0 + 1e-9) + 1e-9
    cells = reach * box.inverse
    most = 1.0 + cells * cells
    kept = 0
    for first in range(0, count, MOST):
        size = min(MOST, count - first)
        block = block_of(blocks, first)
        locate_block(box, pose, block, size)
        for n in range(size):
            cell = np.uint64(np.int64(block[CELL + n]))
            if block[BEYOND + n] <= reach * reach and np.float64(steps[cell]) <= most:
                to = kept // MOST * SIZE + kept % MOST
                blocks[to + X] = block[X + n]
                blocks[to + Y] = block[Y + n]
                blocks[to + Z] = block[Z + n]
                kept += 1
    return kept
