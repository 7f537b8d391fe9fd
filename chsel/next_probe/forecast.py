"""What each action would show if the belief is right, and how much would be known after it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import inf
from typing import Any, NamedTuple

import numpy as np

from chsel.next_probe.decision_problem import DecisionProblem
from chsel.next_probe.first_contact import FirstContacts, first_contacts
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.numerics.compiler import compiled
from chsel.numerics.elementary import exp, log
from chsel.numerics.threads import spread
from chsel.problem.outline import in_order, outline_distances, surface_spread
from chsel.problem.poses import Poses

_FARTHEST = 60.0  # exponents beyond count as zero
_UNLIKE = 0.01  # overlap of a hit with a miss: a sensor may err


class _Gains(NamedTuple):
    """What the kernel fills, for A actions."""

    information: FloatArray  # (A,), nats
    # (A,), metres: root mean square distance of the surface in the pose that shows the outcome
    # from that in a pose drawn from what is left of the belief after it
    expected_spread: FloatArray
    loss: FloatArray  # (A,), metres: the mean of the same distance, for its root mean square
    surviving: FloatArray  # (A,): expected weight of the poses that the outcome does not rule out


@dataclass(frozen=True, eq=False)
class Forecast:
    """Forecasts of all A actions of a decision, by its belief of K poses.

    noise: standard deviation of a contact's place from where it is forecast, metres.
    """

    problem: DecisionProblem
    noise: float

    @cached_property
    def first(self) -> FirstContacts:
        """Where each action meets the object, by pose."""
        of = self.problem
        return first_contacts(of.sdf, of.belief, of.actions, of.hand)

    @property
    def hit(self) -> BoolArray:
        """Whether an action meets the object (K, A), by pose."""
        return self.first.travel < inf

    @cached_property
    def hit_chance(self) -> FloatArray:
        """That the hand meets the object (A,)."""
        return self._chance(self.hit)

    @cached_property
    def blocked_chance(self) -> FloatArray:
        """That the object is in the way to the start (A,)."""
        return self._chance(self.first.travel < 0.0)

    @cached_property
    def distances(self) -> FloatArray:
        """How far the surface in one pose is from that in another (K, K), metres.

        See `outline_distances`.
        """
        poses = Poses.of(self.problem.belief.object_from_world)
        return outline_distances(self.problem.sdf, poses)

    @cached_property
    def spread(self) -> float:
        """Root mean square distance of two surfaces drawn from the belief, metres."""
        return surface_spread(self.distances, self.problem.belief.weights)

    @cached_property
    def gains(self) -> _Gains:
        """What is gained by each action."""
        count = len(self.problem.actions)
        gains = _Gains(np.zeros(count), np.empty(count), np.empty(count), np.ones(count))
        weights, distances = np.array(self.problem.belief.weights), self.distances
        contacts = self.first  # before threads begin, which must not wait for each other
        size = len(weights)

        def run(first: int, last: int, scratch: Any) -> None:
            overlap(contacts, weights, distances, self.noise, gains, scratch, (first, last))

        spread(run, count, lambda: np.empty((4, size)), least=20)
        return gains

    def _chance(self, flags: BoolArray) -> FloatArray:
        """Weight (A,) of the poses with a flag, of flags (K, A)."""
        return in_order(np.where(flags, self.problem.belief.weights[:, None], 0.0).T)


@compiled
def overlap(
    first: Any, weights: Any, distances: Any, noise: Any, gains: Any, scratch: Any, some: Any
) -> None:
    """Fill `gains` of some actions (first, last) from how alike their outcomes are.

    Outcomes of two poses overlap by the Bhattacharyya coefficient of Gaussians around their
    contacts, B = exp(-d^2 / 8 noise^2); by 1 if both miss, and hardly if one does. A pose survives
    another's outcome with likelihood B^2. Information is the pairwise bound of Kolchinsky and
    Tracey (Entropy, 2017), - sum_i w_i ln sum_j w_j B_ij.
    """
    count = len(weights)
    scale = 1.0 / (8.0 * noise * noise)
    alike, alive, far, farther = scratch[0], scratch[1], scratch[2], scratch[3]
    for a in range(some[0], some[1]):
        for i in range(count):
            alike[i], alive[i], far[i], farther[i] = weights[i], weights[i], 0.0, 0.0
        for i in range(count):
            hit = first.travel[i, a] < np.inf
            for j in range(i + 1, count):
                b = 1.0
                if hit != (first.travel[j, a] < np.inf):
                    b = _UNLIKE
                elif hit:
                    x = first.contact[i, a, 0] - first.contact[j, a, 0]
                    y = first.contact[i, a, 1] - first.contact[j, a, 1]
                    z = first.contact[i, a, 2] - first.contact[j, a, 2]
                    exponent = scale * (x * x + y * y + z * z)
                    if exponent > _FARTHEST:
                        continue
                    b = exp(-exponent)
                g = b * b
                alike[i] += weights[j] * b
                alike[j] += weights[i] * b
                alive[i] += weights[j] * g
                alive[j] += weights[i] * g
                d = distances[i, j]
                far[i] += weights[j] * g * d
                far[j] += weights[i] * g * d
                farther[i] += weights[j] * g * d * d
                farther[j] += weights[i] * g * d * d
        information, left, loss, surviving = 0.0, 0.0, 0.0, 0.0
        for i in range(count):
            if weights[i] > 0.0:
                information -= weights[i] * log(alike[i])
                left += weights[i] * farther[i] / alive[i]
                loss += weights[i] * far[i] / alive[i]
                surviving += weights[i] * alive[i]
        gains.information[a] = max(information, 0.0)
        gains.expected_spread[a] = np.sqrt(left)
        gains.loss[a] = loss
        gains.surviving[a] = surviving
