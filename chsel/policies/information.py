"""The action whose outcome says most about the pose."""

from __future__ import annotations

from dataclasses import dataclass

from chsel.next_probe.decision_problem import DecisionProblem
from chsel.next_probe.forecast import Forecast
from chsel.numerics.arrays import FloatArray
from chsel.policies.policy import ConfiguredPolicy, PolicySettings


@dataclass(frozen=True)
class InformationSettings(PolicySettings):
    """All settings of the policy."""


class Information(ConfiguredPolicy[InformationSettings]):
    """Rates actions by the information between pose and outcome, nats."""

    settings_class = InformationSettings

    def rate(self, problem: DecisionProblem, forecast: Forecast) -> FloatArray:
        """Information (A,), from 0 if all poses agree to the entropy of the belief."""
        return forecast.gains.information
