"""A session from its first probe to its last: probe, register, record."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from chsel.methods.method import Method
from chsel.online import pose_problem
from chsel.points import GrowingPoints
from chsel.problem import Hypotheses, RegistrationProblem
from chsel.sdf import SdfGrid
from chsel.streams import StreamKey
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
        seed: int,
        start: tuple[int, int],
        recording: RecordingConfig,
        show: Callable[[str, int, int], None],
    ) -> None:
        """start: a registration needs so many contacts, and this probe index."""
        self._session, self._method, self._sdf, self._recorder = session, method, sdf, recorder
        self._seed = seed
        self._start = start
        self._snapshot_interval = recording.snapshot_interval
        self._timings = recording.timings
        self._show = show
        self._points = GrowingPoints(session.initial_points)
        self.previous: Hypotheses | None = None
        self.step = 0

    def steps(self) -> Iterator[tuple[Probe, Row]]:
        """Each probe with the row of numbers that is shown and summarised about it."""
        begun = time.perf_counter()
        for event in self._session.probes():
            self._recorder.record(event)
            if not isinstance(event, Probe):
                continue
            probe = event
            self.step = probe.step
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

    def _enough(self, probe: Probe) -> bool:
        contacts, index = self._start
        known = self._points
        return known.contacts >= contacts and probe.step >= index and known.count > 0

    def _register(self, step: int, seconds: dict[str, float]) -> Row:
        """Pose the problem, register, and record both; numbers about the result."""
        problem = self._pose(step, self.previous)
        registered = register_recorded(
            ProblemPosed(step, problem),
            self._method,
            self._recorder,
            self._session.world_from_object,
            snapshot_interval=self._snapshot_interval,
            show=self._show,
        )
        seconds |= registered.seconds
        found = self.previous = registered.hypotheses
        row = {"best_cost": float(found.cost[0]), "distinct": found.distinct}
        return row | {"digest": found.digest} | dict(registered.numbers)

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
