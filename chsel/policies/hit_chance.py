"""The action that most probably meets the object."""

from __future__ import annotations

from dataclasses import dataclass

from chsel.next_probe.decision_problem import DecisionProblem
from chsel.next_probe.forecast import Forecast
from chsel.numerics.arrays import FloatArray
from chsel.policies.policy import ConfiguredPolicy, PolicySettings


@dataclass(frozen=True)
class HitChanceSettings(PolicySettings):
    """All settings of the policy."""


class HitChance(ConfiguredPolicy[HitChanceSettings]):
    """Rates actions by the weight of the poses in which the hand meets the object."""

    settings_class = HitChanceSettings

    def rate(self, problem: DecisionProblem, forecast: Forecast) -> FloatArray:
        """Chance (A,) of a hit."""
        return forecast.hit_chance
