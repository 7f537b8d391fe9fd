"""SVGD on the relaxed cost: particles that descend and push each other apart (CHSEL, Sec. V)."""

from __future__ import annotations

from dataclasses import dataclass, field

from chsel import presets
from chsel.arrays import FloatArray
from chsel.cost_settings import CostSettings
from chsel.engine import CompiledCost
from chsel.errors import require_at_most, require_choice, require_positive
from chsel.kernels.svgd import particles_at, surroundings_of, svgd
from chsel.objective import Objective
from chsel.observer import NullObserver, Observer
from chsel.online import OnlineSettings
from chsel.problem import Hypotheses, RegistrationProblem
from chsel.selection import ranked_hypotheses
from chsel.space import PlaneSettings, search_space, transforms_of

MOST_ITERATIONS = 1_000_000
MOST_PARTICLES = 10_000  # every pair of them is held
_BLOCK = 50  # iterations between words to the observer


@dataclass(frozen=True)
class SvgdSettings:
    """All settings of Stein variational gradient descent (Liu and Wang, 2016).

    sharpness: beta of p = exp(-beta C). kernel: "reference" of fixed scale, "median" with that of
    the median heuristic at every iteration. scale: h of k(a, b) = exp(-|a - b|^2 / (2 h^2)) of
    search vectors, and of the median heuristic where there is no pair. iterations, rate: of Adam.
    plane: restricts the poses to SE(2).
    """

    sharpness: float = 5.0
    kernel: str = "reference"
    scale: float = 0.01
    iterations: int = 300
    rate: float = 0.005
    cost: CostSettings = field(default_factory=CostSettings)
    online: OnlineSettings = field(default_factory=OnlineSettings)
    plane: PlaneSettings | None = None

    def __post_init__(self) -> None:
        require_choice("kernel", self.kernel, ("reference", "median"))
        for name in ("sharpness", "scale", "rate"):
            require_positive(name, getattr(self, name))
        require_positive("iterations", self.iterations, zero=True)
        require_at_most("iterations", self.iterations, MOST_ITERATIONS)


def preset_svgd(preset: str) -> SvgdSettings:
    """The settings of SVGD in a preset.

    Ours keep the fixed kernel: by the median heuristic, whose reach is that of the whole set,
    particles push each other off the object (farther from the true surface on 16 of 17
    simulated configurations).
    """
    return SvgdSettings(cost=presets.COST[preset], online=presets.ONLINE[preset])


class Svgd:
    """Moves a particle from every pose of E_0 and returns where they arrive; E_l is not used."""

    def __init__(self, settings: SvgdSettings | None = None) -> None:
        self.settings = settings or SvgdSettings()

    @property
    def online(self) -> OnlineSettings:
        """How a session makes the next problem."""
        return self.settings.online

    def register(
        self, problem: RegistrationProblem, observer: Observer | None = None
    ) -> Hypotheses:
        """Hypotheses for the known points of a problem, best first.

        Raises SettingError for so many poses in E_0 that their pairs are too many.
        """
        require_at_most("number of poses in E_0", len(problem.initial_set), MOST_PARTICLES)
        space = search_space(self.settings.plane, problem.sdf)
        objective = Objective(CompiledCost.of(problem, self.settings.cost), space)
        vectors = self._moved(
            objective, space.encode(problem.initial_set), observer or NullObserver()
        )
        estimates = transforms_of(space, vectors)
        return ranked_hypotheses(objective, estimates, elites=estimates)

    def _moved(self, objective: Objective, vectors: FloatArray, observer: Observer) -> FloatArray:
        """Search vectors (B, d) after all iterations."""
        settings, total = self.settings, self.settings.iterations
        particles = particles_at(vectors)
        around = surroundings_of(objective.model, len(vectors))
        observer.trace("svgd", 0, vectors.copy(), objective.costs(vectors))
        for first in range(0, total, _BLOCK):
            last = min(first + _BLOCK, total)
            svgd(
                objective.model,
                objective.space_arrays,
                particles,
                settings.sharpness,
                settings.scale,
                settings.kernel == "median",
                settings.rate,
                last - first,
                around,
            )
            moved = particles.vectors
            observer.trace("svgd", last, moved.copy(), objective.costs(moved))
            observer.progress("svgd", last, total)
        return particles.vectors
