"""The energy of a pose up to a limit, and random walks of poses below one.

While the limit comes down: threshold accepting (Dueck and Scheuer, 1990). Known points come first,
as they are the fewest and rule out most poses.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.cost.cost_kernels import Model
from chsel.methods.anchored.fine_cells import FineCells
from chsel.methods.anchored.fit_kernels import cost_of_residual, moved_about
from chsel.methods.anchored.surrounding_kernels import (
    Surrounding,
    gather,
    hit,
    look_around,
    place_of,
    surrounding_for,
    travel_since_gathering,
)
from chsel.numerics.arrays import FloatArray, IntArray, scratch
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.elementary import exp
from chsel.numerics.philox import Stream, fill_uniforms
from chsel.numerics.pose_tuples import moved, origin_within, pose_at
from chsel.problem.sdf_lookup import (
    distance_at,
    distance_between_nodes,
    distance_beyond_box,
    value_between_nodes,
)

DRAWS = 9  # random numbers that a move takes
_MOVES = 8  # whose random numbers are drawn together
_FIRST, _LEAST, _MOST = 0.01, 0.00005, 0.03  # metres: the size of moves
_GROW, _SHRINK = 1.1, 0.97  # it, after a move that was accepted or refused
_SMALLEST, _RANGE = 0.12589254117941673, 2.763102111592855  # a move's factor: 10^U(-0.9, 0.3)
_PER_METRE = 6.0  # radians that go with a metre
_ABOUT_CONTACT = 0.6  # share of the turns that are about a contact
_DEVIATION = 3.4641016151377544  # uniform numbers of [-1/2, 1/2] times it have a deviation of 1
_SLACKS = 3.0  # sizes of a step that gathered points should last
_LEAST_SLACK, _MOST_SLACK = 0.006, 0.02  # metres
_LARGE = 0.015  # metres: steps of this size leave any slack at once
_TOO_MUCH = 3.0  # times the slack that would last: points are gathered again
LANES = 20  # known points that are looked up at a time
_FEW = 8  # that are looked up one by one
# Rows of lanes, after three of fractions of cells.
_CELL, _READ, _COST = 3 * LANES, 4 * LANES, 5 * LANES


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


class MoveDraws(NamedTuple):
    """Random numbers for C chains: DRAWS for each move of the first, then of the second, ..."""

    stream: Stream
    moves: int  # of a chain


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


class Walk(NamedTuple):
    """Scratch of one thread."""

    near: Surrounding
    table: FloatArray  # (nodes,), signed distances of the grid alone, which are read faster
    known: FloatArray  # (4, N), known points in the world, signed distances; the last repeated
    lanes: FloatArray  # (6 LANES,), rows of what is known about some of them
    drawn: Any  # random numbers of some moves, float32


def walk_for(model: Model, table: FloatArray, fine: FineCells) -> Walk:
    """Scratch for one thread. table: the values of the grid. fine: see surrounding_for."""
    count = model.known.shape[1]
    known = np.zeros((4, -(-count // LANES) * LANES))
    known[:3, :count], known[3, :count] = model.known, model.known_sdf
    known[:, count:] = known[:, count - 1 : count]
    drawn = scratch(_MOVES * DRAWS + 16, dtype=np.float32)
    return Walk(surrounding_for(model, fine), table, known, scratch(6 * LANES), drawn)


@leaf
def _known_below(model, loss, pose, limit, walk):
    """The cost of known and occupied points; infinite if it is above the limit."""
    total, first, count = 0.0, 0, model.known.shape[1]
    while first < count:
        if count - first > _FEW:
            _fill_costs(model, loss, pose, walk, first)
            last = min(first + LANES, count)
            for n in range(last - first):
                total += walk.lanes[_COST + n]
        else:
            last = count
            for n in range(first, last):
                x, y, z = walk.known[0, n], walk.known[1, n], walk.known[2, n]
                s = _distance(model.field, pose, x, y, z)
                total += model.known_scale * cost_of_residual(loss, s - walk.known[3, n])
        if not total <= limit:
            return np.inf
        first = last
    occupied = model.occupied
    for n in range(occupied.shape[1]):
        s = distance_at(model.field, pose, occupied[0, n], occupied[1, n], occupied[2, n])
        total += min(max(model.alpha + s, 0.0), loss.most_wrong)
        if not total <= limit:
            return np.inf
    return total


@leaf
def _fill_costs(model, loss, pose, walk, first):
    """The costs of as many known points, from `first`, as there are lanes; in vectors."""
    field, box = model.field, model.field.box
    low, high, most, inverse = box.first, box.last, box.most, box.inverse
    known, lanes, last = walk.known, walk.lanes, first + LANES
    xs, ys, zs, values = (
        known[0, first:last],
        known[1, first:last],
        known[2, first:last],
        known[3, first:last],
    )
    beyond = 0
    for n in range(LANES):
        x, y, z = moved(pose, xs[n], ys[n], zs[n])
        a = min(max(low[0], x), high[0])
        b = min(max(low[1], y), high[1])
        c = min(max(low[2], z), high[2])
        beyond += 1 if (a != x) | (b != y) | (c != z) else 0
        u, v, w = (a - low[0]) * inverse, (b - low[1]) * inverse, (c - low[2]) * inverse
        i, j, k = min(np.floor(u), most[0]), min(np.floor(v), most[1]), min(np.floor(w), most[2])
        lanes[n], lanes[LANES + n], lanes[2 * LANES + n] = u - i, v - j, w - k
        lanes[_CELL + n] = i * box.across + j * box.along + k
    across, along = np.int64(box.across), np.int64(box.along)
    table = walk.table
    for n in range(LANES):
        u, v, w = lanes[n], lanes[LANES + n], lanes[2 * LANES + n]
        at = np.int64(lanes[_CELL + n])
        lanes[_READ + n] = _value(table, at, across, along, u, v, w)
    if beyond:
        for n in range(LANES):
            lanes[_READ + n] = _distance(field, pose, xs[n], ys[n], zs[n])
    for n in range(LANES):
        cost = cost_of_residual(loss, lanes[_READ + n] - values[n])
        lanes[_COST + n] = model.known_scale * cost


@inner
def _distance(field, pose, x, y, z):
    """Interpolated signed distance at a world point."""
    box = field.box
    low, high, most, inverse = box.first, box.last, box.most, box.inverse
    x, y, z = moved(pose, x, y, z)
    a = min(max(low[0], x), high[0])
    b = min(max(low[1], y), high[1])
    c = min(max(low[2], z), high[2])
    u, v, w = (a - low[0]) * inverse, (b - low[1]) * inverse, (c - low[2]) * inverse
    i, j, k = min(np.floor(u), most[0]), min(np.floor(v), most[1]), min(np.floor(w), most[2])
    u, v, w = u - i, v - j, w - k
    across, along = np.int64(box.across), np.int64(box.along)
    at = np.int64(i * box.across + j * box.along + k)
    if a != x or b != y or c != z:
        inside = distance_between_nodes(box, field.table, at, u, v, w)
        return distance_beyond_box(field.box_distance, box, inside, x, y, z)[0]
    return value_between_nodes(field.table, at, across, along, u, v, w)


@leaf
def _value(table, at, across, along, u, v, w):
    """What value_between_nodes makes of a table of values alone."""
    low, high = 1.0 - w, w
    at, one, along = np.uint64(at), np.uint64(1), np.uint64(along)
    a = low * table[at] + high * table[at + one]
    b = low * table[at + along] + high * table[at + along + one]
    at += np.uint64(across)
    c = low * table[at] + high * table[at + one]
    d = low * table[at + along] + high * table[at + along + one]
    return (1.0 - u) * ((1.0 - v) * a + v * b) + u * ((1.0 - v) * c + v * d)


@leaf
def _with_free(model, loss, pose, total, limit, walk):
    """A sum plus the cost of the free points gathered; infinite if it is above the limit."""
    box, values, near = model.field.box, walk.table, walk.near
    across, along = np.int64(box.across), np.int64(box.along)
    for n in range(look_around(model, pose, near)):
        cell, u, v, w = place_of(model, pose, hit(model, near, n))
        if cell >= 0:
            s = _value(values, cell, across, along, u, v, w)
            total += min(max(model.alpha - s, 0.0), loss.most_wrong)
            if not total <= limit:
                return np.inf
    return total


@inner
def _energy_below(model, loss, pose, limit, walk):
    """The energy of a rigid pose; infinite if it is above the limit."""
    total = _known_below(model, loss, pose, limit, walk)
    if not total <= limit:
        return np.inf
    gather(model, pose, 0.0, walk.near)
    return _with_free(model, loss, pose, total, limit, walk)


@compiled
def energies_below(model, loss, poses, limit, out, first, last, walk):
    """Fill out (B,) with the energies of poses (B, 12) up to a limit, from `first` to `last`."""
    for n in range(first, last):
        out[n] = _energy_below(model, loss, pose_at(poses, n), limit, walk)


@compiled
def walk_below(model, loss, stride, floor, chains, draws, first, last, walk):
    """Move the chains from `first` to before `last` once for each of their draws.

    A move is accepted if its energy is at most the limit of its chain: the energy of the chain
    where that is above the floor, so that the limit comes down with it, else the floor. Chains of
    which no states are kept stop there.
    """
    moves, keep, near = draws.moves, chains.kept.shape[1], walk.near
    for n in range(first, last):
        pose, energy, size = pose_at(chains.poses, n), chains.energies[n], _FIRST
        slack, done = -1.0, 0
        for m in range(moves):
            if keep == 0 and energy <= floor:
                break
            if m % _MOVES == 0:
                drawn = (n * moves + m) * DRAWS
                fill_uniforms(draws.stream, drawn, walk.drawn, 0, _MOVES * DRAWS)
            limit = max(energy, floor)
            at = m % _MOVES * DRAWS
            trial = _proposed(model, stride, pose, size, walk.drawn[at : at + DRAWS])
            accepted = False
            if origin_within(trial, stride.lower, stride.upper):
                total = _known_below(model, loss, trial, limit, walk)
                if total <= limit:
                    wanted = _slack_for(size)
                    far = slack < 0.0 or travel_since_gathering(model, trial, near) > slack
                    if far or slack > _TOO_MUCH * wanted:
                        slack = wanted
                        gather(model, trial, slack, near)
                    total = _with_free(model, loss, trial, total, limit, walk)
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


@leaf
def _slack_for(size):
    """How far the object may move, at steps of a size, until points are gathered again."""
    return min(max(_SLACKS * size, _LEAST_SLACK), _MOST_SLACK) if size < _LARGE else 0.0


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
