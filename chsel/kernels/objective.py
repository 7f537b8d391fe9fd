"""Cost and gradient as functions of a search vector."""

from __future__ import annotations

from typing import NamedTuple

from chsel.kernels.compiler import compiled, spliced
from chsel.kernels.cost import Model, Neighbours, evaluate, neighbours_of
from chsel.kernels.measures import measure_gradients_of, measures_of
from chsel.kernels.pose import decode, pose_at, pull_back

__all__ = ["cost_and_gradient_of", "cost_of", "measure_gradients_of", "measures_of"]


class Work(NamedTuple):
    """Scratch of one thread."""

    near: Neighbours


def work_for(model: Model) -> Work:
    """Scratch for one thread."""
    return Work(neighbours_of(model))


@spliced
def cost_of(model, space, vector, work):  # type: ignore[no-untyped-def]
    """The cost of a search vector (d,)."""
    return evaluate(model, decode(space, vector), work.near, 0.0)[0]


@spliced
def cost_and_gradient_of(model, space, vector, gradient, work):  # type: ignore[no-untyped-def]
    """The cost of a search vector (d,); fills its gradient (d,)."""
    sums = evaluate(model, decode(space, vector), work.near, 0.0)
    pull_back(space, vector, sums[4:13] + sums[1:4], gradient)
    return sums[0]


@compiled
def costs_of_poses(model, poses, out, first, last, work):  # type: ignore[no-untyped-def]
    """Fill out (B,) with the costs of poses (B, 12), from `first` to before `last`."""
    for n in range(first, last):
        out[n] = evaluate(model, pose_at(poses, n), work.near, 0.0)[0]


@compiled
def costs_and_gradients(model, space, vectors, out, gradients, first, last, work):  # type: ignore[no-untyped-def]
    """Fill out (B,) and gradients (B, d) at search vectors (B, d), from `first` to `last`."""
    for n in range(first, last):
        out[n] = cost_and_gradient_of(model, space, vectors[n], gradients[n], work)
