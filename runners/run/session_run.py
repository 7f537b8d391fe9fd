"""A session from its first probe to its last: Algorithm 2, recorded."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from chsel.errors import ChselError, InputWarning
from chsel.methods import noise_of
from chsel.methods.method import Method
from chsel.numerics.arrays import FloatArray
from chsel.plausible.symmetry import ObjectSymmetry
from chsel.policies.steering import Steering
from chsel.problem.online_registration import OnlineRegistration, OnlineStep
from chsel.problem.points import KnownPoints, check_contacts, check_points
from chsel.problem.poses import inverse
from chsel.problem.registration_problem import Hypotheses, RegistrationProblem, Trust
from chsel.problem.trust import check_trust
from replay.events import ActionsOffered, Decided, Logged, Probe, ProblemPosed, Recorder, Timed
from replay.registration import Registered, register_recorded
from runners.run.recording import RecordingConfig
from runners.sessions.session import Session, SessionEvent, Steerable

Row = dict[str, Any]
FROM_SESSION = "session"
"""The code of warnings that the session itself gives."""


@dataclass(frozen=True)
class StepWarning:
    """What a person should know about the input, as the summary has it."""

    step: int  # the probe at which it first holds
    code: str  # the kind of warning
    text: str  # one line


class SessionRun:
    """Walks the loop of an `OnlineRegistration` over a session, and records every step.

    step: of the last probe. warnings: so far. registered: what the method gave in that step, None
    without a registration. failure: why it gave nothing, "" if nothing failed. trust: how far to
    trust the last result, None before the first.
    """

    def __init__(
        self,
        session: Session,
        online: OnlineRegistration,
        method: Method,
        recorder: Recorder,
        *,
        symmetry: ObjectSymmetry | None,
        recording: RecordingConfig,
        show: Callable[[str, int, int], None],
        opening: Iterable[InputWarning] = (),
        steering: Steering | None = None,
    ) -> None:
        """symmetry: of the object, for errors to the true pose; None where that is not known.

        opening: warnings that are recorded with the first probe. steering: chooses the probes of a
        session that can be steered; None for the session's own order.
        """
        self._session, self._online, self._method = session, online, method
        self._recorder, self._recording = recorder, recording
        self._symmetry, self._show = symmetry, show
        self._opening = tuple(opening)
        self.steering = steering
        self.step = 0
        self.warnings: list[StepWarning] = []
        self.registered: Registered | None = None
        self.failure = ""
        self.trust: Trust | None = None

    def steps(
        self,
        register: Callable[[RegistrationProblem], Hypotheses | None] | None = None,
        catch: type[Exception] | tuple[type[Exception], ...] = (),
    ) -> Iterator[tuple[OnlineStep, Row]]:
        """Each step with the row of numbers that is shown and summarised about it.

        register: by default `register` of this run. catch: see `OnlineRegistration.steps`.
        """
        if self.steering is not None:
            self._recorder.record(ActionsOffered(-1, self.steering.actions, self.steering.hand))
            self._decide(-1, self.steering)
            self._recorder.flush()
        for step in self._online.steps(self._perceived(), register or self.register, catch):
            if step.failure is not None:
                self.failed(step.step, step.failure)
            row: Row = {
                "step": step.step,
                "outcome": self._outcome,
                "contacts": len(self._online.points.contacts),
                "free_points": len(self._online.points.free),
            }
            if step.problem is not None and self.registered is not None:
                row |= self._numbers(self.registered)
            if self.steering is not None:
                row |= self._decide(step.step, self.steering)
            text = f"probe {step.step}: {row['outcome']}, {row['contacts']} contacts"
            if "digest" not in row:
                text += ", too little for a registration"
            text += f"; {self.trust}" if "verdict" in row else ""
            self._recorder.record(Logged(step.step, "info", text))
            if self._recording.timings:
                self._recorder.record(Timed(step.step, self._seconds))
            self._recorder.flush()
            row |= {"seconds": sum(self._seconds.values()), "seconds_by_stage": self._seconds}
            yield step, row
        self._check_points()
        self._warn(check_contacts(self._online.points))
        self._recorder.flush()

    def _numbers(self, registered: Registered) -> Row:
        """Numbers about a registration; its trust is that of the session so far."""
        found, trust = registered.hypotheses, registered.hypotheses.trust
        row: Row = {"best_cost": float(found.cost[0])} if len(found.cost) else {}
        row |= {"distinct": found.distinct, "digest": found.digest, **registered.numbers}
        row["registration_seconds"] = registered.total_seconds
        if trust is not None:
            self._warn(check_trust(trust, noise_of(self._method)))
            self.trust, row["verdict"] = trust, trust.verdict
            modes = inverse(found.object_from_world[[*trust.best_of_modes]]).tolist()
            row |= {"world_from_object": modes[0], "modes_world_from_object": modes}
        return row

    def register(self, problem: RegistrationProblem) -> Hypotheses:
        """Check the points, register the problem by the run's method, and record it."""
        self._check_points()
        self.registered = register_recorded(
            ProblemPosed(problem.key.step, problem),
            self._method,
            self._recorder,
            self._session.world_from_object,
            self._symmetry,
            snapshot_interval=self._recording.snapshot_interval,
            show=self._show,
        )
        self._seconds |= self.registered.seconds
        return self.registered.hypotheses

    def failed(self, step: int, error: Exception) -> None:
        """Record why a step has no result."""
        self.failure = one_line(error)
        self._recorder.record(Logged(step, "warning", f"no result: {self.failure}"))

    def _perceived(self) -> Iterator[tuple[int, KnownPoints, FloatArray | None]]:
        """Record what the session yields, and hand on the new points of its probes."""
        begun = time.perf_counter()
        for event in self._events():
            self._recorder.record(event)
            if isinstance(event, Logged) and event.level == "warning":
                self.warnings.append(StepWarning(event.step, FROM_SESSION, event.text))
            if isinstance(event, Probe):
                self.step, self._outcome = event.step, event.outcome
                self.registered, self.failure = None, ""
                self._warn(self._opening)
                self._seconds = {"probe": time.perf_counter() - begun}
                if self.steering is not None and self.steering.felt(event.contacts):
                    self._online.start_afresh(self.steering.policy.settings.surprise.larger)
                yield event.step, event.new_points, event.push
                begun = time.perf_counter()

    def _events(self) -> Iterator[SessionEvent]:
        """What the session yields, in its own order or as it is steered."""
        if self.steering is None:
            yield from self._session.probes()
            return
        assert isinstance(self._session, Steerable)
        step = 0
        while self.steering.last is not None and self.steering.last.decision.chosen >= 0:
            yield from self._session.take(step, self.steering.last.decision.chosen)
            step += 1

    def _decide(self, step: int, steering: Steering) -> Row:
        """Choose what follows a step, and record it; numbers about the choice."""
        assert isinstance(self._session, Steerable)
        begun, before = time.perf_counter(), steering.last
        points, found = self._online.points, self._online.previous
        problem, decision = steering.decide(step + 1, points, found, self._session.available())
        seconds = time.perf_counter() - begun
        if step >= 0:
            self._seconds["decision"] = seconds
        self._recorder.record(Decided(step, problem, decision, steering.surprise))
        row: Row = {"spread": decision.spread, "stop": decision.stop, "surprise": steering.surprise}
        if before is not None:
            chosen = before.decision.chosen
            row["action"] = chosen
            row["hit_chance"] = float(before.decision.hit_chance[chosen])
            row["expected_spread"] = float(before.decision.expected_spread[chosen])
        return row

    def _check_points(self) -> None:
        """Warn about points known so far; PointsError if they cannot be the object's."""
        workspace, resolution = self._session.workspace, self._session.free_resolution
        points, diameter = self._online.points, self._online.sdf.diameter
        self._warn(check_points(points, diameter, resolution, workspace))

    def _warn(self, found: Iterable[InputWarning]) -> None:
        """Record warnings, each kind once a session."""
        for warning in found:
            if warning.code not in {earlier.code for earlier in self.warnings}:
                self.warnings.append(StepWarning(self.step, warning.code, warning.text))
                self._recorder.record(Logged(self.step, "warning", warning.text))


def one_line(error: BaseException) -> str:
    """The text of an error, with its class if it is none of ours."""
    text = " ".join(str(error).split())
    return text if isinstance(error, ChselError) else f"{type(error).__name__}: {text}"
