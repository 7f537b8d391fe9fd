"""The action whose outcome rules out most (Javdani et al., ICRA 2013)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chsel.next_probe.decision_problem import DecisionProblem
from chsel.next_probe.forecast import Forecast
from chsel.numerics.arrays import FloatArray
from chsel.policies.policy import ConfiguredPolicy, PolicySettings


@dataclass(frozen=True)
class HypothesisPruningSettings(PolicySettings):
    """All settings of the policy."""


class HypothesisPruning(ConfiguredPolicy[HypothesisPruningSettings]):
    """Rates actions by the weight that their outcome is expected to take from other poses.

    Poses survive by how likely the outcome is under them, noisily ("weighted hypothesis pruning").
    The gain is adaptive submodular, so greedy choice is near to the best sequence of actions.
    """

    settings_class = HypothesisPruningSettings

    def rate(self, problem: DecisionProblem, forecast: Forecast) -> FloatArray:
        """Expected weight (A,) that is ruled out, from 0 to 1."""
        return np.maximum(1.0 - forecast.gains.surviving, 0.0)
