"""The actions in the order in which they are offered, as the paper probes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chsel.next_probe.decision_problem import DecisionProblem
from chsel.next_probe.forecast import Forecast
from chsel.numerics.arrays import FloatArray
from chsel.policies.policy import ConfiguredPolicy, PolicySettings


@dataclass(frozen=True)
class GridSettings(PolicySettings):
    """All settings of the policy."""


class Grid(ConfiguredPolicy[GridSettings]):
    """Takes the first action that is left."""

    settings_class = GridSettings
    is_gain = False

    def rate(self, problem: DecisionProblem, forecast: Forecast) -> FloatArray:
        """Minus the place (A,) of each action among those offered."""
        return -np.arange(len(problem.actions), dtype=np.float64)
