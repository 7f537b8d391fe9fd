"""A session from its first probe to its last: probe, register, record."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from chsel.errors import InputWarning
from chsel.methods import noise_of
from chsel.methods.method import Method
from chsel.plausible.symmetry import ObjectSymmetry
from chsel.problem.input_checks import check_contacts, check_fit, check_points
from chsel.problem.points import GrowingPoints
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem
from chsel.problem.sdf_grid import SdfGrid
from chsel.problem.streams import StreamKey
from chsel.problem.warm_start import pose_problem
from replay.events import (
    Logged,
    Probe,
    ProblemPosed,
    Recorder,
    Timed,
)
from replay.registration import register_recorded
from runners.recording import RecordingConfig
from runners.sessions.session import Session
from runners.step_warning import FROM_SESSION, StepWarning

Row = dict[str, Any]


class SessionRun:
    """Registers after every probe for which there is enough to go by (CHSEL, Alg. 2)."""

    def __init__(
        self,
        session: Session,
        method: Method,
        sdf: SdfGrid,
        recorder: Recorder,
        *,
        symmetry: ObjectSymmetry | None,
        seed: int,
        start: tuple[int, int],
        recording: RecordingConfig,
        show: Callable[[str, int, int], None],
        opening: Iterable[InputWarning] = (),
    ) -> None:
        """symmetry: of the object, for errors to the true pose; None where that is not known.

        start: a registration needs so many contacts, and this probe index. opening: warnings about
        what was opened, which are recorded with the first probe.
        """
        self._session, self._method, self._sdf, self._recorder = session, method, sdf, recorder
        self._symmetry, self._seed = symmetry, seed
        self._start = start
        self._snapshot_interval = recording.snapshot_interval
        self._timings = recording.timings
        self._show = show
        self._points = GrowingPoints(session.initial_points)
        self.previous: Hypotheses | None = None
        self.step = 0
        self.warnings: list[StepWarning] = []
        self._opening = tuple(opening)

    def steps(self) -> Iterator[tuple[Probe, Row]]:
        """Each probe with the row of numbers that is shown and summarised about it."""
        begun = time.perf_counter()
        for event in self._session.probes():
            self._recorder.record(event)
            if isinstance(event, Logged) and event.level == "warning":
                self.warnings.append(StepWarning(event.step, FROM_SESSION, event.text))
            if not isinstance(event, Probe):
                continue
            probe = event
            self.step = probe.step
            self._warn(self._opening)
            seconds = {"probe": time.perf_counter() - begun}
            self._points.add(probe.new_points)
            row: Row = {
                "step": probe.step,
                "outcome": probe.outcome,
                "contacts": self._points.contacts,
                "free_points": self._points.free,
            }
            if self._enough(probe):
                row |= self._register(probe.step, seconds)
            self._recorder.record(Logged(probe.step, "info", _line(row)))
            if self._timings:
                self._recorder.record(Timed(probe.step, seconds))
            self._recorder.flush()
            row |= {"seconds": sum(seconds.values()), "seconds_by_stage": seconds}
            yield probe, row
            begun = time.perf_counter()
        self._check_points()
        self._warn(check_contacts(self._points.all()))
        self._recorder.flush()

    def _enough(self, probe: Probe) -> bool:
        contacts, index = self._start
        known = self._points
        return known.contacts >= contacts and probe.step >= index and known.count > 0

    def _register(self, step: int, seconds: dict[str, float]) -> Row:
        """Check the points, pose the problem, register, and record; numbers about the result."""
        self._check_points()
        problem = self._pose(step, self.previous)
        registered = register_recorded(
            ProblemPosed(step, problem),
            self._method,
            self._recorder,
            self._session.world_from_object,
            self._symmetry,
            snapshot_interval=self._snapshot_interval,
            show=self._show,
        )
        seconds |= registered.seconds
        found = self.previous = registered.hypotheses
        self._warn(check_fit(problem, found, noise_of(self._method)))
        row = {"best_cost": float(found.cost[0]), "distinct": found.distinct}
        return row | {"digest": found.digest} | dict(registered.numbers)

    def _check_points(self) -> None:
        """Warn about points known so far; PointsError if they cannot be the object's."""
        workspace, resolution = self._session.workspace, self._session.free_resolution
        self._warn(check_points(self._points.all(), self._sdf.diameter, resolution, workspace))

    def _warn(self, found: Iterable[InputWarning]) -> None:
        """Record warnings, each kind once a session."""
        for warning in found:
            if warning.code not in {earlier.code for earlier in self.warnings}:
                self.warnings.append(StepWarning(self.step, warning.code, warning.text))
                self._recorder.record(Logged(self.step, "warning", warning.text))

    def _pose(self, step: int, previous: Hypotheses | None) -> RegistrationProblem:
        """What is to be registered at a step, after the result of the one before."""
        return pose_problem(
            self._sdf,
            self._points.all(),
            self._session.workspace,
            self._session.free_resolution,
            StreamKey(self._seed, step),
            self._method.online,
            previous,
        )


def _line(row: Row) -> str:
    """What the recording's log says about a probe; results speak for themselves."""
    text = f"probe {row['step']}: {row['outcome']}, {row['contacts']} contacts"
    return text if "best_cost" in row else f"{text}, too little for a registration"
