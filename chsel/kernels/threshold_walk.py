"""Random walks of poses below a limit on their energy (threshold accepting: Dueck and Scheuer, 1990)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.arrays import FloatArray, IntArray
from chsel.kernels.compiler import compiled, inner, leaf, spliced
from chsel.kernels.cost import Model, place_in_world, remember, travel
from chsel.kernels.energy import found_around, known_below, with_free
from chsel.kernels.levenberg_marquardt import moved_about
from chsel.kernels.pose import pose_at
from chsel.kernels.tree import Found, walk

DRAWS = 9  # random numbers that a move takes
_SLACKS = 6.0  # sizes of a step that gathered points should last
_LEAST_SLACK, _MOST_SLACK = 0.004, 0.04  # metres


class Stride(NamedTuple):
    """How poses move: lengths in metres.

    first, least, most: of a step. grow, shrink: its factors after a move that was accepted or
    refused. per_metre: radians of a turn per metre of a step. about_contact: the share of turns about
    a contact, the others are about the pivot. axis: of all turns, zero for any;
    shifts are across it. lower, upper (3,): where the object may be in the world.
    """

    first: float
    least: float
    most: float
    grow: float
    shrink: float
    per_metre: float
    about_contact: float
    planar: bool
    axis: tuple[float, float, float]
    pivot: tuple[float, float, float]
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]


class Steps(NamedTuple):
    """Scratch of one thread."""

    found: Found
    memory: FloatArray


def steps_for(model: Model) -> Steps:
    """Scratch for one thread."""
    return Steps(found_around(model), np.empty(12))


class Chains(NamedTuple):
    """Walks, one each from poses (C, 12) with energies (C,), which they leave where they end.

    kept (C, K, 12), kept_energies (C, K): states at even spaces, infinite for one above the floor.
    moved (C,): accepted moves.
    """

    poses: FloatArray
    energies: FloatArray
    kept: FloatArray
    kept_energies: FloatArray
    moved: IntArray


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


@compiled
def walk_below(model, stride, floor, chains, draws, first, last, steps):  # type: ignore[no-untyped-def]
    """Move chains from `first` to `last` once for each of their draws (C, M, 9).

    A move is accepted if its energy is at most the limit of its chain: the energy of the chain
    where that is above the floor, so that the limit comes down with it, else the floor.
    """
    moves, keep = draws.shape[1], chains.kept.shape[1]
    for n in range(first, last):
        pose, energy, size = pose_at(chains.poses, n), chains.energies[n], stride.first
        slack, count, done = -1.0, 0, 0
        for m in range(moves):
            limit = max(energy, floor)
            trial = _proposed(model, stride, pose, size, draws[n, m])
            accepted = False
            if _within(stride, trial):
                total = known_below(model, trial, limit)
                if total <= limit:
                    count, slack = _gathered(model, pose, trial, size, count, slack, steps)
                    total = with_free(model, trial, total, limit, steps.found, count)
                    accepted = total <= limit
            if accepted:
                pose, energy = trial, total
                chains.moved[n] += 1
                size = min(size * stride.grow, stride.most)
            else:
                size = max(size * stride.shrink, stride.least)
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
def _gathered(model, pose, trial, size, count, slack, steps):  # type: ignore[no-untyped-def]
    """How many points around the trial were gathered, and the slack that they were gathered with."""
    free, memory = model.free, steps.memory
    place = place_in_world(free.centre, trial)
    if slack < 0.0 or travel(place, free.radius, trial, memory, 0) > slack:
        slack = min(max(_SLACKS * size, _LEAST_SLACK), _MOST_SLACK)
        remember(place, trial, memory, 0)
        count = walk(free.tree, free.region, trial, slack + free.margin, steps.found)
    return count, slack


@leaf
def _within(stride, pose):  # type: ignore[no-untyped-def]
    x = -(pose[0] * pose[9] + pose[3] * pose[10] + pose[6] * pose[11])
    y = -(pose[1] * pose[9] + pose[4] * pose[10] + pose[7] * pose[11])
    z = -(pose[2] * pose[9] + pose[5] * pose[10] + pose[8] * pose[11])
    low, high = stride.lower, stride.upper
    return low[0] <= x <= high[0] and low[1] <= y <= high[1] and low[2] <= z <= high[2]


@inner
def _proposed(model, stride, pose, size, draw):  # type: ignore[no-untyped-def]
    """A pose near by: draw (9,) is a factor of the size, two choices, a turn, and a shift."""
    size *= draw[0]
    turn, known = stride.per_metre * size, model.known
    a, b, c = turn * draw[3], turn * draw[4], turn * draw[5]
    u, v, w = size * draw[6], size * draw[7], size * draw[8]
    if stride.planar:
        x, y, z = stride.axis
        a, b, c = turn * draw[3] * x, turn * draw[3] * y, turn * draw[3] * z
        along = u * x + v * y + w * z
        u, v, w = u - along * x, v - along * y, w - along * z
    pivot = stride.pivot
    if draw[1] < stride.about_contact and known.shape[1] > 0:
        n = int(draw[2] * known.shape[1])
        x, y, z = known[0, n], known[1, n], known[2, n]
        pivot = (
            pose[0] * x + pose[1] * y + pose[2] * z + pose[9],
            pose[3] * x + pose[4] * y + pose[5] * z + pose[10],
            pose[6] * x + pose[7] * y + pose[8] * z + pose[11],
        )
    return moved_about(pose, pivot, (a, b, c), (u, v, w))
