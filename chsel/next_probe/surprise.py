"""How surprising the outcome of a probe is, by what was forecast of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from chsel.next_probe.decision_problem import Decision, DecisionProblem
from chsel.numerics.arrays import FloatArray
from chsel.numerics.compiler import compiled
from chsel.numerics.elementary import exp, log
from chsel.problem.settings import CheckedSettings, at_most, not_negative, positive

_NONE_OF_THESE = 0.05  # weight of all that the belief leaves out
_ANY_OUTCOME = 0.01  # chance of what happened if none of the poses is right
_UNLIKE = 0.001  # likelihood of a hit where a pose forecasts a miss, and the other way round


@dataclass(frozen=True)
class SurpriseSettings(CheckedSettings):
    """What follows from an outcome that no pose of the belief has forecast."""

    # Above so many nats the next registration starts afresh, with so many times the hypotheses.
    limit: Annotated[float, not_negative] = 6.0
    larger: Annotated[int, positive, at_most(100)] = 3


def surprise(
    problem: DecisionProblem, decision: Decision, noise: float, contact: FloatArray | None
) -> float:
    """-ln of the chance that was forecast for the outcome of the chosen action, nats.

    contact (3,): where the hand has met the object, world frame, metres; None if it has not.
    noise: of contacts, metres. Places within the scatter of the forecast contacts, and within the
    noise, are as likely as each other; the chance of a place farther off falls like a Gaussian. 6.5
    is the most: no pose had forecast anything like it.
    """
    met = contact is not None
    place = np.zeros(3) if contact is None else np.array(contact, dtype=np.float64)
    weights, contacts = np.array(problem.belief.weights), np.array(decision.contacts)
    return float(_nats(weights, contacts, met, place, float(noise)))


@compiled
def _nats(weights: Any, contacts: Any, met: Any, place: Any, noise: Any) -> Any:
    """`surprise` of forecast contacts (K, 3), NaN for a miss, and a place (3,)."""
    hit, mean_x, mean_y, mean_z = 0.0, 0.0, 0.0, 0.0
    for k in range(len(weights)):
        if contacts[k, 0] == contacts[k, 0]:
            hit += weights[k]
            mean_x += weights[k] * contacts[k, 0]
            mean_y += weights[k] * contacts[k, 1]
            mean_z += weights[k] * contacts[k, 2]
    scatter = 0.0
    if hit > 0.0:
        for k in range(len(weights)):
            if contacts[k, 0] == contacts[k, 0]:
                x = contacts[k, 0] - mean_x / hit
                y = contacts[k, 1] - mean_y / hit
                z = contacts[k, 2] - mean_z / hit
                scatter += weights[k] / hit * (x * x + y * y + z * z)
    scale = 1.0 / (4.0 * noise * noise + scatter)
    chance = 0.0
    for k in range(len(weights)):
        likely = _UNLIKE
        if met == (contacts[k, 0] == contacts[k, 0]):
            likely = 1.0
            if met:
                x = contacts[k, 0] - place[0]
                y = contacts[k, 1] - place[1]
                z = contacts[k, 2] - place[2]
                likely = max(_UNLIKE, exp(-scale * (x * x + y * y + z * z)))
        chance += weights[k] * likely
    return -log((1.0 - _NONE_OF_THESE) * chance + _NONE_OF_THESE * _ANY_OUTCOME)
