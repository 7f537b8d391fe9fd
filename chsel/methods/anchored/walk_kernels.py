"""The energy of a pose up to a limit, and random walks of poses below one.

While the limit comes down: threshold accepting (Dueck and Scheuer, 1990). Known points come first,
as they are the fewest and rule out most poses.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.methods.anchored.fit_kernels import cost_of_residual, moved_about
from chsel.methods.anchored.surrounding_kernels import (
    gather,
    look_around,
    travel_since_gathering,
)
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.cell_set import locate
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.elementary import exp
from chsel.numerics.pose_tuples import moved, origin_within, pose_at
from chsel.problem.sdf_lookup import distance_at, distance_in_place, value_between_nodes

DRAWS = 9  # random numbers that a move takes
_FIRST, _LEAST, _MOST = 0.01, 0.00005, 0.03  # metres: the size of moves
_GROW, _SHRINK = 1.1, 0.97  # it, after a move that was accepted or refused
_SMALLEST, _RANGE = 0.12589254117941673, 2.763102111592855  # a move's factor: 10^U(-0.9, 0.3)
_PER_METRE = 6.0  # radians that go with a metre
_ABOUT_CONTACT = 0.6  # share of the turns that are about a contact
_DEVIATION = 3.4641016151377544  # uniform numbers of [-1/2, 1/2] times it have a deviation of 1
_SLACKS = 3.0  # sizes of a step that gathered points should last
_LEAST_SLACK, _MOST_SLACK = 0.004, 0.02  # metres
_PART = 16  # known points that are located at a time


class Stride(NamedTuple):
    """How poses move."""

    planar: bool  # turns are about the axis alone, and shifts across it
    axis: tuple[float, float, float]
    pivot: tuple[float, float, float]  # of the object, where it does not turn about a contact
    lower: tuple[float, float, float]  # where the object's origin may be in the world
    upper: tuple[float, float, float]


class Chains(NamedTuple):
    """Walks of C poses."""

    poses: FloatArray  # (C, 12), at the start, then at the end
    energies: FloatArray  # (C,), of these
    kept: FloatArray  # (C, K, 12), poses at even spaces
    kept_energies: FloatArray  # (C, K), infinite for one above the floor
    moved: IntArray  # (C,), accepted moves


def chains_from(poses: FloatArray, energies: FloatArray, kept: int) -> Chains:
    """Chains that begin at poses (C, 12) with energies (C,)."""
    count = len(poses)
    return Chains(
        np.array(poses),
        np.array(energies),
        np.zeros((count, kept, 12)),
        np.full((count, kept), np.inf),
        np.zeros(count, dtype=np.int64),
    )


@inner
def _known_below(model, loss, pose, limit, places):
    """The cost of known and occupied points; infinite if it is above the limit."""
    total, first = 0.0, 0
    known, field, count = model.known, model.field, model.known.shape[1]
    while first < count:
        last = min(first + _PART, count)
        x, y, z = known[0, first:last], known[1, first:last], known[2, first:last]
        locate(pose, field.box, x, y, z, places, last - first)
        for n in range(last - first):
            s = _distance(field, pose, x[n], y[n], z[n], places, n)
            total += model.known_scale * cost_of_residual(loss, s - model.known_sdf[first + n])
            if not total <= limit:
                return np.inf
        first = last
    occupied = model.occupied
    for n in range(occupied.shape[1]):
        s = distance_at(field, pose, occupied[0, n], occupied[1, n], occupied[2, n])
        total += min(max(model.alpha + s, 0.0), loss.most_wrong)
        if not total <= limit:
            return np.inf
    return total


@leaf
def _distance(field, pose, x, y, z, places, n):
    """Interpolated signed distance at a world point, whose place is the n-th."""
    if places.beyond[n] > 0.0:
        return distance_in_place(field, pose, x, y, z, places, n)[0]
    across, along = int(field.box.across), int(field.box.along)
    u, v, w = places.u[n], places.v[n], places.w[n]
    return value_between_nodes(field.table, places.cell[n], across, along, u, v, w)


@inner
def _with_free(model, loss, pose, total, limit, near):
    """A sum plus the cost of the free points gathered; infinite if it is above the limit."""
    free, box, table = model.free, model.field.box, model.field.table
    across, along = int(box.across), int(box.along)
    clearance, places = free.region.clearance, near.places
    for n in range(look_around(model, pose, near)):
        at = places.cell[n]
        if clearance[at] < 0.0 and places.beyond[n] == 0.0:
            s = value_between_nodes(table, at, across, along, places.u[n], places.v[n], places.w[n])
            total += min(max(model.alpha - s, 0.0), loss.most_wrong)
            if not total <= limit:
                return np.inf
    return total


@inner
def _energy_below(model, loss, pose, limit, near):
    """The energy of a rigid pose; infinite if it is above the limit."""
    total = _known_below(model, loss, pose, limit, near.places)
    if not total <= limit:
        return np.inf
    gather(model, pose, 0.0, near)
    return _with_free(model, loss, pose, total, limit, near)


@compiled
def energies_below(model, loss, poses, limit, out, first, last, near):
    """Fill out (B,) with the energies of poses (B, 12) up to a limit, from `first` to `last`."""
    for n in range(first, last):
        out[n] = _energy_below(model, loss, pose_at(poses, n), limit, near)


@compiled
def walk_below(model, loss, stride, floor, chains, draws, first, last, near):
    """Move the chains from `first` to before `last` once for each of their draws (C, M, 9).

    A move is accepted if its energy is at most the limit of its chain: the energy of the chain
    where that is above the floor, so that the limit comes down with it, else the floor. Chains of
    which no states are kept stop there.
    """
    moves, keep = draws.shape[1], chains.kept.shape[1]
    for n in range(first, last):
        pose, energy, size = pose_at(chains.poses, n), chains.energies[n], _FIRST
        slack, done = -1.0, 0
        for m in range(moves):
            if keep == 0 and energy <= floor:
                break
            limit = max(energy, floor)
            trial = _proposed(model, stride, pose, size, draws[n, m])
            accepted = False
            if origin_within(trial, stride.lower, stride.upper):
                total = _known_below(model, loss, trial, limit, near.places)
                if total <= limit:
                    if slack < 0.0 or travel_since_gathering(model, trial, near) > slack:
                        slack = min(max(_SLACKS * size, _LEAST_SLACK), _MOST_SLACK)
                        gather(model, trial, slack, near)
                    total = _with_free(model, loss, trial, total, limit, near)
                    accepted = total <= limit
            if accepted:
                pose, energy = trial, total
                chains.moved[n] += 1
                size = min(size * _GROW, _MOST)
            else:
                size = max(size * _SHRINK, _LEAST)
            if keep > 0 and (m + 1) * keep >= (done + 1) * moves:
                if energy <= floor:
                    chains.kept_energies[n, done] = energy
                    for i in range(12):
                        chains.kept[n, done, i] = pose[i]
                done += 1
        chains.energies[n] = energy
        for i in range(12):
            chains.poses[n, i] = pose[i]


@inner
def _proposed(model, stride, pose, size, draw):
    """A pose near by. draw (9,): of a factor of the size, two choices, a turn, and a shift."""
    size *= _SMALLEST * exp(_RANGE * draw[0])
    shift, turn, known = size * _DEVIATION, size * _DEVIATION * _PER_METRE, model.known
    a, b, c = turn * (draw[3] - 0.5), turn * (draw[4] - 0.5), turn * (draw[5] - 0.5)
    u, v, w = shift * (draw[6] - 0.5), shift * (draw[7] - 0.5), shift * (draw[8] - 0.5)
    if stride.planar:
        x, y, z = stride.axis
        b, c = a * y, a * z
        a = a * x
        along = u * x + v * y + w * z
        u, v, w = u - along * x, v - along * y, w - along * z
    pivot = stride.pivot
    if draw[1] < _ABOUT_CONTACT and known.shape[1] > 0:
        n = int(draw[2] * known.shape[1])
        pivot = moved(pose, known[0, n], known[1, n], known[2, n])
    return moved_about(pose, pivot, (a, b, c), (u, v, w))
