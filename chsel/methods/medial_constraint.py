"""Medial Constraint: CMA-ES on balls of free space and contacts (baseline of CHSEL, Sec. V-D)."""

from __future__ import annotations

from dataclasses import dataclass, field

from chsel import presets
from chsel.cma_es import CmaEsSettings, evolved
from chsel.medial_cost import MedialCost, MedialCostSettings, MedialObjective
from chsel.observer import NullObserver, Observer
from chsel.online import OnlineSettings
from chsel.problem import Hypotheses, RegistrationProblem
from chsel.selection import ranked_hypotheses
from chsel.space import PlaneSettings, search_space, transforms_of

MEDIAL_COST = {
    "default": MedialCostSettings(),
    "paper": MedialCostSettings(lookup="nearest"),
    "reference": MedialCostSettings(ball_scale=0.0, lookup="nearest", outside="bounding_box"),
}
CMA_ES = {
    "default": CmaEsSettings(),
    "paper": CmaEsSettings(tolfun=1e-5, tolfunhist=1e-6),
    "reference": CmaEsSettings(starts="single", tolfun=1e-5, tolfunhist=1e-6),
}


@dataclass(frozen=True)
class MedialConstraintSettings:
    """All settings of Medial Constraint; plane restricts the poses to SE(2)."""

    cost: MedialCostSettings = field(default_factory=MedialCostSettings)
    cma_es: CmaEsSettings = field(default_factory=CmaEsSettings)
    online: OnlineSettings = field(default_factory=OnlineSettings)
    plane: PlaneSettings | None = None


def preset_medial_constraint(preset: str) -> MedialConstraintSettings:
    """The settings of a preset, one of chsel.presets.PRESETS."""
    return MedialConstraintSettings(
        MEDIAL_COST[preset], CMA_ES[preset], presets.ONLINE[preset], plane=None
    )


class MedialConstraint:
    """Evolves poses from E_0; costs are in m^2; E_l is not used."""

    def __init__(self, settings: MedialConstraintSettings | None = None) -> None:
        self.settings = settings or MedialConstraintSettings()

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
        objective = MedialObjective(MedialCost(problem, self.settings.cost), space)
        vectors = evolved(
            objective, problem.initial_set, self.settings.cma_es, problem.key, observer
        )
        estimates = transforms_of(space, vectors)
        return ranked_hypotheses(objective, estimates, elites=estimates)
