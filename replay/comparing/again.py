"""The registrations and decisions of a recorded session, made again."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from chsel.errors import ChselError
from chsel.events import (
    ActionsOffered,
    Decided,
    Event,
    HypothesesFound,
    ListRecorder,
    Logged,
    Measured,
    Probe,
    ProblemPosed,
    SnapshotTaken,
    Traced,
)
from chsel.methods.method import Method
from chsel.policies.steering import Choice, Steering
from chsel.problem.online_registration import OnlineRegistration
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses
from chsel.registration import register_recorded, symmetry_for_errors
from replay.comparing.choices import recorded_method, recorded_policy
from replay.mcap.reader import Recording
from replay.mcap.recovery import tells_loss

_RESULTS = (SnapshotTaken, Traced, HypothesesFound, Measured)  # of a registration
_KEPT = (ProblemPosed, HypothesesFound)  # what is compared where others may be lost


@dataclass(frozen=True, eq=False)
class Again:
    """A registration or decision as it was recorded, and today's."""

    name: str  # of the method or policy
    recorded: Sequence[Event]  # ProblemPosed and what follows from it, or one Decided
    # The same kinds; none where a recorded registration has no result.
    today: list[Event] = field(default_factory=list)
    failure: str = ""  # what ended it today
    seconds: Mapping[str, float] = field(default_factory=dict)  # of registering, by stage

    @property
    def step(self) -> int:
        """Of the problem, or that the decision follows."""
        return self.recorded[0].step

    @property
    def is_decision(self) -> bool:
        """Whether it is one, else a registration."""
        return isinstance(self.recorded[0], Decided)

    @property
    def result(self) -> Hypotheses | None:
        """Today's hypotheses."""
        return result_in(self.today)


def result_in(events: Sequence[Event]) -> Hypotheses | None:
    """The hypotheses among events."""
    return next((e.hypotheses for e in events if isinstance(e, HypothesesFound)), None)


def made_again(
    recording: Recording, steps: Container[int] | None = None, *, anew: bool = False
) -> Iterator[Event | Again]:
    """All events of a session in their order, with an Again in place of each result.

    steps: whose results are made again; None for all. anew: whether each follows from today's
    results before it, as in a new session, and errors are raised; else from the recorded ones, and
    images are left out. Raises RecordingError if the recording does not have the settings of its
    method or policy.
    """
    session = _SessionAgain(recording, steps, anew)
    group: list[Event] = []
    for event in recording.events(images=anew):
        if group and isinstance(event, (*_RESULTS, Logged)):
            group.append(event)
            continue
        yield from session.registered(group)
        group = []
        if isinstance(event, ProblemPosed):
            group = [event]
        elif isinstance(event, Decided):
            yield from session.decided(event)
        else:
            session.perceived(event)
            yield event
    yield from session.registered(group)


def recorded_online(recording: Recording, method: Method) -> OnlineRegistration:
    """The loop that a recorded session walks with a method, before its first step."""
    start = recording.start
    return OnlineRegistration(
        start.sdf,
        start.workspace,
        start.free_resolution,
        method.online,
        seed=recording.seed,
        points=start.initial_points,
    )


def snapshot_interval(snapshots: Sequence[ArchiveSnapshot]) -> int:
    """Iterations between recorded snapshots; 0 if there are the first and the last alone."""
    iterations = sorted({archive.iteration for archive in snapshots})
    return iterations[1] if len(iterations) > 2 else 0


class _SessionAgain:
    """Where a session stands that is made again."""

    def __init__(self, recording: Recording, steps: Container[int] | None, anew: bool) -> None:
        self._recording, self._steps, self._anew = recording, steps, anew
        method = recorded_method(recording)
        self._name, self._method = method.name, method.build()
        self._online = recorded_online(recording, self._method)
        self._lost = bool(recording.start.source)  # whether E_0 and E_l follow from other results
        # Today's last result, which is not known where it was not made again.
        self._result: Hypotheses | None = None
        self._result_known = True
        self._verdict = ""  # on it
        self._surprise: float | None = 0.0  # of the last probe, None if it cannot be known
        self._before: Decided | None = None
        self._truth = recording.start.world_from_object
        if recording.offered is not None:
            self._policy = recorded_policy(recording)

    def perceived(self, event: Event) -> None:
        """Take note of losses, of new points, and of an outcome that surprises."""
        self._lost = self._lost or tells_loss(event)
        if isinstance(event, ActionsOffered):
            start = self._recording.start
            given = (start.sdf, start.workspace, start.free_resolution)
            self._steering = Steering(self._policy.build(), *given, event.actions, event.hand)
        if not isinstance(event, Probe):
            return
        self._online.perceive(event.new_points)
        self._truth = self._truth if event.world_from_object is None else event.world_from_object
        before, self._surprise = self._before, None
        if before is None or before.step != event.step - 1 or before.decision.chosen < 0:
            return
        if event.outcome == "points":  # not of the hand
            return
        if len(before.decision.contacts) != len(before.problem.belief):
            return  # of a policy without forecasts
        self._steering.last = Choice(before.problem, before.decision)
        if self._steering.felt(event.contacts):
            self._online.start_afresh(self._steering.policy.settings.surprise.larger)
            self._result, self._result_known = None, True
        self._surprise = self._steering.surprise

    def registered(self, group: Sequence[Event]) -> Iterator[Event | Again]:
        """A registration again, and what was logged meanwhile."""
        if not group:
            return
        posed, logged = group[0], [event for event in group if isinstance(event, Logged)]
        assert isinstance(posed, ProblemPosed)
        recorded, result = [e for e in group if not isinstance(e, Logged)], result_in(group)
        lost = any(map(tells_loss, logged))
        if lost:
            recorded = [e for e in recorded if type(e) in _KEPT]
        if self._steps is None or posed.step in self._steps:
            again = self._register(posed, recorded) if result else Again(self._name, recorded)
            if lost:
                again = replace(again, today=[e for e in again.today if type(e) in _KEPT])
            yield again
            if result is not None:
                self._result, self._result_known = again.result, again.result is not None
                result = again.result if self._anew else result
        elif result is not None:
            self._result, self._result_known = None, False
        if result is not None:
            self._online.remember(result)
            self._lost = lost or bool(self._recording.start.source)
        yield from logged

    def decided(self, decided: Decided) -> Iterator[Again]:
        """A decision again."""
        again, anew = decided, self._anew
        if self._steps is None or decided.step in self._steps:
            problem, failure, today = decided.problem, "", list[Event]()
            try:
                if self._result_known:
                    given = (problem.points, self._result, problem.key)
                    problem = replace(problem, belief=self._steering.belief(*given))
                if problem.verdict:  # which earlier recordings do not have
                    verdict = "" if self._result is None else self._verdict
                    problem = replace(problem, verdict=verdict)
                decision = self._steering.policy.decide(problem if anew else decided.problem)
                felt = decided.surprise if self._surprise is None else self._surprise
                again = Decided(decided.step, problem, decision, felt)
                today.append(again)
            except ChselError as error:
                if anew:
                    raise
                failure = str(error)
            yield Again(self._policy.name, [decided], today, failure)
        self._before = again if anew else decided

    def _register(self, posed: ProblemPosed, recorded: Sequence[Event]) -> Again:
        start, step, recorder = self._recording.start, posed.step, ListRecorder()
        try:
            problem = posed.problem
            if not self._lost:
                problem = replace(self._online.pose(step), pushes=problem.pushes)
            registered = register_recorded(
                ProblemPosed(step, problem) if self._anew else posed,
                self._method,
                recorder,
                self._truth,
                symmetry_for_errors(start),
                snapshot_interval=snapshot_interval(self._recording.snapshots(step)),
            )
        except ChselError as error:
            if self._anew:
                raise
            return Again(self._name, recorded, recorder.events, str(error))
        trust = registered.hypotheses.trust
        self._verdict = "" if trust is None else trust.verdict
        today = [ProblemPosed(step, problem), *recorder.events[1:]]
        return Again(self._name, recorded, today, seconds=registered.seconds)
