"""Gradient descent alone: stage 1 of CHSEL as a method of its own (ablation of the paper)."""

from __future__ import annotations

from dataclasses import dataclass, field

from chsel.cost_settings import CostSettings
from chsel.descent import DescentSettings, descend
from chsel.engine import CompiledCost
from chsel.objective import Objective
from chsel.observer import NullObserver, Observer
from chsel.online import OnlineSettings
from chsel.problem import Hypotheses, RegistrationProblem
from chsel.selection import ranked_hypotheses
from chsel.space import PlaneSettings, search_space


@dataclass(frozen=True)
class GradientDescentSettings:
    """All settings of gradient descent; plane restricts the poses to SE(2)."""

    cost: CostSettings = field(default_factory=CostSettings)
    descent: DescentSettings = field(default_factory=DescentSettings)
    online: OnlineSettings = field(default_factory=OnlineSettings)
    plane: PlaneSettings | None = None


class GradientDescent:
    """Descends from every pose of E_0 and returns where each arrives; E_l is not used."""

    def __init__(self, settings: GradientDescentSettings | None = None) -> None:
        self.settings = settings or GradientDescentSettings()

    @property
    def online(self) -> OnlineSettings:
        """How a session makes the next problem."""
        return self.settings.online

    def register(
        self, problem: RegistrationProblem, observer: Observer | None = None
    ) -> Hypotheses:
        """Hypotheses for the known points of a problem, best first."""
        observer = observer or NullObserver()
        space = search_space(self.settings.plane, problem.sdf)
        objective = Objective(CompiledCost.of(problem, self.settings.cost), space)
        estimates, _ = descend(objective, problem.initial_set, self.settings.descent, observer)
        return ranked_hypotheses(objective, estimates, elites=estimates)
