"""Registration again and again while points become known: the loop of CHSEL, Alg. 2."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from chsel.problem.points import GrowingPoints, KnownPoints, Workspace
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from chsel.problem.warm_start import OnlineSettings, pose_problem


class Start(NamedTuple):
    """When the first registration is possible."""

    contacts: int = 0  # at least so many are known
    step: int = 0  # not before this step


_AT_ONCE = Start()


@dataclass(frozen=True, eq=False)
class OnlineStep:
    """One pass through the loop of `OnlineRegistration.steps`."""

    step: int
    problem: RegistrationProblem | None = None  # None if nothing was to be registered
    hypotheses: Hypotheses | None = None  # None if nothing was registered
    failure: Exception | None = None  # of posing or registering the problem, if it was to be caught


class OnlineRegistration:
    """Registers an object that does not move after every change of its known points.

    sdf: of the object. points: all that are known, in the world. previous: the result that the
    next problem follows from; None before the first.
    """

    def __init__(
        self,
        sdf: SdfGrid,
        workspace: Workspace,
        free_resolution: float,
        settings: OnlineSettings,
        *,
        seed: int = 0,
        points: KnownPoints | None = None,
        previous: Hypotheses | None = None,
        start: Start = _AT_ONCE,
        only: Container[int] | None = None,
    ) -> None:
        """settings: how E_0 and E_l follow from the result before, `method.online` of a method.

        free_resolution: voxel side of free space, metres. seed: of the random streams of all
        steps. points: known before the first step. only: steps that register; None for all.
        """
        self.sdf, self._workspace, self._free_resolution = sdf, workspace, free_resolution
        self._settings, self._seed = settings, seed
        self._start, self._only = start, only
        self.points = GrowingPoints(points or KnownPoints())
        self.previous = previous

    def steps(
        self,
        perceived: Iterable[tuple[int, KnownPoints]],
        register: Callable[[RegistrationProblem], Hypotheses | None] | None = None,
        catch: type[Exception] | tuple[type[Exception], ...] = (),
    ) -> Iterator[OnlineStep]:
        """Algorithm 2; yields after every step, whether or not it registered.

        perceived: steps in ascending order with the points that are new in each, such as
        enumerate(points). register: finds E, such as `method.register`, or None where it finds
        nothing to remember; without it problems are posed only, and `remember` takes results from
        elsewhere. catch: errors of a step that do not end the loop; the next problem then follows
        from the last result that there was.
        """
        for step, new_points in perceived:
            self.points.add(new_points)  # X <- perceived from environment
            problem = hypotheses = failure = None
            if self.enough(step):
                try:
                    problem = self.pose(step)  # with E_0 and E_l
                    if register is not None:
                        hypotheses = register(problem)  # E <- CHSEL(X, E_0, E_l)
                except catch as error:
                    failure = error
            if hypotheses is not None:
                self.remember(hypotheses)
            yield OnlineStep(step, problem, hypotheses, failure)

    def enough(self, step: int) -> bool:
        """Whether a step registers, with the points that are known."""
        chosen = self._only is None or step in self._only
        started = step >= self._start.step and self.points.contacts >= self._start.contacts
        return chosen and started and self.points.count > 0

    def pose(self, step: int) -> RegistrationProblem:
        """The problem of a step: all known points, E_0 and E_l from the result before.

        Raises PoseError if that result has no poses or some that are not finite, and SettingError
        if no point is known.
        """
        return pose_problem(
            self.sdf,
            self.points.all(),
            self._workspace,
            self._free_resolution,
            StreamKey(self._seed, step),
            self._settings,
            self.previous,
        )

    def remember(self, hypotheses: Hypotheses) -> None:
        """Let the next problem follow from this result."""
        self.previous = hypotheses
