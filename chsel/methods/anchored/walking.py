"""Random walks of poses: down to a floor of their energy, or among the likely ones below it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from chsel.cost.free_kernels import travel
from chsel.methods.anchored.energy import (
    Energy,
    Scratch,
    energy_below,
    gather_free,
    known_energy,
)
from chsel.methods.anchored.fitting import moved_about
from chsel.numerics.arrays import FloatArray, scratch
from chsel.numerics.cell_set import triple
from chsel.numerics.compiler import compiled, inner, leaf
from chsel.numerics.elementary import exp, log
from chsel.numerics.pose_tuples import moved, origin_within, pose_at
from chsel.numerics.threads import parallel_for
from chsel.problem.poses import Poses
from chsel.problem.search_space import SE2Space, SearchSpace
from chsel.problem.streams import Stream, fill_uniforms

# Where these numbers are from: docs/anchored.md, "Numbers that are no settings".
_DRAWS = 10  # random numbers that a move takes
_MOVES = 8  # whose random numbers are drawn together
_FIRST = 0.01  # metres: the size of moves at first,
_LEAST = 0.00005  # at least,
_MOST = 0.03  # and at most
_GROW = 1.1  # factor of the size after a move that was accepted
_SHRINK = 0.97  # and after one that was refused
_SMALLEST = 0.12589254117941673  # least factor of a single move's size, 10^U(-0.9, 0.3)
_RANGE = 2.763102111592855  # of the logarithm of this factor
_PER_METRE = 6.0  # radians that go with a metre
_ABOUT_CONTACT = 0.6  # share of the turns that are about a contact
_DEVIATION = 3.4641016151377544  # uniform numbers of [-1/2, 1/2] times it have a deviation of 1
_SLACKS = 3.0  # sizes of a step that gathered points should last
_LEAST_SLACK = 0.006  # metres
_MOST_SLACK = 0.02  # metres
_LARGE = 0.015  # metres: steps of this size leave any slack at once
_TOO_MUCH = 3.0  # times the slack that would last: points are gathered again


class Stride(NamedTuple):
    """The motions of a walk."""

    planar: bool  # turns are about the axis alone, and shifts across it
    axis: tuple[float, float, float]  # of the plane, unit length
    pivot: tuple[float, float, float]  # of the object, where it does not turn about a contact
    lower: tuple[float, float, float]  # where the object's origin may be in the world
    upper: tuple[float, float, float]  # the other corner


def stride_of(
    space: SearchSpace, pivot: FloatArray, *, bounds: tuple[FloatArray, FloatArray]
) -> Stride:
    """Return moves in a space, about a point (3,) of the object or a contact."""
    planar = isinstance(space, SE2Space)
    axis = triple(space.axis) if isinstance(space, SE2Space) else (0.0, 0.0, 0.0)
    return Stride(
        planar, axis, pivot=triple(pivot), lower=triple(bounds[0]), upper=triple(bounds[1])
    )


class Chains(NamedTuple):
    """Walks of C poses."""

    poses: FloatArray  # (C, 12), at the start, then at the end
    energies: FloatArray  # (C,), of these
    kept: FloatArray  # (C, K, 12), poses at even spaces
    kept_energies: FloatArray  # (C, K), infinite for one above the floor


def walked(
    energy: Energy,
    stride: Stride,
    *,
    poses: Poses,
    energies: FloatArray,
    floor: float,
    moves: int,
    stream: Stream,
    kept: int = 0,
) -> Chains:
    """Return chains from C poses with energies (C,), after so many moves.

    floor: the energy that they come down to, or stay below, see walk_below. kept: states of each.
    """
    count = len(poses)
    model = energy.model
    likelihood = energy.likelihood
    chains = Chains(
        np.array(poses.numbers),
        np.array(energies),
        kept=np.zeros((count, kept, 12)),
        kept_energies=np.full((count, kept), np.inf),
    )

    def new_scratch() -> tuple[Scratch, Any]:
        return energy.scratch(), scratch(_MOVES * _DRAWS + 16, dtype=np.float32)

    def run(first: int, last: int, work: Any) -> None:
        walk_below(model, likelihood, stride, floor, chains, stream, moves, first, last, *work)

    parallel_for(run, count, scratch=new_scratch, least=2)
    return chains


@compiled
def walk_below(model, likelihood, stride, floor, chains, stream, moves, first, last, work, drawn):
    """Move the chains from `first` to before `last` so many times.

    Chains of which states are kept draw from the likelihood (Metropolis et al., 1953), and never
    step above the floor. Others accept what is not above their own energy, and stop at the floor.
    """
    keep = chains.kept.shape[1]
    for n in range(first, last):
        pose = pose_at(chains.poses, n)
        energy = chains.energies[n]
        size = _FIRST
        slack, done = -1.0, 0
        for m in range(moves):
            if keep == 0 and energy <= floor:
                break
            if m % _MOVES == 0:
                fill_uniforms(stream, (n * moves + m) * _DRAWS, drawn, 0, _MOVES * _DRAWS)
            at, limit = m % _MOVES * _DRAWS, energy
            if keep > 0:
                limit = min(floor, energy - log(1.0 - drawn[at + 9]))
            trial = _proposed(model, stride, pose, size, drawn[at : at + _DRAWS])
            accepted = False
            if origin_within(trial, stride.lower, stride.upper):
                total = known_energy(model, likelihood, trial, limit, work)
                if total <= limit:
                    wanted = _slack_for(size)
                    far = slack < 0.0 or travel(model.free, trial, work.memory) > slack
                    if far or slack > _TOO_MUCH * wanted:
                        slack = wanted
                        gather_free(model, trial, slack, work)
                    total = energy_below(model, likelihood, trial, total, limit, work)[0]
                    accepted = total <= limit
            if accepted:
                pose, energy = trial, total
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
    """Return the distance that gathered points should last for, at steps of a size, metres."""
    return min(max(_SLACKS * size, _LEAST_SLACK), _MOST_SLACK) if size < _LARGE else 0.0


@inner
def _proposed(model, stride, pose, size, draw):
    """Return a pose near by. draw (9,): factor of the size, two choices, a turn, and a shift."""
    size *= _SMALLEST * exp(_RANGE * draw[0])
    shift = size * _DEVIATION
    turn = size * _DEVIATION * _PER_METRE
    known = model.known
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
