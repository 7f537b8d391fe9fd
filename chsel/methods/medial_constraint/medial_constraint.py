"""Quality-diversity search on the Medial Constraint cost (CHSEL, Sec. V-H)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from chsel.methods.medial_constraint.cma_es import CmaEsSettings, evolved
from chsel.methods.medial_constraint.medial_cost import MedialCost, MedialCostSettings
from chsel.methods.method import ConfiguredMethod
from chsel.numerics.arrays import FloatArray
from chsel.problem.online_registration import OnlineSettings
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import (
    Hypotheses,
    NullObserver,
    Observer,
    RegistrationProblem,
)
from chsel.problem.search_space import PlaneSettings, search_space
from chsel.problem.settings import Presets
from chsel.problem.streams import Purpose
from chsel.qd.archive import GridArchive, evaluated
from chsel.qd.emitters import ArchiveWatch, Draws, EmitterSettings, cma_me
from chsel.qd.measures import measure_named
from chsel.qd.selection import (
    ArchiveSettings,
    OutputSettings,
    measure_range,
    ranked_hypotheses,
    select_elites,
    sized_archive,
)


@dataclass(frozen=True)
class MedialConstraintSettings:
    """All settings of Medial Constraint."""

    cost: MedialCostSettings = field(default_factory=MedialCostSettings)
    cma_es: CmaEsSettings = field(default_factory=CmaEsSettings)
    online: OnlineSettings = field(default_factory=OnlineSettings)
    plane: PlaneSettings | None = None  # restricts the poses to SE(2)

    presets: ClassVar[Presets] = {}  # those of its groups


class MedialConstraint(ConfiguredMethod[MedialConstraintSettings]):
    """Evolves poses from E_0; costs are in m^2; E_l is not used."""

    settings_class = MedialConstraintSettings

    def register(
        self, problem: RegistrationProblem, observer: Observer | None = None
    ) -> Hypotheses:
        """Hypotheses for the known points of a problem, best first."""
        observer = observer or NullObserver()
        space = search_space(self.settings.plane, problem.sdf)
        objective = MedialCost(problem, self.settings.cost, space=space)
        initial_set, settings = Poses.of(problem.initial_set), self.settings.cma_es
        vectors = evolved(objective, initial_set, settings, problem.key, observer)
        estimates = space.poses(vectors)
        return ranked_hypotheses(objective, estimates, elites=estimates)


TOLERANCE = 1e-5  # m^2, of a mean square: that of 3 mm

_ARCHIVE = ArchiveSettings(
    measure="position_2", bins=40, tolerance_per_point=0.0, tolerance=TOLERANCE
)
_EMITTER = EmitterSettings(iterations=500, sigma0=1.0, rate=0.05)
_OUTPUT = OutputSettings(
    choice="lowest", ratio=5.0, tolerance_per_point=0.0, free_tolerance=TOLERANCE, margin=None
)


@dataclass(frozen=True)
class MedialConstraintCmaMeSettings:
    """All settings of Medial Constraint with CMA-ME."""

    cost: MedialCostSettings = field(default_factory=MedialCostSettings)
    cma_es: CmaEsSettings = field(default_factory=CmaEsSettings)
    archive: ArchiveSettings = _ARCHIVE  # tolerances in m^2, as the cost is
    emitter: EmitterSettings = _EMITTER
    output: OutputSettings = _OUTPUT  # tolerances in m^2
    online: OnlineSettings = field(default_factory=OnlineSettings)
    plane: PlaneSettings | None = None  # restricts the poses to SE(2)

    presets: ClassVar[Presets] = {
        "paper": {  # without effect, as no estimate is left out
            "archive": {"tolerance_per_point": 1e-3, "tolerance": 1e-6}
        },
        "reference": {},
    }

    def __post_init__(self) -> None:
        measure_named(self.archive.measure, planar=self.plane is not None)


class MedialConstraintCmaMe(ConfiguredMethod[MedialConstraintCmaMeSettings]):
    """CMA-ES from E_0, then CMA-ME over an archive around what it finds; costs are in m^2."""

    settings_class = MedialConstraintCmaMeSettings

    def register(
        self, problem: RegistrationProblem, observer: Observer | None = None
    ) -> Hypotheses:
        """Hypotheses for the known points of a problem, best first."""
        observer, settings = observer or NullObserver(), self.settings
        space = search_space(settings.plane, problem.sdf)
        objective = MedialCost(problem, settings.cost, space=space)
        key, count = problem.key, len(problem.initial_set)
        # E' <- CMA-ES on E_0; as poses, so that it holds what hypotheses can be
        initial_set = Poses.of(problem.initial_set)
        vectors = evolved(objective, initial_set, settings.cma_es, key, observer)
        vectors = space.encode(space.poses(vectors))
        archive = self._seeded_archive(problem, objective, vectors)
        # M <- CMA-ME(M, C_M, n_o)
        first, best = space.encode(initial_set[:1])[0], archive.best_solution
        start = first if settings.emitter.start == "initial" else best
        draws, watch = Draws(key), ArchiveWatch(observer, 0, "cma_me")
        cma_me(objective, archive, start, count, settings.emitter, draws, watch)
        # E <- cells of M with the |E_0| lowest costs
        stream, elites = key.stream(Purpose.RESAMPLE), space.poses(archive.solutions)
        chosen = select_elites(archive.costs, elites, problem, space, settings.output, stream)
        snapshot = archive.snapshot(settings.emitter.iterations, 0)
        cells = archive.occupied[chosen]
        return ranked_hypotheses(objective, elites[chosen], cells, elites, snapshot)

    def _seeded_archive(
        self, problem: RegistrationProblem, objective: MedialCost, vectors: FloatArray
    ) -> GridArchive:
        """The archive that measures of E', vectors (B, d), size, holding E' and E_l."""
        settings, space = self.settings.archive, objective.space
        measure = measure_named(settings.measure, planar=self.settings.plane is not None)
        estimates = evaluated(objective, measure, vectors)
        mean, deviation = measure_range(estimates, measure, settings, len(problem.points.known))
        archive = sized_archive(measure, mean, deviation, settings, space.dimension)
        low_cost_set = space.encode(Poses.of(problem.low_cost_set))
        archive.update_cells(estimates, evaluated(objective, measure, low_cost_set))
        return archive
