"""Random walks of poses below a limit on their energy.

While the limit comes down: threshold accepting (Dueck and Scheuer, 1990).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from chsel.cost.cost_kernels import Model, remember, travel
from chsel.methods.anchored.energy_kernels import found_around, known_below, with_free
from chsel.methods.anchored.fit_kernels import moved_about
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.numerics.compiler import compiled, inner
from chsel.numerics.elementary import exp
from chsel.numerics.octree import Candidates, walk
from chsel.numerics.pose_tuples import origin_within, pose_at

DRAWS = 9  # random numbers that a move takes
_FIRST, _LEAST, _MOST = 0.01, 0.00005, 0.03  # metres: the size of moves
_GROW, _SHRINK = 1.1, 0.97  # it, after a move that was accepted or refused
_SMALLEST, _RANGE = 0.12589254117941673, 2.763102111592855  # a move's factor: 10^U(-0.9, 0.3)
_PER_METRE = 6.0  # radians that go with a metre
_ABOUT_CONTACT = 0.6  # share of the turns that are about a contact
_DEVIATION = 3.4641016151377544  # uniform numbers of [-1/2, 1/2] times it have a deviation of 1
_SLACKS = 6.0  # sizes of a step that gathered points should last
_LEAST_SLACK, _MOST_SLACK = 0.004, 0.04  # metres


class Stride(NamedTuple):
    """How poses move.

    planar: turns are about the axis alone, and shifts across it. pivot: the point of the object
    about which it turns where it does not turn about a contact. lower, upper (3,): where the
    object's origin may be in the world.
    """

    planar: bool
    axis: tuple[float, float, float]
    pivot: tuple[float, float, float]
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]


class Steps(NamedTuple):
    """Scratch of one thread."""

    found: Candidates
    memory: FloatArray  # (12,), the pose that they were gathered around, see remember


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
def walk_below(model, stride, floor, chains, draws, before, first, last, steps):
    """Move the chains after the first `before` once for each of their draws (C, M, 9).

    A move is accepted if its energy is at most the limit of its chain: the energy of the chain
    where that is above the floor, so that the limit comes down with it, else the floor.
    """
    moves, keep = draws.shape[1], chains.kept.shape[1]
    for row in range(first, last):
        n = before + row
        pose, energy, size = pose_at(chains.poses, n), chains.energies[n], _FIRST
        slack, count, done = -1.0, 0, 0
        for m in range(moves):
            limit = max(energy, floor)
            trial = _proposed(model, stride, pose, size, draws[row, m])
            accepted = False
            if origin_within(trial, stride.lower, stride.upper):
                total = known_below(model, trial, limit)
                if total <= limit:
                    count, slack = _gathered(model, pose, trial, size, count, slack, steps)
                    total = with_free(model, trial, total, limit, steps.found, count)
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
def _gathered(model, pose, trial, size, count, slack, steps):
    """How many points were gathered around the trial or one before, and with what slack."""
    free, memory = model.free, steps.memory
    if slack < 0.0 or travel(free, trial, memory) > slack:
        slack = min(max(_SLACKS * size, _LEAST_SLACK), _MOST_SLACK)
        remember(free, trial, memory)
        count = walk(free.tree, free.region, trial, slack + free.margin, steps.found)
    return count, slack


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
        x, y, z = known[0, n], known[1, n], known[2, n]
        pivot = (
            pose[0] * x + pose[1] * y + pose[2] * z + pose[9],
            pose[3] * x + pose[4] * y + pose[5] * z + pose[10],
            pose[6] * x + pose[7] * y + pose[8] * z + pose[11],
        )
    return moved_about(pose, pivot, (a, b, c), (u, v, w))
