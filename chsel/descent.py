"""Stage 1: gradient descent on the relaxed cost from many starts (CHSEL, Alg. 1, line 1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chsel.arrays import FloatArray
from chsel.errors import SettingError, require_at_most, require_positive
from chsel.objective import Objective
from chsel.observer import Observer
from chsel.space import transforms_of

MOST_ITERATIONS = 1_000_000


@dataclass(frozen=True)
class DescentSettings:
    """Adam on all starts at once.

    restarts x iterations: after each block of iterations Adam starts afresh and the rotations are
    made orthonormal again. rate: Adam's step size. stop_below: end when a block lowers the costs
    by no more than this fraction in the mean over the starts; None: never end early.
    """

    restarts: int = 10
    iterations: int = 50
    rate: float = 0.01
    stop_below: float | None = 1e-6

    def __post_init__(self) -> None:
        require_positive("restarts", self.restarts, zero=True)
        require_positive("iterations", self.iterations)
        for name in ("restarts", "iterations"):
            require_at_most(name, getattr(self, name), MOST_ITERATIONS)
        require_at_most("restarts x iterations", self.restarts * self.iterations, MOST_ITERATIONS)
        require_positive("rate", self.rate)
        if self.stop_below is not None and not np.isfinite(self.stop_below):
            raise SettingError(f"stop_below is {self.stop_below}; accepted: a number, or null")


def descend(
    objective: Objective,
    initial_set: FloatArray,
    settings: DescentSettings,
    observer: Observer,
) -> tuple[FloatArray, FloatArray]:
    """Estimates E' as transforms (B, 4, 4), with their costs (B,), from E_0 (B, 4, 4).

    Each start runs on its own; the costs are those of the returned transforms.
    """
    estimates = initial_set
    vectors = objective.space.encode(estimates)
    costs = previous = objective.costs(vectors)
    observer.trace("descent", 0, vectors.copy(), costs.copy())
    count = len(estimates)
    for restart in range(settings.restarts):
        vectors = objective.space.encode(estimates)
        vectors = objective.descended(vectors, count, settings.rate, settings.iterations)
        estimates = transforms_of(objective.space, vectors)
        vectors = objective.space.encode(estimates)
        costs = objective.costs(vectors)
        done = (restart + 1) * settings.iterations
        observer.trace("descent", done, vectors.copy(), costs.copy())
        observer.progress("descent", done, settings.restarts * settings.iterations)
        stop_below = settings.stop_below
        if stop_below is not None and _mean_gain(previous, costs) <= stop_below:
            break
        previous = costs
    return transforms_of(objective.space, objective.space.encode(estimates)), costs


def _mean_gain(before: FloatArray, after: FloatArray) -> float:
    """Mean over the starts of the fraction by which the cost fell; a cost of 0 gains nothing."""
    gain = np.where(before > 0.0, (before - after) / np.where(before > 0.0, before, 1.0), 0.0)
    return float(gain.mean())
