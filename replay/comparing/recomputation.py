"""The registrations and decisions of a recorded session, computed by the code as it stands."""

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
    SessionEnded,
    SnapshotTaken,
    Traced,
)
from chsel.problem.registration_problem import ArchiveSnapshot, Hypotheses, RegistrationProblem
from chsel.session.loop import Loop
from chsel.session.recording import NO_RESULT, register_recorded, symmetry_for_errors
from replay.comparing.choices import recorded_method, recorded_policy
from replay.mcap.reader import Recording
from replay.mcap.recovery import tells_loss

_RESULTS = (SnapshotTaken, Traced, HypothesesFound, Measured)  # of a registration
_COMPARED_WITH_LOSSES = (ProblemPosed, HypothesesFound)  # where others may be lost


@dataclass(frozen=True, eq=False, kw_only=True)
class Recomputed:
    """A registration or decision as it was recorded, and as it is computed now."""

    name: str  # of the method or policy
    step: int  # of the registration, or that the decision follows
    # ProblemPosed and what follows from it, or one Decided; nothing where a step was not
    # registered, and now it is.
    recorded: Sequence[Event]
    # The same kinds; nothing where a recorded registration has no result.
    computed: Sequence[Event] = ()
    is_decision: bool = False  # else a registration
    failure: str = ""  # why nothing more was computed
    seconds: Mapping[str, float] = field(default_factory=dict)  # of registering, by stage

    @property
    def result(self) -> Hypotheses | None:
        """The computed hypotheses."""
        return result_in(self.computed)


def result_in(events: Sequence[Event]) -> Hypotheses | None:
    """Return the hypotheses among events."""
    return next((e.hypotheses for e in events if isinstance(e, HypothesesFound)), None)


def recomputed(
    recording: Recording, steps: Container[int] | None = None, *, follow_computed: bool = False
) -> Iterator[Event | Recomputed]:
    """Yield all events of a session in their order, with a Recomputed in place of each result.

    steps: whose results are computed; None for all. follow_computed: whether each follows from the
    computed results before it, as in a new session, and errors are raised; else from the recorded
    ones, images are left out, and it is checked at which steps the session registers. Raise
    RecordingError if the recording does not have the settings of its method or policy.
    """
    session = _Recomputation(recording, steps, follow_computed=follow_computed)
    group: list[Event] = []
    for event in recording.events(images=follow_computed):
        if group and isinstance(event, (*_RESULTS, Logged)):
            group.append(event)
            continue
        yield from session.registered(group)
        group = []
        if isinstance(event, ProblemPosed):
            group = [event]
            continue
        yield from session.not_registered(event)
        if isinstance(event, Decided):
            yield from session.decided(event)
        else:
            session.perceive(event)
            yield event
    yield from session.registered(group)


def snapshot_interval(snapshots: Sequence[ArchiveSnapshot]) -> int:
    """Return iterations between recorded snapshots; 0 if they are the first and the last alone."""
    iterations = sorted({archive.iteration for archive in snapshots})
    return iterations[1] if len(iterations) > 2 else 0


class _Recomputation:
    """A loop over recorded events, and what differs from them."""

    def __init__(
        self, recording: Recording, steps: Container[int] | None, *, follow_computed: bool
    ) -> None:
        self._recording = recording
        self._steps = steps
        self._follow_computed = follow_computed
        start = recording.start
        method = recorded_method(recording)
        self._method_name = method.name
        self._method = method.build()
        policy = None
        self._policy_name = ""
        if recording.offered is not None:
            recorded = recorded_policy(recording)
            self._policy_name = recorded.name
            policy = recorded.build()
        self._loop = Loop.of_session(start, self._method.online, policy=policy, seed=recording.seed)
        self._truth = start.world_from_object
        self._has_losses = bool(start.source)  # whether sets follow from results of elsewhere
        # The last computed result, with trust; not known where it was not computed.
        self._result: Hypotheses | None = None
        self._is_result_known = True
        self._is_surprise_known = True  # not where the decision before the probe is lost
        self._due: int | None = None  # a step that registers, of which no problem has come

    def perceive(self, event: Event) -> None:
        """Apply an event: losses, new points, surprise."""
        self._has_losses = self._has_losses or tells_loss(event)
        if isinstance(event, ActionsOffered):
            self._loop.offer(event.actions, event.hand)
        if not isinstance(event, Probe):
            return
        decided = self._loop.state.decided
        self._is_surprise_known = decided is not None and decided.step == event.step - 1
        self._loop.perceive(event)
        if event.world_from_object is not None:
            self._truth = event.world_from_object
        state = self._loop.state
        if state.previous is None:  # a first problem follows, at the start or after a surprise
            self._result = None
            self._is_result_known = True
        self._due = event.step if self._is_checked and self._loop.enough else None

    def registered(self, group: Sequence[Event]) -> Iterator[Event | Recomputed]:
        """Yield a registration, recomputed, and what was logged meanwhile."""
        if not group:
            return
        posed = group[0]
        assert isinstance(posed, ProblemPosed)
        logged = [event for event in group if isinstance(event, Logged)]
        recorded = [event for event in group if not isinstance(event, Logged)]
        result = result_in(recorded)
        lost = any(map(tells_loss, logged))
        if lost:
            recorded = [e for e in recorded if type(e) in _COMPARED_WITH_LOSSES]
        if self._steps is None or posed.step in self._steps:
            found = self._registration(posed, recorded, has_result=result is not None)
            if lost:
                computed = [e for e in found.computed if type(e) in _COMPARED_WITH_LOSSES]
                found = replace(found, computed=computed)
            yield found
            if result is not None:
                self._is_result_known = found.result is not None
                if self._follow_computed:
                    assert found.result is not None
                    result = found.result
        elif result is not None:
            self._result = None
            self._is_result_known = False
        if result is not None:
            self._loop.remember(result)
            self._has_losses = lost or bool(self._recording.start.source)
        self._due = None
        yield from logged

    def not_registered(self, event: Event) -> Iterator[Recomputed]:
        """Yield the step before an event, if it was not registered and now it is."""
        step = self._due
        if step is None:
            return
        if isinstance(event, Logged) and event.text.startswith(NO_RESULT):
            self._due = None
        finished = isinstance(event, SessionEnded) and event.outcome == "finished"
        if not (finished or isinstance(event, Probe)):
            return
        self._due = None
        if self._steps is None or step in self._steps:
            problem = ProblemPosed(step, self._loop.problem())
            yield Recomputed(name=self._method_name, step=step, recorded=[], computed=[problem])

    def decided(self, decided: Decided) -> Iterator[Recomputed]:
        """Yield a decision, recomputed."""
        followed = decided
        if self._steps is None or decided.step in self._steps:
            failure = ""
            computed: list[Event] = []
            try:
                followed = self._decision(decided)
                computed.append(followed)
            except ChselError as error:
                if self._follow_computed:
                    raise
                failure = str(error)
            yield Recomputed(
                name=self._policy_name,
                step=decided.step,
                recorded=[decided],
                computed=computed,
                is_decision=True,
                failure=failure,
            )
        self._loop.follow(followed if self._follow_computed else decided)

    def _decision(self, decided: Decided) -> Decided:
        """Return the decision that the policy takes now.

        It is about the recorded problem, unless what follows is computed; the problem that it comes
        with is the computed one, as far as the result before it is known.
        """
        recorded = decided.problem
        policy = self._loop.policy
        assert policy is not None
        problem = self._loop.decision_problem(recorded.available, self._result)
        if not self._is_result_known:
            problem = replace(problem, belief=recorded.belief, verdict=recorded.verdict)
        if not recorded.verdict:  # which recordings of earlier versions do not have
            problem = replace(problem, verdict="")
        decision = policy.decide(problem if self._follow_computed else recorded)
        surprise = self._loop.state.surprise if self._is_surprise_known else decided.surprise
        return Decided(decided.step, problem, decision=decision, surprise=surprise)

    def _registration(
        self, posed: ProblemPosed, recorded: Sequence[Event], *, has_result: bool
    ) -> Recomputed:
        """Return a registration as it is computed now; as recorded where that has no result."""
        found = Recomputed(name=self._method_name, step=posed.step, recorded=recorded)
        if not has_result:
            return found
        self._result = None
        if self._due is None and self._is_checked:
            return replace(found, failure="this step does not register")
        recorder = ListRecorder()
        try:
            problem = self._problem(posed.problem)
            registered = register_recorded(
                ProblemPosed(posed.step, problem) if self._follow_computed else posed,
                self._method,
                recorder=recorder,
                world_from_object=self._truth,
                symmetry=symmetry_for_errors(self._recording.start),
                snapshot_interval=snapshot_interval(self._recording.snapshots(posed.step)),
            )
        except ChselError as error:
            if self._follow_computed:
                raise
            return replace(found, computed=recorder.events, failure=str(error))
        self._result = registered.hypotheses
        computed = [ProblemPosed(posed.step, problem), *recorder.events[1:]]
        return replace(found, computed=computed, seconds=registered.seconds)

    @property
    def _is_checked(self) -> bool:
        """Whether it is known at which steps the session registers."""
        known = self._recording.start.start is not None
        return known and not self._has_losses and not self._follow_computed

    def _problem(self, recorded: RegistrationProblem) -> RegistrationProblem:
        """Return the problem of a step as it is posed now; the recorded one after losses."""
        if self._has_losses:
            return recorded
        problem = self._loop.problem()
        if self._recording.start.moves is None:  # in recordings of earlier versions
            problem = replace(problem, pushes=recorded.pushes)
        return problem
