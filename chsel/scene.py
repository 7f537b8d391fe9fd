"""Several objects at once: which touch was of which of them, and a session for each.

    E(a, X) = sum_c e(c, X_a(c)) + sum_i [f_i(X_i) + g_i(a)] + sum_ij h_ij(X_i, X_j)

in nats: e is minus the logarithm of the density of contact c, on the object that assignment a gives
it, or on none, by the model of `chsel.problem.noise`; f_i that of free space and of what is known
beforehand of object i; g_i says that contacts of one object are near each other, within its size,
and that its first six are fitted whatever they are, as a pose is free to do so: they are as likely
here as anywhere within EXTENT, like those on none. h_ij says that no object is inside another.
Poses X are those that the method finds for the contacts that an object has been given; assignments
and poses are improved in turn, from several starts.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from chsel.errors import PointsError, PointsWarning, SettingError, quoted, require_choice
from chsel.next_probe.decision_problem import Actions
from chsel.numerics.arrays import FloatArray, IntArray
from chsel.problem.initial_sets import posed_problem
from chsel.problem.noise import (
    EXTENT,
    FREEDOMS,
    LIMIT,
    SHARE,
    PosedNormals,
    noise_model,
    normal_factors,
)
from chsel.problem.points import MOST_OUTSIDE, KnownPoints, Workspace
from chsel.problem.pose_prior import PosePrior
from chsel.problem.poses import Poses, apply
from chsel.problem.registration_problem import Hypotheses, NullObserver, RegistrationProblem
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.surface import signed_distances, surface_points
from chsel.problem.trust import SENSOR_NOISE, pose_energies, posed_normals
from chsel.session.perception import touched_points
from chsel.session.session import NextProbe, Session

if TYPE_CHECKING:
    import trimesh

NOBODY = -1
"""The number of no object, of a contact on something else."""
_FEWEST_GAINED = 1.0  # nats for which a contact changes to another object
_FITS = 6.0  # nats: a contact that costs less is explained
_GONE_ON_WITH = 3  # starts
_MOST_OBJECTS = 4  # as starts are assignments by place in every order
_ROUNDS = 2  # of assignments and poses in turn, after the first, at most
_NEAR = 0.35  # of the diameter: deviation of contacts from their middle
_OVERLAP = 0.004  # m: a depth inside of another object that is no surprise
_MOST_OVERLAP = 20.0  # nats
_SURFACE = 200  # points of each object by which overlaps are found
_OF_CONTACTS = ("contacts", "normals", "normal_noise", "contact", "normal")


@dataclass(frozen=True, eq=False)
class SceneObject:
    """One of the objects, at the last registration."""

    name: str
    contacts: IntArray  # numbers of the contacts that are on it, in the order in which they came
    answer: Hypotheses | None  # that of its session; None as long as nothing touched it
    world_from_object: FloatArray | None  # (4, 4): the best pose beside those of the other objects


class _Pool(NamedTuple):
    """Poses of an object that explain some contacts."""

    poses: Poses  # (B, 12)
    costs: FloatArray  # (B, M), of each contact if it is on the object, nats
    own: FloatArray  # (B,), of free space and prior, nats
    surfaces: FloatArray  # (B, S, 3), points of the surface, world


class _Joint(NamedTuple):
    """An assignment of contacts, with the best poses by it."""

    energy: float
    given: tuple[int, ...]  # (M,), the object of each contact, or NOBODY
    worst: float  # what the contact that fits worst costs, nats


class Scene:
    """Sessions of several objects, each of which is there once or not at all.

    sessions: by name. objects: at the last registration, by name. owners (M,): names of the objects
    of all contacts, in the order in which they came, "" of those on none. margin: nats by which the
    next best of the assignments that were tried explains less than theirs; below 9 touches may be
    of others. Where an assignment stands, it is that of when others were tried last.
    """

    def __init__(
        self,
        targets: Mapping[str, trimesh.Trimesh] | Sequence[str | Path],
        *,
        workspace: Workspace,
        record: str | Path | None = None,
        noise: float | None = None,
        priors: Mapping[str, PosePrior] | None = None,
        **given: Any,
    ) -> None:
        """Open a session for each object.

        targets: meshes by name, or paths, whose stems are the names. workspace: where all are.
        record: a new file NAME.mcap; each object has its own, NAME_OBJECT.mcap. priors: what is
        known beforehand of the poses of some, by name. noise, given: the same for all, see
        `chsel.Session`; objects stand still.
        Raises SettingError for fewer than two or more than four, two of one name, and moves.
        """
        named = targets if isinstance(targets, Mapping) else {Path(t).stem: t for t in targets}
        if len(named) < max(len(targets), 2):
            shown = quoted(list(targets))
            raise SettingError(f"targets are {shown}; accepted: two to four, of different names")
        if len(named) > _MOST_OBJECTS:
            raise SettingError(f"there are {len(named)} targets; accepted: two to {_MOST_OBJECTS}")
        if given.get("moves"):
            raise SettingError(f"moves is {given['moves']}; accepted: 0, as objects stand still")
        priors = {} if priors is None else priors
        for name in priors:
            require_choice("a name in priors", name, accepted=named)
        self.sessions: dict[str, Session] = {}
        self.objects: dict[str, SceneObject] = {}
        self.margin = 0.0
        self._lock = threading.RLock()
        self._touched = KnownPoints()
        self._given: tuple[int, ...] = ()  # of contacts
        self._model = noise_model(SENSOR_NOISE if noise is None else noise)
        self._pools: dict[tuple[int, frozenset[int]], _Pool] = {}  # of the last registration
        path = None if record is None else Path(record)
        with ExitStack() as opened:  # if one fails, those before it end
            for name, target in named.items():
                own = None if path is None else path.with_name(f"{path.stem}_{name}{path.suffix}")
                session = Session(
                    target,
                    workspace=workspace,
                    record=own,
                    noise=noise,
                    prior=priors.get(name),
                    **given,
                )
                self.sessions[name] = opened.enter_context(session)
            self._open = opened.pop_all()
        self._names = list(self.sessions)
        self._surfaces = [
            surface_points(
                session.started.sdf,
                _SURFACE,
                stream=StreamKey(session.started.seed, 0).stream(Purpose.MESH_SAMPLES),
            )
            for session in self.sessions.values()
        ]

    @property
    def owners(self) -> list[str]:
        """Names of the objects of all contacts, in the order in which they came; "" of none."""
        return ["" if one == NOBODY else self._names[one] for one in self._given]

    def add(self, **what: Any) -> None:
        """Add what became known, see `Session.add`; free space is that of all objects.

        A contact is given to the object that it fits best, and perhaps to another one by the next
        `register`. Known and occupied points, masks of images, and `withdraw` are of one object:
        add them to its session.
        """
        with self._lock:
            for name in ("mask", "occupied", "known", "known_sdf", "withdraw"):
                if what.get(name) is not None:
                    raise PointsError(
                        f"{name} is of one object; accepted: scene.sessions[NAME].add({name}=...)"
                    )
            parts = {name: what.pop(name) for name in _OF_CONTACTS if name in what}
            touched = touched_points(**parts)
            others = any(value is not None for value in what.values())
            if not others and len(touched.known) == 0:
                raise PointsError("nothing was added; accepted: points, a path or a depth image")
            self._check(touched)
            given = self._likeliest(touched)
            with ExitStack() as taken:
                prepared = []
                for number, session in enumerate(self.sessions.values()):
                    own = _arguments(touched.with_known(given == number))
                    if others or own:
                        prepared.append((session, session.prepare(**what, **own)))
                self._touched = self._touched.merged(touched)
                self._given = (*self._given, *given.tolist())
                for session, one in prepared:
                    taken.callback(session.commit, one)  # all of them, whatever one raises

    def register(self) -> dict[str, SceneObject]:
        """Give every contact to an object, and register each that has any, see `objects`."""
        with self._lock:
            if len(self._given) == 0:
                raise PointsError("nothing was touched yet; accepted: a registration after `add`")
            self._pools = {}
            found = list(self._solutions())
            best = min(found, key=lambda one: one.energy)
            others = [one.energy for one in found if one.given != best.given]
            if others:
                self.margin = min(others) - best.energy
            self._give(best.given)
            answers: dict[int, Hypotheses] = {}
            for number, session in enumerate(self.sessions.values()):
                if number in best.given:
                    answers[number] = session.register()
            poses = self._apart(answers)
            self.objects = {
                name: SceneObject(
                    name,
                    np.flatnonzero(np.array(best.given) == number),
                    answer=answers.get(number),
                    world_from_object=poses.get(number),
                )
                for number, name in enumerate(self._names)
            }
            return self.objects

    def next_probe(self, name: str, actions: Actions | None = None) -> NextProbe | None:
        """Return where to touch next, to learn most of one object, see `Session.next_probe`."""
        require_choice("name", name, accepted=self.sessions)
        return self.sessions[name].next_probe(actions)

    def close(self) -> None:
        """End all recordings."""
        self._open.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        self._open.__exit__(*error)

    def _check(self, touched: KnownPoints) -> None:
        """Raise PointsError for contacts that are no object's; warn of those that may not be."""
        if len(touched.known) == 0:
            return
        session = max(self.sessions.values(), key=lambda one: one.started.sdf.diameter)
        session.prepare(**_arguments(touched))
        away = session.started.workspace.distances(touched.known).max()
        if away > MOST_OUTSIDE * session.started.sdf.diameter:
            text = (
                f"a contact is {away:.3g} m outside of the workspace {session.started.workspace}; "
                "check workspace, units and frames"
            )
            warnings.warn(PointsWarning("contacts_outside", text), stacklevel=3)

    def _likeliest(self, touched: KnownPoints) -> IntArray:
        """Return the objects (M,) that new contacts fit best by the last results; NOBODY without.

        NOBODY is the last row of costs, too.
        """
        costs = np.full((len(self._names) + 1, len(touched.known)), np.inf)
        costs[NOBODY] = self._of_nobody
        for number, name in enumerate(self._names):
            one = self.objects.get(name)
            if one is not None and one.answer is not None:
                poses = Poses.of(one.answer.object_from_world)
                costs[number] = self._costs(number, poses, contacts=touched).min(axis=0)
        likeliest = costs.argmin(axis=0)
        return np.where(likeliest == len(self._names), NOBODY, likeliest)

    def _give(self, given: tuple[int, ...]) -> None:
        """Let sessions have the contacts that are theirs, and no others."""
        for number, session in enumerate(self.sessions.values()):
            wanted = np.flatnonzero(np.array(given) == number)
            before = np.flatnonzero(np.array(self._given) == number)
            gone = self._touched.known[np.setdiff1d(before, wanted)]
            same = (session.points.known[:, None] == gone).all(axis=2).any(axis=1)
            new = _arguments(self._touched.with_known(np.setdiff1d(wanted, before)))
            if same.any():
                session.add(withdraw=np.flatnonzero(same), **new)
            elif new:
                session.add(**new)
        self._given = given

    @property
    def _of_nobody(self) -> float:
        """The cost of a contact on none of the objects, nats."""
        return float(np.log(self._model.greatest(np.zeros(1))[0] * EXTENT / SHARE))

    @property
    def _of_fitted(self) -> float:
        """The cost of each of the first contacts of an object beside its distance, nats."""
        return self._of_nobody + float(np.log(SHARE))

    def _solutions(self) -> Iterator[_Joint]:
        """Yield what each start comes to in a round, and what the best of them come to.

        Where the assignment before explained more than others, and now explains more contacts of
        each object than a pose is free to fit, it stands.
        """
        done: dict[tuple[int, ...], _Joint] = {}
        for start in self._starts():
            if start not in done:
                done[start] = self._best(start)
                yield done[start]
            if start == self._given == done[start].given and self._stands(done[start]):
                return
        for joint in sorted(done.values(), key=lambda one: one.energy)[:_GONE_ON_WITH]:
            given = joint.given
            for _ in range(_ROUNDS):
                if given in done:
                    break
                done[given] = self._best(given)
                yield done[given]
                given = done[given].given

    def _stands(self, joint: _Joint) -> bool:
        fewest = min(joint.given.count(number) for number in range(len(self._names)))
        return self.margin > LIMIT and fewest > FREEDOMS and joint.worst < _FITS

    def _starts(self) -> Iterator[tuple[int, ...]]:
        """Yield assignments to begin with.

        They are that before, the same with what is on none given to each object in turn, all on one
        object, and by place.
        """
        count = len(self._names)
        if any(one != NOBODY for one in self._given):
            yield self._given
            for number in range(count):
                yield tuple(number if one == NOBODY else one for one in self._given)
        for number in range(count):
            yield (number,) * len(self._given)
        for groups in range(2, count + 1):
            labels = self._groups(groups)
            for order in permutations(range(count), groups):
                yield tuple(order[label] for label in labels)

    def _groups(self, count: int) -> list[int]:
        """Return labels (M,) of contacts by place: k-means, from contacts far from each other."""
        places = self._touched.known
        middles = places[[0]]
        for _ in range(count - 1):
            away = ((places[:, None] - middles) ** 2).sum(axis=2).min(axis=1)
            middles = np.concatenate([middles, places[[int(np.argmax(away))]]])
        labels = np.zeros(len(places), dtype=int)
        for _ in range(20):
            labels = np.argmin(((places[:, None] - middles) ** 2).sum(axis=2), axis=1)
            for n in np.unique(labels):
                middles[n] = places[labels == n].mean(axis=0)
        return [int(label) for label in labels]

    def _best(self, given: tuple[int, ...]) -> _Joint:
        """Return the best poses for contacts as given, and the best assignment by these poses."""
        present = sorted(set(given) - {NOBODY})
        pools = {
            number: self._pool(
                number, frozenset(np.flatnonzero(np.array(given) == number).tolist())
            )
            for number in present
        }
        chosen = self._combination(pools, given)
        costs = np.full((len(self._names) + 1, len(given)), np.inf)
        costs[NOBODY] = self._of_nobody
        own = 0.0
        for number, at in chosen.items():
            costs[number] = pools[number].costs[at] + self._distant(number, given)
            own += float(pools[number].own[at])
        every = np.arange(len(given))
        kept = costs[np.array(given), every]
        better = costs.argmin(axis=0)
        new = np.where(costs[better, every] < kept - _FEWEST_GAINED, better, np.array(given))
        new[new == len(self._names)] = NOBODY
        overlap = self._overlaps(pools, chosen)
        fitted = sum(min(int((new == number).sum()), FREEDOMS) for number in present)
        energy = float(costs[new, every].sum()) + own + overlap + self._of_fitted * fitted
        worst = float(costs[new, every].max())
        return _Joint(energy, tuple(int(one) for one in new), worst=worst)

    def _combination(self, pools: dict[int, _Pool], given: tuple[int, ...]) -> dict[int, int]:
        """Return the poses of least energy, by object: one after the other, the surest first."""
        totals = {}
        for number, pool in pools.items():
            own = np.array(given) == number
            totals[number] = pool.own + pool.costs[:, own].sum(axis=1)
        chosen: dict[int, int] = {}
        for number in sorted(pools, key=lambda n: -sum(one == n for one in given)):
            total = totals[number].copy()
            for other, at in chosen.items():
                total += self._overlap(pools[number], other, at=pools[other].poses[[at]])
                total += self._overlap_of(number, pools[number], surface=pools[other].surfaces[at])
            chosen[number] = int(np.argmin(total))
        return chosen

    def _overlaps(self, pools: dict[int, _Pool], chosen: dict[int, int]) -> float:
        total = 0.0
        for number, at in chosen.items():
            for other, there in chosen.items():
                if other != number:
                    one = pools[number]._replace(surfaces=pools[number].surfaces[[at]])
                    total += float(self._overlap(one, other, at=pools[other].poses[[there]])[0])
        return total

    def _overlap(self, pool: _Pool, other: int, *, at: Poses) -> FloatArray:
        """Return the costs (B,) of surfaces inside of another object at a pose (1, 12)."""
        sdf = self._sdf(other)
        points = pool.surfaces.reshape(-1, 3)
        depths = -signed_distances(sdf, at, points=points)[0].reshape(len(pool.surfaces), -1)
        return _overlap_cost(depths.max(axis=1))

    def _overlap_of(self, number: int, pool: _Pool, *, surface: FloatArray) -> FloatArray:
        """Return the costs (B,) of another object's surface (S, 3) inside of an object's poses."""
        depths = -signed_distances(self._sdf(number), pool.poses, points=surface)
        return _overlap_cost(depths.max(axis=1))

    def _sdf(self, number: int) -> Any:
        return self.sessions[self._names[number]].started.sdf

    def _distant(self, number: int, given: tuple[int, ...]) -> FloatArray:
        """Return costs (M,), nats, of contacts far from the middle of an object's own."""
        places = self._touched.known
        middle = places[np.array(given) == number].mean(axis=0)
        away = np.sqrt(((places - middle) ** 2).sum(axis=1))
        return 0.5 * (away / (_NEAR * self._sdf(number).diameter)) ** 2

    def _pool(self, number: int, contacts: frozenset[int]) -> _Pool:
        """Return poses of an object that explain these contacts."""
        if (number, contacts) not in self._pools:
            session = self.sessions[self._names[number]]
            chosen = self._touched.with_known(sorted(contacts))
            problem = self._problem(session, self._beside(session).merged(chosen))
            found = session.method.register(problem, NullObserver())
            poses = Poses.of(found.object_from_world[~found.duplicate])
            own = self._own(session, poses)
            surfaces = apply(poses.world_from_object, self._surfaces[number])
            self._pools[number, contacts] = _Pool(
                poses,
                self._costs(number, poses, contacts=self._touched),
                own=own,
                surfaces=surfaces,
            )
        return self._pools[number, contacts]

    def _beside(self, session: Session) -> KnownPoints:
        """Return the points of a session that are no contacts of the scene, such as free ones."""
        known = session.points.known
        touched = (known[:, None] == self._touched.known).all(axis=2).any(axis=1)
        return session.points.with_known(~touched)

    def _own(self, session: Session, poses: Poses) -> FloatArray:
        """Return the energies (B,) of poses by prior and points but the contacts, nats."""
        beside = self._beside(session)
        if beside.count:
            return pose_energies(self._problem(session, beside), poses, noise=self._model)
        started = session.started
        none = np.zeros(len(poses))
        return none if started.prior is None else started.prior.energies(poses, started.sdf)

    def _problem(self, session: Session, points: KnownPoints) -> RegistrationProblem:
        started = session.started
        return posed_problem(
            started.sdf,
            points,
            workspace=started.workspace,
            free_resolution=started.free_resolution,
            key=StreamKey(started.seed, max(session.step, 0)),
            settings=session.method.online,
            prior=started.prior,
        )

    def _costs(self, number: int, poses: Poses, *, contacts: KnownPoints) -> FloatArray:
        """Return costs (B, M), nats, of contacts (M,) that are on an object, in its poses (B,)."""
        model, sdf = self._model, self._sdf(number)
        residuals = signed_distances(sdf, poses, points=contacts.known)
        density = (model.densities(residuals) * np.array(model.weights)).sum(axis=-1)
        if contacts.has_normals:
            posed: PosedNormals = posed_normals(sdf, contacts, poses=poses)
            variances = model.normal_variances(posed.noise)
            density = density * normal_factors(variances, posed.cosines)
        peak = float(model.greatest(np.zeros(1))[0])
        return np.asarray(np.log(peak / np.maximum(density, SHARE / EXTENT * 1e-3)))

    def _apart(self, answers: dict[int, Hypotheses]) -> dict[int, FloatArray]:
        """Return the best pose of each object beside those of the others, world_from_object."""
        pools = {}
        for number, answer in answers.items():
            poses = Poses.of(answer.object_from_world[~answer.duplicate])
            surfaces = apply(poses.world_from_object, self._surfaces[number])
            session = self.sessions[self._names[number]]
            own = pose_energies(self._problem(session, session.points), poses, noise=self._model)
            none = np.zeros((len(own), 0))
            pools[number] = _Pool(poses, none, own=own, surfaces=surfaces)
        chosen = self._combination(pools, ())
        return {n: pools[n].poses[[at]].world_from_object[0] for n, at in chosen.items()}


def _arguments(contacts: KnownPoints) -> dict[str, Any]:
    """Return contacts as `Session.add` takes them; nothing for none."""
    if len(contacts.known) == 0:
        return {}
    if not contacts.has_normals:
        return {"contacts": contacts.known}
    noise = contacts.normal_noise
    return {"contacts": contacts.known, "normals": contacts.normals, "normal_noise": noise}


def _overlap_cost(depths: FloatArray) -> FloatArray:
    """Return costs (B,) of depths (B,) of one object inside another, metres, nats."""
    return np.minimum(0.5 * (np.maximum(depths, 0.0) / _OVERLAP) ** 2, _MOST_OVERLAP)
