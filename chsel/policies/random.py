"""Any action that can be taken, each as likely."""

from __future__ import annotations

from dataclasses import dataclass

from chsel.next_probe.decision_problem import DecisionProblem
from chsel.next_probe.forecast import Forecast
from chsel.numerics.arrays import FloatArray
from chsel.policies.policy import ConfiguredPolicy, PolicySettings
from chsel.problem.streams import Purpose, uniforms


@dataclass(frozen=True)
class RandomSettings(PolicySettings):
    """All settings of the policy."""


class RandomAction(ConfiguredPolicy[RandomSettings]):
    """Draws an action from the problem's own stream of random numbers."""

    settings_class = RandomSettings
    is_gain = False

    def rate(self, problem: DecisionProblem, forecast: Forecast) -> FloatArray:
        """Numbers (A,), uniform in [0, 1)."""
        return uniforms(problem.key.stream(Purpose.POLICY), 0.0, 1.0, len(problem.actions))
