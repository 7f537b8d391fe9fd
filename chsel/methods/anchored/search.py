"""The six stages of docs/anchored.md, in its order: sample, fit, descend, twins, spread, choose."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from chsel.methods.anchor_sampling import AnchorSampler, most_informative_first
from chsel.methods.anchored.anchored_settings import EFFORTS, AnchoredSettings
from chsel.methods.anchored.choosing import chosen_hypotheses, filled_up
from chsel.methods.anchored.energy import Energy
from chsel.methods.anchored.fitting import fitted, twists_of
from chsel.methods.anchored.near_symmetries import near_symmetries
from chsel.methods.anchored.walking import Chains, stride_of, walked
from chsel.numerics.arrays import FloatArray
from chsel.problem.basins import basin_bests, has_new_mode
from chsel.problem.noise import LEVELS, NoiseModel, noise_model
from chsel.problem.poses import Poses, compose, product, rotated
from chsel.problem.registration_problem import Hypotheses, Observer, RegistrationProblem
from chsel.problem.search_space import origin_bounds, search_space
from chsel.problem.streams import Purpose
from chsel.problem.subset import farthest_poses
from chsel.problem.surface import object_centre
from chsel.qd.archive import Evaluated
from chsel.qd.measures import measure_named
from chsel.qd.selection import ranked, sized_archive

# Where these numbers are from: docs/anchored.md, "Numbers that are no settings".
_LEAST_SCORED = 3  # contacts that stay in the score of samples if one is left out
_ROUGH_SOFTNESS = 0.01  # metres that the border of a free voxel is off, in the rough fit
_ROUGH_WRONG = 50.0  # nats that a free voxel costs at most, in the rough fit
_ROUGH_NORMALS = 0.5  # radians that normals are off, in the rough fit
_LIKELY = 6.3  # nats above the lowest energy of minima that walks start from


class RatedPoses(NamedTuple):
    """Poses with their energies."""

    poses: Poses  # (B,)
    energies: FloatArray  # (B,), nats

    @classmethod
    def joined(cls, *parts: RatedPoses) -> RatedPoses:
        """Return the poses of all parts, in their order."""
        energies = np.concatenate([part.energies for part in parts])
        return cls(Poses.joined([part.poses for part in parts]), energies)

    def chosen(self, which: Any) -> RatedPoses:
        """Return some of the poses: by a slice, flags (B,) or indices."""
        return RatedPoses(self.poses[which], self.energies[which])

    def ordered(self) -> RatedPoses:
        """Return the poses with the lowest energy first."""
        return self.chosen(np.argsort(self.energies, kind="stable"))


class Search:
    """One registration by the stages of docs/anchored.md."""

    def __init__(
        self, problem: RegistrationProblem, settings: AnchoredSettings, *, observer: Observer
    ) -> None:
        self._problem = problem
        self._settings = settings
        self._observer = observer
        self._effort = settings.effort or EFFORTS[settings.size]
        self._space = search_space(settings.plane, problem.sdf)
        contacts = most_informative_first(problem.points)
        most = self._effort.contacts
        self._known = contacts.with_known(slice(most))
        bounds = origin_bounds(problem.workspace, self._space, margin=settings.anchors.margin)
        centre = object_centre(problem.sdf)
        self._twists = twists_of(self._space, centre)
        self._stride = stride_of(self._space, centre, bounds=bounds)
        self._walks = 0  # done so far, each with a random stream of its own
        self.energy = Energy(problem, self._known, noise=noise_model(settings.noise))

    def minima(self) -> RatedPoses:
        """Return the minima of all basins that stages 1 to 4 find, the lowest first.

        Stages 1 to 3 are repeated while a round finds a new mode. The best of E_0 and E_l join the
        first round, and stay among the minima as they are, too.
        """
        effort = self._effort
        previous = self._previous()
        minima = self.rated(previous)
        spent = 0
        for index in range(effort.rounds):
            starts = self.sample(index)
            if index == 0:
                starts = Poses.joined([starts, previous])
            fits = self.fit(starts)
            floor = self._limit(minima)
            new = self.descend(fits, effort.descents, moves=effort.descent_moves, floor=floor)
            before = minima
            minima = RatedPoses.joined(minima, new).ordered()
            spent += effort.samples + effort.kept * effort.first_steps
            spent += effort.refined * effort.steps + effort.descents * effort.descent_moves
            self._observer.progress("search", min(spent, effort.evaluations), effort.evaluations)
            if spent >= effort.evaluations or (index > 0 and not self._new_mode(before, new)):
                break
        minima = self.descend(minima, effort.polished, moves=effort.polish_moves, floor=0.0)
        minima = self.with_twins(minima)
        self._show("descend", minima)
        return minima

    def sample(self, index: int) -> Poses:
        """Return the best of random poses on contacts by the coarse score of a round (stage 1).

        The score of every second round leaves out the contact that a pose fits worst.
        """
        effort = self._effort
        left_out = index % 2 if len(self._known.known) > _LEAST_SCORED else 0
        poses = self._sampler.best(effort.samples, effort.kept, index=index, left_out=left_out)
        self._observer.progress("sample", effort.samples, effort.samples)
        return poses

    def fit(self, starts: Poses) -> RatedPoses:
        """Return minima near starts, the lowest first (stage 2).

        Fits are first by rough noise, then by the right one.
        """
        rough = NoiseModel(
            sigmas=(self._settings.rough_noise,) * LEVELS,
            weights=(1.0 / LEVELS,) * LEVELS,
            softness=_ROUGH_SOFTNESS,
            wrong=_ROUGH_WRONG,
            least_normal_noise=_ROUGH_NORMALS,
        )
        poses = fitted(
            self.energy.by(rough), self._twists, poses=starts, steps=self._effort.first_steps
        )
        fits = self.refined(self.rated(poses))
        self._show("fit", fits)
        return fits

    def rated(self, poses: Poses) -> RatedPoses:
        """Return poses with their energies, the lowest first."""
        return RatedPoses(poses, self.energy.of(poses)).ordered()

    def refined(self, rated: RatedPoses) -> RatedPoses:
        """Return all poses, the better part fitted where that lowers the energy, lowest first."""
        count = self._effort.refined
        before = rated.chosen(slice(count))
        poses = fitted(self.energy, self._twists, poses=before.poses, steps=self._effort.steps)
        after = RatedPoses(poses, self.energy.of(poses))
        lower = after.energies < before.energies
        others = rated.chosen(slice(count, None))
        return RatedPoses.joined(after.chosen(lower), before.chosen(~lower), others).ordered()

    def descend(self, rated: RatedPoses, most: int, *, moves: int, floor: float) -> RatedPoses:
        """Return all poses after `most` have walked down to a floor, lowest first (stage 3).

        The best pose of each basin walks, then the lowest of the others if there are fewer basins.
        """
        walkers = basin_bests(self._problem.sdf, rated.poses, most=most)
        others = np.setdiff1d(np.arange(len(rated.energies)), walkers)
        room = most - len(walkers)
        walkers = np.concatenate([walkers, others[:room]])
        chains = self._walk(rated.chosen(walkers), moves=moves, floor=floor)
        low = RatedPoses(Poses(chains.poses), chains.energies)
        return RatedPoses.joined(low, rated.chosen(others[room:])).ordered()

    def with_twins(self, rated: RatedPoses) -> RatedPoses:
        """Return all poses and the fitted twins of the best basins, lowest first (stage 4).

        A twin is a pose moved by a near symmetry of the object.
        """
        sdf = self._problem.sdf
        symmetries = near_symmetries(sdf)
        if len(symmetries) > 0:
            best = rated.poses[basin_bests(sdf, rated.poses, most=self._effort.twins)]
            turns = symmetries[:, None, :3, :3]
            shifts = symmetries[:, None, :3, 3]
            moved = compose(
                product(turns, best.rotations), rotated(turns, best.translations) + shifts
            )
            twins = self._in_space(Poses.of(moved.reshape(-1, 4, 4)))
            fits = self.refined(self.rated(twins))
            rated = RatedPoses.joined(rated, fits).ordered()
        return self.refined(rated)

    def spread(self, minima: RatedPoses) -> RatedPoses:
        """Return minima below the limit and states of walks from there, lowest first (stage 5).

        Walks draw from the likelihood, from likely minima far apart.
        """
        effort = self._effort
        limit = self._limit(minima)
        wanted = 2 * len(self._problem.initial_set)
        chains = max(effort.chains, -(-wanted // effort.states))
        minima = minima.chosen(minima.energies <= limit)
        likely = minima.chosen(minima.energies <= minima.energies.min() + _LIKELY)
        starts = np.resize(farthest_poses(self._problem.sdf, likely.poses, count=chains), chains)
        walks = self._walk(
            likely.chosen(starts), moves=effort.moves, floor=limit, states=effort.states
        )
        states = RatedPoses(Poses(walks.kept.reshape(-1, 12)), walks.kept_energies.reshape(-1))
        candidates = RatedPoses.joined(minima, states.chosen(states.energies <= limit)).ordered()
        self._show("spread", candidates)
        return candidates

    def choose(self, candidates: RatedPoses) -> Hypotheses:
        """Return as many hypotheses as E_0 has poses, and all candidates in an archive (stage 6).

        candidates: the lowest first.
        """
        settings = self._settings
        poses = candidates.poses
        count = len(self._problem.initial_set)
        chosen = chosen_hypotheses(
            self._problem.sdf,
            poses,
            energies=candidates.energies,
            count=count,
            modes=settings.modes,
            reach=settings.reach,
            most=self._effort.pool,
        )
        chosen = filled_up(poses, chosen, count=count)
        measure = measure_named(settings.archive.measure, planar=settings.plane is not None)
        vectors = self._space.encode(poses)
        offered = Evaluated(
            vectors, candidates.energies, measures=measure.values(self._space, vectors)
        )
        known = len(self._problem.points.known)
        archive = sized_archive(
            offered,
            measure,
            settings=settings.archive,
            known_count=known,
            dimension=self._space.dimension,
        )
        offers = archive.add(vectors, -candidates.energies, measures=offered.measures)
        self._observer.snapshot(archive.snapshot(0, 0))
        last = archive.snapshot(0, 0)  # another one: an observer may change what it gets
        elites = self._space.poses(last.solutions)
        hypotheses = self._space.poses(vectors[chosen])
        energies = self.energy.of(hypotheses)
        result = ranked(
            hypotheses.matrices,
            energies,
            cells=offers.cells[chosen],
            elites=elites.matrices,
            archive=last,
        )
        return replace(result, candidates=poses.matrices)

    @cached_property
    def _sampler(self) -> AnchorSampler:
        anchors = self._settings.anchors
        return AnchorSampler(self._problem, self._known, space=self._space, settings=anchors)

    def _previous(self) -> Poses:
        """Return the best poses of E_0 and E_l, and of another estimator in the prior."""
        sets = [self._problem.initial_set, self._problem.low_cost_set]
        prior = self._problem.prior
        if prior is not None and prior.object_from_world is not None:
            sets.append(prior.object_from_world)
        poses = self._in_space(Poses.of(np.concatenate(sets)))
        return self.rated(poses).poses[: self._effort.previous]

    def _in_space(self, poses: Poses) -> Poses:
        """Return the nearest poses in the space: moves keep to a plane, but do not lead onto it."""
        if self._settings.plane is None:
            return poses
        return self._space.poses(self._space.encode(poses))

    def _limit(self, rated: RatedPoses) -> float:
        """Return the energy up to which poses are candidates, nats."""
        return float(rated.energies.min()) + self._settings.limit

    def _new_mode(self, before: RatedPoses, new: RatedPoses) -> bool:
        """Return whether a candidate of the last round is far from all candidates before."""
        limit = min(self._limit(before), self._limit(new))
        return has_new_mode(
            self._problem.sdf,
            before.chosen(before.energies <= limit).poses,
            new=new.chosen(new.energies <= limit).poses,
            count=len(self._problem.initial_set),
        )

    def _walk(self, starts: RatedPoses, *, moves: int, floor: float, states: int = 0) -> Chains:
        stream = self._problem.key.kernel_stream(Purpose.WALKS, self._walks)
        self._walks += 1
        return walked(
            self.energy,
            self._stride,
            poses=starts.poses,
            energies=starts.energies,
            floor=floor,
            moves=moves,
            stream=stream,
            kept=states,
        )

    def _show(self, stage: str, rated: RatedPoses) -> None:
        """Show a stage's poses to the observer."""
        vectors = self._space.encode(rated.poses)
        self._observer.trace(stage, 0, vectors.copy(), rated.energies.copy())
        self._observer.progress(stage, 1, 1)
