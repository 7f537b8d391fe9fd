"""Contact-anchored search: our own method, for hypotheses that are close to the plausible set."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from chsel.methods.anchored.anchor_sampling import (
    AnchorSampler,
    most_informative_first,
)
from chsel.methods.anchored.anchored_settings import EFFORTS, AnchoredSettings
from chsel.methods.anchored.energy import Energy, NoiseLevel, tolerances_of
from chsel.methods.anchored.fit_kernels import Loss
from chsel.methods.anchored.modes import has_new_mode
from chsel.methods.anchored.rated_poses import RatedPoses
from chsel.methods.method import ConfiguredMethod
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import (
    Hypotheses,
    NullObserver,
    Observer,
    RegistrationProblem,
)
from chsel.problem.search_space import origin_bounds, search_space
from chsel.problem.subset import (
    evenly_spaced,
    farthest_poses,
)
from chsel.qd.archive import Evaluated
from chsel.qd.measures import measure_named
from chsel.qd.selection import (
    measure_range,
    ranked,
    repeated,
    representatives,
    sized_archive,
)

_MOST_ROUNDS = 12
_REACH = 0.03  # metres beyond which a known point costs no more while minima are sought
_OUTLYING, _ALL_OUTLYING = 0.01, 0.2  # and then, at least: the second by their number, if less
_COARSE, _FINE = Loss(0.01, 0.06, 0.0), Loss(0.002, 0.03, 0.0)  # of fits
_AS_WELL = 1.5  # a tolerance explains points as well if its energy is at most so much higher
_LOWEST = 0.02  # noise levels: an energy that is not worth lowering
_KEPT = 6  # states of a chain
_MOST_GIVEN = 60  # of E_0 and E_l that are fitted


class Anchored(ConfiguredMethod[AnchoredSettings]):
    """Samples anchored on contacts, fitted, spread below a limit, and a diverse choice of them."""

    settings_class = AnchoredSettings

    def register(
        self, problem: RegistrationProblem, observer: Observer | None = None
    ) -> Hypotheses:
        """Hypotheses for the known points of a problem, best first; costs are energies."""
        search = Search(problem, self.settings, observer or NullObserver())
        return search.hypotheses(search.spread(search.minima()))

    def longest_stage(self, problem: RegistrationProblem) -> None:
        """A step of fitting, from the first pose of E_0."""
        energy = Search(problem, self.settings, NullObserver()).energy
        energy.fitted(Poses.of(problem.initial_set[:1]), 1, _COARSE)

    def holds(
        self, problem: RegistrationProblem, hypotheses: Hypotheses, object_from_world: FloatArray
    ) -> BoolArray:
        """Which poses (N, 4, 4) the points allow, beside hypotheses for them: flags (N,).

        Those with an energy below the limit of the best hypothesis plus the errors that points may
        share, with free points as deep as a voxel of free space may be off.
        """
        search = Search(problem, self.settings, NullObserver())
        best = Poses.of(hypotheses.object_from_world[:1])
        return search.holds(best, Poses.of(object_from_world))


class Search:
    """The stages of one registration."""

    def __init__(
        self, problem: RegistrationProblem, settings: AnchoredSettings, observer: Observer
    ) -> None:
        self._problem, self._settings, self._observer = problem, settings, observer
        self._effort = settings.effort or EFFORTS[settings.size]
        self._space = search_space(settings.plane, problem.sdf)
        self._known = most_informative_first(problem.points)
        self._tolerances = tolerances_of(problem, settings.penetration_tolerance)
        bounds = origin_bounds(problem.workspace, self._space, settings.anchors.margin)
        self.energy = Energy(problem, self._known, self._space, bounds, self._wide(0))

    def _wide(self, raised: int) -> NoiseLevel:
        """The noise of the sensor, with known points far off still drawn to the object."""
        return NoiseLevel(self._settings.noise, self._tolerances[raised], _REACH)

    def minima(self) -> RatedPoses:
        """Poses near minima, the lowest first, from as many rounds as needed.

        The best of E_0 and E_l join the first round, and are kept as they are, too.
        """
        effort, problem = self._effort, self._problem
        given = Poses.of(np.concatenate([problem.initial_set, problem.low_cost_set]))
        if self._settings.plane is not None:  # moves keep to the plane, but do not lead onto it
            given = self._space.poses(self._space.encode(given))
        if len(given) > _MOST_GIVEN:
            given = self._costed(given).ordered().poses[:_MOST_GIVEN]
        sampler = AnchorSampler(problem, self._known, self._space, self._settings.anchors)
        found, spent, raised, lowest = given, 0, 0, np.inf
        for index in range(_MOST_ROUNDS):
            starts = sampler.best(
                effort.samples, effort.kept, index=index, tolerance=self._tolerances[raised]
            )
            self._observer.progress("sample", effort.samples, effort.samples)
            fitted = self._fitted(starts if index else Poses.joined([starts, given]))
            descended = self._descended(fitted, index)
            before, found = found, Poses.joined([found, descended.poses])
            spent += effort.samples + effort.kept * effort.first_steps
            spent += effort.refined * effort.steps + effort.descents * effort.descent_moves
            self._observer.progress("search", min(spent, effort.evaluations), effort.evaluations)
            lowest = min(lowest, float(descended.energies.min()))
            if lowest > effort.enough * self._settings.noise and raised + 1 < len(self._tolerances):
                raised += 1
                self.energy = self.energy.at(self._wide(raised))
                continue
            if spent >= effort.evaluations or (index and not self._new_modes(before, descended)):
                break
            self.energy = self.energy.at(self._wide(raised))
        self._settle(found, raised)
        polished = self._polished(self._costed(found).ordered())
        polished = self._estimated(polished)
        self._show("descend", polished)
        return polished

    def _polished(self, rated: RatedPoses) -> RatedPoses:
        """All, of which the lowest, and some candidates far apart, are taken to their minima."""
        effort = self._effort
        rated = self._refined(rated, self.energy.loss)
        candidates = rated.energies <= self._limit(rated.energies)
        apart = farthest_poses(self._problem.sdf, rated.poses[candidates], effort.polished)
        which = np.union1d(apart, np.arange(min(effort.polished, len(rated.energies))))
        floor = _LOWEST * self.energy.level.sigma
        walked = self._walked_down(rated, which, floor, effort.polish_moves, index=3).ordered()
        return self._refined(walked, self.energy.loss)

    def holds(self, best: Poses, poses: Poses) -> BoolArray:
        """Which poses have energies that the noise and shared errors allow beside the best pose."""
        self.energy = self.energy.at(self._wide(len(self._tolerances) - 1))
        self._estimate(self._costed(best))
        limit = self._limit(self.energy.of(best)) + self._settings.shared_error
        return self.energy.of(poses) <= limit

    def _new_modes(self, before: Poses, last: RatedPoses) -> bool:
        """Whether candidates of the last round are far from all before."""
        limit = self._limit(last.energies)
        new = last.chosen(last.energies <= limit).poses
        old = before[self.energy.of(before) <= limit]
        return has_new_mode(self._problem.sdf, old, new, len(self._problem.initial_set))

    def _settle(self, found: Poses, raised: int) -> None:
        """Take the least tolerance of free points that explains them about as well as the last.

        With it the noise at the lowest pose.
        """
        levels = [self.energy.at(self._wide(n)) for n in range(raised + 1)]
        rated = [RatedPoses(found, energy.of(found)).ordered() for energy in levels]
        least = [float(one.energies[0]) for one in rated]
        most = _AS_WELL * least[-1] + self._settings.noise
        chosen = next(n for n, value in enumerate(least) if value <= most or n == raised)
        self.energy = levels[chosen]
        self._estimate(rated[chosen])

    def _costed(self, poses: Poses) -> RatedPoses:
        return RatedPoses(poses, self.energy.of(poses))

    def _estimate(self, poses: RatedPoses) -> None:
        """Take the noise at the lowest pose, but no less than the sensor's."""
        settings = self._settings
        noise = self.energy.noise(poses.ordered().poses[:1], settings.noise)
        sigma = min(noise.sigma, max(_REACH, settings.noise))
        cap = min(_OUTLYING, _ALL_OUTLYING / max(len(self._known.known), 1))
        self.energy = self.energy.at(NoiseLevel(sigma, self.energy.level.tolerance, cap))

    def _estimated(self, rated: RatedPoses) -> RatedPoses:
        """The poses by the noise at the lowest of them, the lowest first."""
        before = self.energy.level
        self._estimate(rated)
        return rated if self.energy.level == before else self._costed(rated.poses).ordered()

    def _fitted(self, poses: Poses) -> RatedPoses:
        """All fitted by a few steps, and the better part of them by more; the lowest first."""
        effort, energy = self._effort, self.energy
        fitted = self._costed(energy.fitted(poses, effort.first_steps, _COARSE)).ordered()
        fitted = self._refined(fitted, _FINE)
        self._show("fit", fitted)
        return fitted

    def _refined(self, rated: RatedPoses, loss: Loss) -> RatedPoses:
        """The better part of them, the lowest first, fitted where that lowers their energies."""
        before = rated.chosen(slice(self._effort.refined))
        after = self._costed(self.energy.fitted(before.poses, self._effort.steps, loss))
        lower = after.energies < before.energies
        others = rated.chosen(slice(self._effort.refined, None))
        return RatedPoses.joined(after.chosen(lower), before.chosen(~lower), others).ordered()

    def _descended(self, fitted: RatedPoses, index: int) -> RatedPoses:
        """The better part of them, of which the lowest walk down to the limit that holds so far."""
        effort = self._effort
        fitted = self._estimated(fitted.chosen(slice(max(effort.refined, effort.descents))))
        limit = self._limit(fitted.energies)
        lowest = np.arange(min(effort.descents, len(fitted.energies)))
        return self._walked_down(fitted, lowest, limit, effort.descent_moves, index=2 + 2 * index)

    def _walked_down(
        self, rated: RatedPoses, which: IntArray, floor: float, moves: int, *, index: int
    ) -> RatedPoses:
        """All, of which those of some indices walked down to a floor, these first."""
        chains = self.energy.walked(*rated.chosen(which), floor, moves, kept=0, index=index)
        others = np.setdiff1d(np.arange(len(rated.energies)), which)
        return RatedPoses.joined(
            RatedPoses(Poses(chains.poses), chains.energies), rated.chosen(others)
        )

    def _limit(self, energies: FloatArray) -> float:
        """The energy below which poses are candidates."""
        settings, least, sigma = self._settings, float(energies.min()), self.energy.level.sigma
        relative = settings.limit_ratio * least + settings.limit_slack * sigma
        return max(settings.limit_noise * sigma, relative, least)

    def spread(self, minima: RatedPoses) -> RatedPoses:
        """Minima below the limit, walks from there below it, and others below a higher limit.

        The latter as it is not known that well which energies the contacts allow.
        """
        settings, limit = self._settings, self._limit(minima.energies)
        outer_limit = limit + settings.outer_noise * self.energy.level.sigma
        chains = max(self._effort.chains, -(-2 * len(self._problem.initial_set) // _KEPT))
        outer = int(settings.outer_share * chains)
        candidates = RatedPoses.joined(
            minima.chosen(minima.energies <= limit),
            self._walked_below(minima, limit, chains - outer, index=0),
            self._walked_below(minima, outer_limit, outer, index=1),
        )
        lowest = int(np.argmin(candidates.energies))
        order = np.arange(len(candidates.energies))
        order[[0, lowest]] = lowest, 0
        candidates = candidates.chosen(order)  # the first is always chosen
        self._show("spread", candidates)
        return candidates

    def _walked_below(
        self, minima: RatedPoses, limit: float, chains: int, *, index: int
    ) -> RatedPoses:
        """States below a limit of chains that start at minima far apart."""
        minima = minima.chosen(minima.energies <= limit)
        starts = np.resize(farthest_poses(self._problem.sdf, minima.poses, chains), chains)
        walked = self.energy.walked(
            *minima.chosen(starts), limit, self._effort.moves, kept=_KEPT, index=index
        )
        states = RatedPoses(Poses(walked.kept.reshape(-1, 12)), walked.kept_energies.reshape(-1))
        return states.chosen(states.energies <= limit)

    def hypotheses(self, candidates: RatedPoses) -> Hypotheses:
        """As many hypotheses as E_0 has poses, and all candidates offered to the archive."""
        problem, space, settings = self._problem, self._space, self._settings.archive
        poses, count = candidates.poses, len(problem.initial_set)
        chosen = representatives(problem.sdf, poses, count)
        if len(chosen) < count:
            others = np.setdiff1d(np.arange(len(poses)), chosen)
            new = ~repeated(poses[np.concatenate([chosen, others])])
            others = others[new[len(chosen) :]]
            others = others[evenly_spaced(len(others), count - len(chosen))]
            chosen = np.resize(np.concatenate([chosen, others]), count)
        measure = measure_named(settings.measure, planar=self._settings.plane is not None)
        vectors = space.encode(poses)
        offered = Evaluated(vectors, candidates.energies, measure.values(space, vectors))
        mean, deviation = measure_range(offered, measure, settings, len(problem.points.known))
        archive = sized_archive(measure, mean, deviation, settings, space.dimension)
        archive.update_cells(offered)
        self._observer.snapshot(archive.snapshot(0, 0))
        last = archive.snapshot(0, 0)  # one of our own: an observer may change what it gets
        elites = space.poses(last.solutions)
        cells = archive.cells_of(offered.measures[chosen])
        hypotheses = space.poses(vectors[chosen])
        energies = self.energy.of(hypotheses)
        found = ranked(hypotheses.matrices, energies, cells, elites.matrices, last)
        return replace(found, candidates=poses.matrices)

    def _show(self, stage: str, candidates: RatedPoses) -> None:
        vectors = self._space.encode(candidates.poses)
        self._observer.trace(stage, 0, vectors.copy(), candidates.energies.copy())
        self._observer.progress(stage, 1, 1)
