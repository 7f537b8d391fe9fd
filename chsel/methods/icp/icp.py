"""ICP of the contacts against points of the object's surface: the paper's weak baseline."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from chsel.errors import (
    SettingError,
    require_at_most,
    require_choice,
    require_positive,
)
from chsel.methods.icp.icp_kernels import Matches, iterate, matches_for, rms_distances
from chsel.numerics.arrays import BoolArray, FloatArray
from chsel.numerics.threads import require_ieee_arithmetic, spread
from chsel.problem.online_registration import OnlineSettings
from chsel.problem.poses import Poses
from chsel.problem.registration_problem import (
    Hypotheses,
    NullObserver,
    Observer,
    RegistrationProblem,
)
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.settings import Presets
from chsel.problem.streams import Purpose, StreamKey
from chsel.problem.surface import surface_points
from chsel.qd.selection import ranked

MOST_ITERATIONS = 1_000_000
MOST_POINTS = 1_000_000
_BLOCK = 10  # iterations between words to the observer


@dataclass(frozen=True)
class IcpSettings:
    """All settings of ICP.

    surface_points: Q, how many points stand for the object's surface. redraw: they are new for
    every "registration", or the same all "session", as its seed has them. iterations: at most.
    stop_below: end when the rms distance of no start falls by more than this fraction in an
    iteration; None: never end early.

    The paper's surface points are redrawn, those of its authors' code are not. Ours stay for a
    session, so that a change of the result comes from a new contact and not from new points; on
    51 simulated sessions neither choice came out ahead.
    """

    surface_points: int = 500
    redraw: str = "session"
    iterations: int = 100
    stop_below: float | None = 1e-6
    online: OnlineSettings = field(default_factory=OnlineSettings)

    presets: ClassVar[Presets] = {"paper": {"redraw": "registration"}}

    def __post_init__(self) -> None:
        require_positive("surface_points", self.surface_points)
        require_at_most("surface_points", self.surface_points, MOST_POINTS)
        require_choice("redraw", self.redraw, ("registration", "session"))
        require_positive("iterations", self.iterations, zero=True)
        require_at_most("iterations", self.iterations, MOST_ITERATIONS)
        if self.stop_below is not None and not 0.0 <= self.stop_below < 1.0:
            raise SettingError(
                f"stop_below is {self.stop_below}; accepted: from 0 to less than 1, or null"
            )


class Icp:
    """Registers the contacts by point-to-point ICP from every pose of E_0; E_l is not used.

    Free, occupied and felt points play no part. Costs are rms distances in metres of the contacts
    to the surface points nearest to them: not to be compared with those of the relaxed cost.
    Without any contact there is nothing to fit, and E_0 is what comes back, at cost 0.
    """

    def __init__(self, settings: IcpSettings | None = None) -> None:
        self.settings = settings or IcpSettings()

    @property
    def online(self) -> OnlineSettings:
        """How a session makes the next problem."""
        return self.settings.online

    def register(
        self, problem: RegistrationProblem, observer: Observer | None = None
    ) -> Hypotheses:
        """Hypotheses for the contacts of a problem, best first."""
        require_ieee_arithmetic()
        observer = observer or NullObserver()
        contacts, poses = problem.points.contacts, Poses.of(problem.initial_set)
        if len(contacts) == 0:
            return ranked(problem.initial_set, np.zeros(len(poses)))
        cloud = _Cloud(contacts, self.surface(problem))
        observer.trace("icp", 0, poses.vectors, cloud.distances(poses))
        poses = self._iterated(cloud, poses, observer)
        return ranked(poses.matrices, cloud.distances(poses))

    def surface(self, problem: RegistrationProblem) -> FloatArray:
        """The points (Q, 3) of the object, in its frame, that a registration goes by."""
        key, count = problem.key, self.settings.surface_points
        if self.settings.redraw == "registration":
            return _drawn(problem.sdf, count, key)
        key = StreamKey(key.seed, 0)
        return problem.sdf.derived(("icp", count, key), lambda: _drawn(problem.sdf, count, key))

    def _iterated(self, cloud: _Cloud, poses: Poses, observer: Observer) -> Poses:
        """Poses after as many iterations as the stop rule lets happen."""
        total = self.settings.iterations
        errors = np.full(len(poses), np.inf)
        for first in range(0, total, _BLOCK):
            history, after = cloud.iterated(poses, min(_BLOCK, total - first))
            still = self._gaining(np.concatenate([errors[None], after]))
            count = len(still) if still.all() else int(np.argmin(still)) + 1
            poses, errors = Poses(history[count - 1]), after[count - 1]
            observer.trace("icp", first + count, poses.vectors, errors.copy())
            observer.progress("icp", first + count, total)
            if not still.all():
                break
        return poses

    def _gaining(self, errors: FloatArray) -> BoolArray:
        """Whether the error of any start falls enough in each iteration (K,), of K + 1 (., B)."""
        stop_below = self.settings.stop_below
        if stop_below is None:
            return np.ones(len(errors) - 1, dtype=bool)
        falls: BoolArray = errors[1:] < (1.0 - stop_below) * errors[:-1]
        return np.logical_or.reduce(falls, axis=1)


class _Cloud:
    """Contacts (N, 3) in the world and the model's points (Q, 3), as the kernels take them."""

    def __init__(self, contacts: FloatArray, model: FloatArray) -> None:
        self._contacts, self._model = contacts.T.copy(), model.T.copy()

    def iterated(self, poses: Poses, count: int) -> tuple[FloatArray, FloatArray]:
        """Poses (K, B, 12) after each of K iterations, and errors (K, B); see iterate."""
        history, errors = np.empty((count, len(poses), 12)), np.empty((count, len(poses)))

        def run(first: int, last: int, matches: Any) -> None:
            iterate(
                self._contacts, self._model, poses.numbers, history, errors, first, last, matches
            )

        spread(run, len(poses), self._matches)
        return history, errors

    def distances(self, poses: Poses) -> FloatArray:
        """The rms distances (B,) of the contacts to the model under poses."""
        out = np.empty(len(poses))

        def run(first: int, last: int, matches: Any) -> None:
            rms_distances(self._contacts, self._model, poses.numbers, out, first, last, matches)

        spread(run, len(poses), self._matches)
        return out

    def _matches(self) -> Matches:
        return matches_for(self._contacts.shape[1])


def _drawn(sdf: SdfGrid, count: int, key: StreamKey) -> FloatArray:
    return surface_points(sdf, count, key.stream(Purpose.ICP_SURFACE))
