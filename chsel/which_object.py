"""Which of several objects it is: all are registered, and compared by how well they fit."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from chsel.errors import SettingError, quoted
from chsel.next_probe.decision_problem import Actions
from chsel.problem.noise import LIMIT, noise_model
from chsel.problem.pose_prior import PosePrior
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import Hypotheses
from chsel.problem.trust import SENSOR_NOISE, pose_energies
from chsel.session.session import NextProbe, Session

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, eq=False)
class Candidate:
    """One of the objects, and how well it fits."""

    name: str
    energy: float  # nats, of its best hypothesis: the lowest is the likeliest object
    alive: bool  # whether the points do not speak against it
    answer: Hypotheses


class WhichObject:
    """Sessions of several objects that share what is added.

    sessions: by name. candidates: at the last registration, the likeliest first.
    """

    def __init__(
        self,
        targets: Mapping[str, trimesh.Trimesh] | Sequence[str | Path],
        *,
        record: str | Path | None = None,
        noise: float | None = None,
        **given: Any,
    ) -> None:
        """Open a session for each object.

        targets: meshes by name, or paths, whose stems are the names. record: a new file NAME.mcap;
        each object has its own, NAME_OBJECT.mcap. noise, given: the same for all, see
        `chsel.Session`; a prior is of the objects' centres, or of one axis of all their frames.
        Raises SettingError for fewer than two, two of one name, and a prior on a single object.
        """
        named = targets if isinstance(targets, Mapping) else {Path(t).stem: t for t in targets}
        if len(named) < max(len(targets), 2):
            shown = quoted(list(targets))
            raise SettingError(f"targets are {shown}; accepted: two or more, of different names")
        prior = given.get("prior")
        for part in ("point", "object_from_world"):
            if isinstance(prior, PosePrior) and getattr(prior, part) is not None:
                raise SettingError(
                    f"prior has {part}, which is of one object; accepted: centre, without a point, "
                    "or axis"
                )
        self.sessions: dict[str, Session] = {}
        self._lock = threading.RLock()
        self.candidates: list[Candidate] = []
        self._offered: Actions | None = None
        self._taken: set[int] = set()  # of these
        self._noise = SENSOR_NOISE if noise is None else noise
        path = None if record is None else Path(record)
        with ExitStack() as opened:  # if one fails, those before it end
            for name, target in named.items():
                own = None if path is None else path.with_name(f"{path.stem}_{name}{path.suffix}")
                session = Session(target, record=own, noise=noise, **given)
                self.sessions[name] = opened.enter_context(session)
            self._open = opened.pop_all()
        smallest = min(session.started.sdf.diameter for session in self.sessions.values())
        for session in self.sessions.values():
            session.intake.diameter = smallest

    def add(self, **what: Any) -> None:
        """Add what became known to all, or to none, see `Session.add`."""
        sessions = self.sessions.values()
        with self._lock, ExitStack() as taken:
            prepared = [session.prepare(**what) for session in sessions]
            for session, one in zip(sessions, prepared, strict=True):
                taken.callback(session.commit, one)  # all of them, whatever one raises

    def register(self) -> list[Candidate]:
        """Register every object; the likeliest first.

        Energies are those of `chsel.problem.noise`, at one noise for all.
        """
        found = []
        for name, session in self.sessions.items():
            answer = session.register()
            assert session.problem is not None
            poses = Poses.of(answer.object_from_world[np.isfinite(answer.cost)])
            problem = session.problem.carried(answer.push_distance)
            energies = pose_energies(problem, poses, noise=noise_model(self._noise))
            found.append((float(energies.min(initial=np.inf)), name, answer))
        least = min(energy for energy, *_ in found)
        found.sort(key=lambda one: one[0])
        self.candidates = [
            Candidate(name, energy, alive=energy <= least + LIMIT, answer=answer)
            for energy, name, answer in found
        ]
        return self.candidates

    def next_probe(self, actions: Actions | None = None) -> NextProbe | None:
        """Return where to touch next, by the likeliest object, see `Session.next_probe`."""
        if not self.candidates:
            raise SettingError("nothing is registered; accepted: `register` before `next_probe`")
        session = self.sessions[self.candidates[0].name]
        offered = self._offered if actions is None else actions
        offered = session.actions() if offered is None else offered
        if self._offered is None or offered.digest != self._offered.digest:
            self._offered = offered
            self._taken = set()
        probe = session.next_probe(offered, without=self._taken)
        if probe is not None:
            self._taken.add(probe.action)
        return probe

    def close(self) -> None:
        """End all recordings."""
        self._open.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        self._open.__exit__(*error)
