"""Contact-anchored search, described in docs/anchored.md: a method of our own."""

from __future__ import annotations

from dataclasses import replace

from chsel.methods.anchored.anchored_settings import AnchoredSettings
from chsel.methods.anchored.pushed import likeliest_push
from chsel.methods.anchored.search import Search
from chsel.methods.method import ConfiguredMethod
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.problem.basins import basin_bests
from chsel.problem.noise import noise_model
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import (
    Hypotheses,
    NullObserver,
    Observer,
    RegistrationProblem,
)

# Basins whose best pose is a rival of a result, where more than eight modes make a verdict wide:
# docs/anchored.md, "Numbers that are no settings".
_MOST_RIVALS = 60


class Anchored(ConfiguredMethod[AnchoredSettings]):
    """Poses sampled on contacts, fitted, walked down, spread below a limit, and a choice of them.

    Costs are energies, nats.
    """

    settings_class = AnchoredSettings

    def _hypotheses(self, problem: RegistrationProblem, observer: Observer) -> Hypotheses:
        found = likeliest_push(problem, self.settings, observer=observer)  # stages 1 to 4
        candidates = found.search.spread(found.minima)  # 5
        hypotheses = found.search.choose(candidates)  # 6
        return replace(hypotheses, push_distance=found.distance)

    def minima(self, problem: RegistrationProblem) -> Poses:
        """Return the best pose of every basin that a search finds, the likeliest first."""
        found = Search(problem, self.settings, observer=NullObserver()).minima()
        return found.poses[basin_bests(problem.sdf, found.poses, most=_MOST_RIVALS)]

    def fitted(self, problem: RegistrationProblem, poses: Poses) -> Poses:
        """Return poses fitted to the points where that lowers their energy, the likeliest first."""
        search = Search(problem, self.settings, observer=NullObserver())
        return search.refined(search.rated(poses)).poses

    def holds(  # noqa: PLR0917
        self, problem: RegistrationProblem, hypotheses: Hypotheses, object_from_world: FloatArray
    ) -> BoolArray:
        """Return whether the points allow each of poses (N, 4, 4) beside hypotheses: flags (N,).

        They do if its energy is below the limit above the best hypothesis, where errors that
        points may share cost nothing.
        """
        settings = self.settings
        search = Search(
            problem.carried(hypotheses.push_distance), settings, observer=NullObserver()
        )
        energy = search.energy.by(noise_model(settings.noise, settings.shared_error))
        best = energy.of(Poses.of(hypotheses.object_from_world[:1]))
        return energy.of(Poses.of(object_from_world)) <= best[0] + settings.limit
