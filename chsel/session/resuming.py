"""A run that goes on where a recording ends: its events once more, without registering again."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from chsel.errors import RecordingError
from chsel.events import (
    ActionsOffered,
    Believed,
    Decided,
    Event,
    HypothesesFound,
    Logged,
    Measured,
    Probe,
    ProblemPosed,
    SessionEnded,
    SessionStarted,
    SnapshotTaken,
    Timed,
    Traced,
)
from chsel.problem.registration_problem import NullObserver
from chsel.session.judging import trust_by
from chsel.session.loop import Phase
from chsel.session.perception import Intake
from chsel.session.recording import Registered
from chsel.session.run import Run

_OF_RESULTS = (ProblemPosed, Traced, SnapshotTaken, HypothesesFound, Measured, Believed, Timed)


def retraced(
    run: Run,
    intake: Intake | None,
    *,
    events: Iterable[Event],
    step: int | None,
    with_results: bool,
    with_decisions: bool,
) -> set[int]:
    """Let a run that has begun come to where recorded events end; return the actions taken.

    intake: of a program that adds more; None where probes come otherwise. step: the last one; None:
    of all. with_results, with_decisions: whether those of the recording count, as they do where
    method and policy are the same. What was recorded is recorded again. A registration without a
    result does not count. The actions are those of the last that were offered. Raise RecordingError
    where this version poses another problem, or finds another result at the last step.
    """
    taken: set[int] = set()
    waiting: list[Event] = []  # of a registration that has no result yet
    for event in _until(events, step):
        if isinstance(event, _OF_RESULTS) and not with_results:
            continue
        if isinstance(event, Decided) and not (with_results and with_decisions):
            continue
        match event:
            case Probe():
                waiting = []
                before = run.loop.state.points
                run.observe(event)
                if intake is not None:
                    intake.retake(run.started, event, before=before)
            case ActionsOffered():
                run.offer(event.actions, event.hand)
                taken = set()
            case Decided():
                run.recorder.record(event)
                run.loop.follow(event)
                run.stop = event.decision.stop
                taken.add(event.decision.chosen)
            case ProblemPosed():
                waiting = [event]
            case HypothesesFound():
                _remember(run, waiting, found=event)
                waiting = []
            case _ if waiting:
                waiting.append(event)
            case _:
                run.observe(event)
    if run.loop.state.phase is Phase.ANSWERED:
        _register_again(run)
    return taken - {-1}


def _until(events: Iterable[Event], step: int | None) -> Iterator[Event]:
    """Yield the events of steps up to one, without the start, the end, and the line about it."""
    held: Logged | None = None
    for event in events:
        if isinstance(event, SessionStarted):
            continue
        if isinstance(event, SessionEnded):
            return
        if step is not None and event.step > step:
            break
        if held is not None:
            yield held
        held = event if isinstance(event, Logged) else None
        if held is None:
            yield event
    if held is not None:
        yield held


def _remember(run: Run, waiting: list[Event], *, found: HypothesesFound) -> None:
    """Let the next problem and decision follow from a recorded result."""
    posed = waiting[0]
    assert isinstance(posed, ProblemPosed)
    problem = run.loop.problem()
    if problem.digest != posed.problem.digest:
        raise RecordingError(
            f"step {posed.step} of the recording has another problem than this version poses; "
            "accepted: method= or a recording of this version"
        )
    for event in (*waiting, found):
        run.recorder.record(event)
    hypotheses = found.hypotheses
    trust = trust_by(run.method, problem, hypotheses=hypotheses)
    run.take(problem, Registered(replace(hypotheses, trust=trust), {}, seconds={}))


def _register_again(run: Run) -> None:
    """Find the last result anew, as recordings have no candidates, which decisions read."""
    problem = run.problem
    registered = run.registered
    assert problem is not None
    assert registered is not None
    found = run.method.register(problem, NullObserver())
    recorded = registered.hypotheses
    if found.digest != recorded.digest:
        raise RecordingError(
            f"step {problem.key.step} of the recording has other hypotheses than this version "
            "finds; accepted: method= or a recording of this version"
        )
    hypotheses = replace(found, trust=recorded.trust)
    run.loop.remember(hypotheses)
    run.registered = replace(registered, hypotheses=hypotheses)
    run.answer = hypotheses
