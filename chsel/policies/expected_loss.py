"""The action after which the poses that are left are expected to be nearest to each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chsel.next_probe.decision_problem import DecisionProblem
from chsel.next_probe.forecast import Forecast
from chsel.numerics.arrays import FloatArray
from chsel.policies.policy import ConfiguredPolicy, PolicySettings
from chsel.problem.outline import in_order


@dataclass(frozen=True)
class ExpectedLossSettings(PolicySettings):
    """All settings of the policy."""


class ExpectedLoss(ConfiguredPolicy[ExpectedLossSettings]):
    """Rates actions by how much smaller they make the mean distance of two surfaces, metres."""

    settings_class = ExpectedLossSettings

    def rate(self, problem: DecisionProblem, forecast: Forecast) -> FloatArray:
        """Expected decrease (A,) of the mean distance of two surfaces; 0 where it would grow."""
        weights = problem.belief.weights
        loss = float(in_order(weights * in_order(weights * forecast.distances)))
        return np.maximum(loss - forecast.gains.loss, 0.0)
