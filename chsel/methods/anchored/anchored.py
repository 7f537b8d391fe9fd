"""Contact-anchored search: our own method, for hypotheses that are close to the plausible set."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, NamedTuple

import numpy as np

from chsel.methods.anchor_sampling import AnchorSampler, AnchorSettings, most_informative_first
from chsel.methods.anchored.energy import Energy
from chsel.methods.anchored.fitting import fitted, twists_of
from chsel.methods.anchored.walking import Chains, stride_of, walked
from chsel.methods.method import ConfiguredMethod
from chsel.numerics.arrays import BoolArray, FloatArray, IntArray, evenly_spaced
from chsel.problem.initial_sets import OnlineSettings
from chsel.problem.noise import NoiseModel, noise_model
from chsel.problem.points import KnownPoints, Workspace
from chsel.problem.poses import Poses, compose, product, random_rotations, rotated
from chsel.problem.pushes import Pushes
from chsel.problem.registration_problem import (
    Hypotheses,
    NullObserver,
    Observer,
    RegistrationProblem,
)
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.search_space import PlaneSettings, SE3Space, origin_bounds, search_space
from chsel.problem.settings import CheckedSettings, at_most, not_negative, one_of, positive
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.subset import (
    facilities,
    farthest_points,
    farthest_poses,
    squared_distances,
    surface_descriptors,
)
from chsel.problem.surface import (
    has_surface,
    in_order,
    object_centre,
    outline_distances_to,
    outline_in_object,
)
from chsel.qd.archive import Evaluated
from chsel.qd.measures import measure_named
from chsel.qd.selection import ArchiveSettings, ranked, repeated, sized_archive

_MOST_ROUNDS = 12
# While minima are sought, contacts and free voxels draw from far.
_FAR = NoiseModel((0.015,) * 8, (0.125,) * 8, softness=0.01, wrong=50.0)
_KEPT = 6  # states of a chain
_LIKELY = 6.3  # nats above the best: 95 % of a normal distribution in six dimensions
_MODES = 3  # whose best poses are always among the hypotheses
_LIKELY_MODE = 3.0  # nats of those above the best
_POOL = 400  # candidates that hypotheses are chosen from
_REACH = 1.0  # nats from the true pose to others that are as plausible
_MOST_BASINS = 60  # that results are compared with
_MOST_KNOWN = 64  # points that poses are rated by, as more of them tell hardly more
_LEAST_LEFT = 3  # contacts that poses are sampled on if one is left out
_TWINNED = 12  # basins whose poses are turned by near symmetries
_MOST_GIVEN = 60  # of E_0 and E_l that are fitted
_LEAST_PUSHES = 5  # of which a distance is estimated
_HALVINGS = 2  # of the step between them, around the best
_MOVED = 3.3  # nats: 99 % of a chi-squared distribution, half, of one more parameter


MOST_SAMPLES = 1_000_000_000
MOST_POSES = 1_000_000
MOST_MOVES = 100_000
_ARCHIVE = ArchiveSettings(bins=40, outliers="none")
_ONLINE = OnlineSettings(update="own")


@dataclass(frozen=True)
class Effort(CheckedSettings):
    """How much is computed."""

    samples: Annotated[int, positive, at_most(MOST_SAMPLES)] = 120_000  # poses drawn
    kept: Annotated[int, positive, at_most(MOST_POSES)] = 200  # the best of them, which are fitted
    first_steps: Annotated[int, not_negative, at_most(MOST_MOVES)] = 6  # of these fits
    refined: Annotated[int, positive, at_most(MOST_POSES)] = 100  # of these, fitted further
    steps: Annotated[int, not_negative, at_most(MOST_MOVES)] = 15  # of these fits
    descents: Annotated[int, positive, at_most(MOST_POSES)] = 96  # chains that descend to the limit
    descent_moves: Annotated[int, not_negative, at_most(MOST_MOVES)] = 266
    chains: Annotated[int, positive, at_most(MOST_POSES)] = 96  # chains that spread below it
    moves: Annotated[int, not_negative, at_most(MOST_MOVES)] = 300
    # As many of the lowest, and of candidates far apart, are taken to their minima.
    polished: Annotated[int, not_negative, at_most(MOST_POSES)] = 16
    polish_moves: Annotated[int, not_negative, at_most(MOST_MOVES)] = 300
    # How many evaluations may be spent in rounds of all stages up to the descent: a second one, and
    # further ones while the last found a new mode; 0: one round.
    evaluations: Annotated[int, not_negative, at_most(MOST_SAMPLES)] = 0


_SMALL = Effort(
    samples=40_000,
    kept=64,
    first_steps=10,
    refined=40,
    descents=24,
    descent_moves=60,
    chains=24,
    moves=150,
    polished=8,
    polish_moves=200,
)
_LARGE = Effort(
    samples=400_000,
    kept=504,
    refined=150,
    descents=120,
    descent_moves=500,
    chains=120,
    moves=1000,
    polished=32,
    polish_moves=1000,
)
EFFORTS = {
    "small": _SMALL,
    "medium": Effort(),
    "large": _LARGE,
    "adaptive": replace(_SMALL, chains=60, moves=400, evaluations=600_000),
}


@dataclass(frozen=True)
class AnchoredSettings(CheckedSettings):
    """All settings of the contact-anchored search, the same in all presets.

    The method is neither in the paper nor in its authors' code.
    """

    size: Annotated[str, one_of(*EFFORTS)] = "adaptive"
    effort: Effort | None = None  # in place of the one that `size` names
    # Of the sensor, as in its data sheet: standard deviation of known points, metres. The noise
    # that is estimated from the points is no less.
    noise: Annotated[float, positive] = 0.0005
    # Candidates have energies at most so much above the lowest, nats.
    limit: Annotated[float, positive] = 9.0
    # What contacts are off that no residual shows, metres: calibration of hand and camera, scale
    # of the mesh.
    shared_error: Annotated[float, not_negative] = 0.004
    anchors: AnchorSettings = field(default_factory=AnchorSettings)
    archive: ArchiveSettings = _ARCHIVE
    online: OnlineSettings = _ONLINE
    plane: PlaneSettings | None = None  # restricts the poses to SE(2)


class RatedPoses(NamedTuple):
    """Poses with their energies."""

    poses: Poses
    energies: FloatArray  # (B,), nats

    @classmethod
    def joined(cls, *parts: RatedPoses) -> RatedPoses:
        """Those of all parts, in their order."""
        energies = np.concatenate([part.energies for part in parts])
        return cls(Poses.joined([part.poses for part in parts]), energies)

    def chosen(self, which: Any) -> RatedPoses:
        """Some of them: a slice, flags (B,) or indices."""
        return RatedPoses(self.poses[which], self.energies[which])

    def ordered(self) -> RatedPoses:
        """The lowest first."""
        return self.chosen(np.argsort(self.energies, kind="stable"))


class Carried(NamedTuple):
    """What is found of an object if every push has moved it by one distance."""

    distance: float  # metres
    search: Search
    minima: RatedPoses

    @property
    def lowest(self) -> float:
        """The energy of the best pose, nats."""
        return float(self.minima.energies[0])


class Anchored(ConfiguredMethod[AnchoredSettings]):
    """Samples anchored on contacts, fitted, spread below a limit, and a diverse choice of them.

    Costs are energies, nats.
    """

    settings_class = AnchoredSettings

    def _hypotheses(self, problem: RegistrationProblem, observer: Observer) -> Hypotheses:
        found = self._carried(problem, 0.0, observer)
        if problem.pushes is not None and len(problem.pushes.directions) >= _LEAST_PUSHES:
            moved = self._moved(problem, problem.pushes, observer)
            if moved.lowest < found.lowest - _MOVED:
                found = moved
        hypotheses = found.search.hypotheses(found.search.spread(found.minima))
        return replace(hypotheses, push_distance=found.distance)

    def _carried(
        self, problem: RegistrationProblem, distance: float, observer: Observer
    ) -> Carried:
        """The minima of an object that every push has moved by a distance, metres."""
        search = Search(problem.carried(distance), self.settings, observer)
        return Carried(distance, search, search.minima())

    def _moved(self, problem: RegistrationProblem, pushes: Pushes, observer: Observer) -> Carried:
        """The same for the distance above 0 of lowest energy.

        The likelihood of the best pose has a maximum that a few searches find; between these, their
        minima are fitted again.
        """
        _, step, *others = pushes.distances
        tried = [self._carried(problem, distance, observer) for distance in (step, *others)]
        best = min(tried, key=lambda s: s.lowest)
        for _ in range(_HALVINGS):
            step *= 0.5
            near = [best]
            for distance in (best.distance - step, best.distance + step):
                if distance <= pushes.largest:
                    search = Search(problem.carried(distance), self.settings, observer)
                    fits = search.refined(search.rated(best.minima.poses))
                    near.append(Carried(distance, search, fits))
            best = min(near, key=lambda s: s.lowest)
        return best

    def minima(self, problem: RegistrationProblem) -> Poses:
        """A pose of every basin that a search finds, the likeliest first."""
        found = Search(problem, self.settings, NullObserver()).minima()
        return found.poses[distinct(problem.sdf, found.poses, _MOST_BASINS)]

    def holds(
        self, problem: RegistrationProblem, hypotheses: Hypotheses, object_from_world: FloatArray
    ) -> BoolArray:
        """Which poses (N, 4, 4) the points allow, beside hypotheses for them: flags (N,).

        Those with an energy below the limit, beside the best hypothesis, where errors that points
        may share cost nothing.
        """
        problem = problem.carried(hypotheses.push_distance)
        settings, search = self.settings, Search(problem, self.settings, NullObserver())
        energy = search.energy.by(noise_model(settings.noise, settings.shared_error))
        best = energy.of(Poses.of(hypotheses.object_from_world[:1]))
        return energy.of(Poses.of(object_from_world)) <= best[0] + settings.limit


class Search:
    """The stages of one registration."""

    def __init__(
        self, problem: RegistrationProblem, settings: AnchoredSettings, observer: Observer
    ) -> None:
        self._problem, self._settings, self._observer = problem, settings, observer
        self._effort = settings.effort or EFFORTS[settings.size]
        self._space = search_space(settings.plane, problem.sdf)
        known = most_informative_first(problem.points)
        self._known = replace(
            known, known=known.known[:_MOST_KNOWN], known_sdf=known.sdf[:_MOST_KNOWN]
        )
        bounds = origin_bounds(problem.workspace, self._space, settings.anchors.margin)
        centre = object_centre(problem.sdf)
        self._twists = twists_of(self._space, centre)
        self._stride = stride_of(self._space, centre, bounds)
        self.energy = Energy(problem, self._known, noise_model(settings.noise))
        self._walks = 0

    def rated(self, poses: Poses) -> RatedPoses:
        """The poses with their energies, the lowest first."""
        return RatedPoses(poses, self.energy.of(poses)).ordered()

    def minima(self) -> RatedPoses:
        """The minima of all basins that were found, the lowest first.

        Rounds go on while the last one found a new mode. Every second one samples by all contacts
        but the one that a pose fits least, which may be on another object. The best of E_0 and E_l
        join the first, and are kept as they are, too.
        """
        effort = self._effort
        given = self._given()
        sampler = AnchorSampler(self._problem, self._known, self._space, self._settings.anchors)
        far = self.energy.by(_FAR)
        found, spent = self.rated(given), 0
        for index in range(_MOST_ROUNDS):
            left_out = index % 2 if len(self._known.known) > _LEAST_LEFT else 0
            starts = sampler.best(effort.samples, effort.kept, index=index, left_out=left_out)
            self._observer.progress("sample", effort.samples, effort.samples)
            starts = starts if index else Poses.joined([starts, given])
            rough = self.rated(fitted(far, self._twists, starts, effort.first_steps))
            fits = self.refined(rough)
            self._show("fit", fits)
            last = self._descended(fits, effort.descents, effort.descent_moves, self._limit(found))
            before, found = found, RatedPoses.joined(found, last).ordered()
            spent += effort.samples + effort.kept * effort.first_steps
            spent += effort.refined * effort.steps + effort.descents * effort.descent_moves
            self._observer.progress("search", min(spent, effort.evaluations), effort.evaluations)
            if spent >= effort.evaluations or (index and not self._new_modes(before, last)):
                break
        polished = self._descended(found, effort.polished, effort.polish_moves, 0.0)
        polished = self.refined(self._with_twins(polished))
        self._show("descend", polished)
        return polished

    def _with_twins(self, rated: RatedPoses) -> RatedPoses:
        """All, and the best of the basins turned by each near symmetry of the object, fitted."""
        symmetries = near_symmetries(self._problem.sdf)
        if len(symmetries) == 0:
            return rated
        best = rated.poses[distinct(self._problem.sdf, rated.poses, _TWINNED)]
        turn, shift = symmetries[:, None, :3, :3], symmetries[:, None, :3, 3]
        turned = compose(product(turn, best.rotations), rotated(turn, best.translations) + shift)
        poses = self._in_space(Poses.of(turned.reshape(-1, 4, 4)))
        twins = self.refined(self.rated(poses))
        return RatedPoses.joined(rated, twins).ordered()

    def _in_space(self, poses: Poses) -> Poses:
        """The nearest poses in the space; moves keep to a plane, but do not lead onto it."""
        if self._settings.plane is None:
            return poses
        return self._space.poses(self._space.encode(poses))

    def _given(self) -> Poses:
        problem = self._problem
        given = Poses.of(np.concatenate([problem.initial_set, problem.low_cost_set]))
        return self.rated(self._in_space(given)).poses[:_MOST_GIVEN]

    def refined(self, rated: RatedPoses) -> RatedPoses:
        """The better part of them, the lowest first, fitted where that lowers their energies."""
        before = rated.chosen(slice(self._effort.refined))
        poses = fitted(self.energy, self._twists, before.poses, self._effort.steps)
        after = RatedPoses(poses, self.energy.of(poses))
        lower = after.energies < before.energies
        others = rated.chosen(slice(self._effort.refined, None))
        return RatedPoses.joined(after.chosen(lower), before.chosen(~lower), others).ordered()

    def _descended(self, rated: RatedPoses, most: int, moves: int, floor: float) -> RatedPoses:
        """All, of which the lowest of every basin walks down to a floor; the lowest first."""
        which = distinct(self._problem.sdf, rated.poses, most)
        others = np.setdiff1d(np.arange(len(rated.energies)), which)
        room = most - len(which)
        which, others = np.concatenate([which, others[:room]]), others[room:]
        chains = self._walked(rated.chosen(which), floor, moves)
        down = RatedPoses(Poses(chains.poses), chains.energies)
        return RatedPoses.joined(down, rated.chosen(others)).ordered()

    def _walked(self, starts: RatedPoses, floor: float, moves: int, kept: int = 0) -> Chains:
        stream = self._problem.key.kernel_stream(Purpose.WALKS, self._walks)
        self._walks += 1
        return walked(self.energy, self._stride, *starts, floor, moves, stream, kept)

    def _limit(self, rated: RatedPoses) -> float:
        """The energy below which poses are candidates."""
        return float(rated.energies.min()) + self._settings.limit

    def _new_modes(self, before: RatedPoses, last: RatedPoses) -> bool:
        """Whether candidates of the last round are far from all before."""
        limit = min(self._limit(before), self._limit(last))
        old, new = (some.chosen(some.energies <= limit).poses for some in (before, last))
        return has_new_mode(self._problem.sdf, old, new, len(self._problem.initial_set))

    def spread(self, minima: RatedPoses) -> RatedPoses:
        """Minima below the limit, and walks from there below it; the lowest first."""
        limit = self._limit(minima)
        chains = max(self._effort.chains, -(-2 * len(self._problem.initial_set) // _KEPT))
        minima = minima.chosen(minima.energies <= limit)
        likely = minima.chosen(minima.energies <= minima.energies.min() + _LIKELY)
        starts = np.resize(farthest_poses(self._problem.sdf, likely.poses, chains), chains)
        chain = self._walked(likely.chosen(starts), limit, self._effort.moves, _KEPT)
        states = RatedPoses(Poses(chain.kept.reshape(-1, 12)), chain.kept_energies.reshape(-1))
        candidates = RatedPoses.joined(minima, states.chosen(states.energies <= limit)).ordered()
        self._show("spread", candidates)
        return candidates

    def hypotheses(self, candidates: RatedPoses) -> Hypotheses:
        """As many hypotheses as E_0 has poses, and all candidates offered to the archive."""
        problem, space, settings = self._problem, self._space, self._settings.archive
        poses, count = candidates.poses, len(problem.initial_set)
        chosen = self._representative(candidates, count)
        if len(chosen) < count:
            others = np.setdiff1d(np.arange(len(poses)), chosen)
            new = ~repeated(poses[np.concatenate([chosen, others])])
            others = others[new[len(chosen) :]]
            others = others[evenly_spaced(len(others), count - len(chosen))]
            chosen = np.resize(np.concatenate([chosen, others]), count)
        measure = measure_named(settings.measure, planar=self._settings.plane is not None)
        vectors = space.encode(poses)
        offered = Evaluated(vectors, candidates.energies, measure.values(space, vectors))
        known = len(problem.points.known)
        archive = sized_archive(offered, measure, settings, known, space.dimension)
        offers = archive.add(vectors, -candidates.energies, offered.measures)
        self._observer.snapshot(archive.snapshot(0, 0))
        last = archive.snapshot(0, 0)  # one of our own: an observer may change what it gets
        elites = space.poses(last.solutions)
        hypotheses = space.poses(vectors[chosen])
        energies = self.energy.of(hypotheses)
        cells = offers.cells[chosen]
        found = ranked(hypotheses.matrices, energies, cells, elites.matrices, last)
        return replace(found, candidates=poses.matrices)

    def _representative(self, candidates: RatedPoses, count: int) -> IntArray:
        """Indices of candidates: the best of the likeliest modes, and those that cover the rest.

        Each candidate may be the true pose, all alike, as they were drawn from the likelihood; then
        those are plausible that are at most _REACH less likely. The others are chosen one after
        another so that the expected plausible diversity (Sec. V of the paper) is the least: how far
        plausible poses are from the nearest hypothesis, and hypotheses from the plausible poses.
        """
        sdf, energies = self._problem.sdf, candidates.energies
        likely = int((energies <= energies.min() + _LIKELY_MODE).sum())  # the lowest come first
        modes = distinct(sdf, candidates.poses[:likely], min(_MODES, count))
        pool = np.union1d(modes, evenly_spaced(len(energies), _POOL))
        apart = squared_distances(sdf, candidates.poses[pool])
        energies = energies[pool]
        plausible = np.searchsorted(energies, energies + _REACH, side="right")
        # The chance of each to be drawn from the plausible set of a random true pose.
        shares = np.bincount(plausible - 1, 1.0 / plausible, len(plausible))
        weights = np.cumsum(shares[::-1])[::-1] / len(plausible)
        to_set = np.minimum.accumulate(apart, axis=1)[:, plausible - 1]
        prices = in_order(to_set) / (len(pool) * count)
        given = np.searchsorted(pool, modes)
        return pool[facilities(weights[:, None] * apart, given, count, prices)]

    def _show(self, stage: str, candidates: RatedPoses) -> None:
        vectors = self._space.encode(candidates.poses)
        self._observer.trace(stage, 0, vectors.copy(), candidates.energies.copy())
        self._observer.progress(stage, 1, 1)


FAR = 0.01  # metres between outlines of different modes, at least
_TURNED = 0.35  # radians between poses of different basins, even where their outlines are alike
_TURNS = 2000  # of the object, among which near symmetries are sought: about 15 degrees apart
_FITTED = 100  # of these
_STEPS = 20
_ALIKE = 0.04  # diameters that a near symmetry moves the surface by at most, root mean square
_MOST = 8  # near symmetries


def has_new_mode(sdf: SdfGrid, old: Poses, new: Poses, wanted: int) -> bool:
    """Whether any of new poses is far from all old ones.

    Far is farther apart than as many old ones as are wanted, spread as far as can be.
    """
    if len(old) == 0 or len(new) == 0:
        return len(new) > 0
    outlines = surface_descriptors(sdf, Poses.joined([old, new]))
    outlines, new_outlines = outlines[: len(old)], outlines[len(old) :]
    chosen = farthest_points(outlines, wanted)
    spacing = _apart(outlines[chosen[:-1]], outlines[chosen[-1:]]) if len(chosen) > 1 else 0.0
    return _apart(outlines, new_outlines) > max(spacing, FAR)


def _apart(outlines: FloatArray, others: FloatArray) -> float:
    """The largest distance (m) of other outlines (M, D) from the nearest of outlines (N, D)."""
    nearest = [((outlines - other) ** 2).mean(axis=1).min() for other in others]
    return float(np.sqrt(max(nearest)))


def distinct(sdf: SdfGrid, poses: Poses, most: int, far: float = FAR) -> IntArray:
    """Indices of at most `most` poses, each far from, or turned against, all chosen before it."""
    outlines, rotations = surface_descriptors(sdf, poses), poses.rotations.reshape(-1, 9)
    least = 1.0 + 2.0 * np.cos(_TURNED)  # trace of the relative rotation
    chosen: list[int] = []
    left = np.ones(len(poses), dtype=bool)
    while len(chosen) < most and left.any():
        n = int(np.argmax(left))
        chosen.append(n)
        others = np.flatnonzero(left)
        near = ((outlines[others] - outlines[n]) ** 2).mean(axis=1) <= far**2
        turned = (rotations[others] * rotations[n]).sum(axis=1) < least
        left[others[near & ~turned]] = False
        left[n] = False
    return np.array(chosen, dtype=np.int64)


def near_symmetries(sdf: SdfGrid) -> FloatArray:
    """Motions (S, 4, 4) of the object under which its surface nearly comes back to where it was.

    None is the identity; derived once.
    """

    def make() -> FloatArray:
        if not has_surface(sdf):
            return np.zeros((0, 4, 4))
        surface, identity, key = outline_in_object(sdf), np.eye(4)[None], StreamKey(0, 0)
        around = Workspace(tuple(sdf.bounds[0]), tuple(sdf.bounds[1]))
        problem = RegistrationProblem(
            sdf, KnownPoints(known=surface), identity, around, sdf.resolution, key
        )
        centre, space = object_centre(sdf), SE3Space()
        energy = Energy(problem, problem.points, noise_model(FAR))
        turns = random_rotations(key.stream(Purpose.MESH_SAMPLES, 1), _TURNS)
        turned = Poses.of(compose(turns, centre - rotated(turns, centre)))
        best = np.argsort(energy.of(turned), kind="stable")[:_FITTED]
        fits = fitted(energy, twists_of(space, centre), turned[best], _STEPS)
        same = Poses.of(identity)
        moved = outline_distances_to(sdf, fits, same)
        order = np.argsort(moved, kind="stable")
        order = order[moved[order] <= _ALIKE * sdf.diameter]
        poses = Poses.joined([same, fits[order]])
        return poses[distinct(sdf, poses, _MOST + 1, np.inf)[1:]].matrices

    return sdf.derived("near symmetries", make)
