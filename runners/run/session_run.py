"""A session from its first probe to its last, whoever probes: Algorithm 2, recorded."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from chsel.belief import Mode, wilson
from chsel.events import Logged, Probe, Timed
from chsel.problem.poses import inverse
from chsel.registration import Registered
from chsel.session import Session
from runners.run.grasps import Grasps
from runners.sessions.source import ProbeEvent, ProbeSource, Steerable

Row = dict[str, Any]


def steps(
    session: Session,
    source: ProbeSource,
    *,
    register: Callable[[Session], object] = Session.register_step,
    catch: type[Exception] | tuple[type[Exception], ...] = (),
    timings: bool = False,
    belief: bool = False,
    grasps: Grasps | None = None,
) -> Iterator[Row]:
    """Walk a session over a source; after each probe the numbers that are shown of it.

    register: of a step with enough points. catch: errors of a step that do not end the session.
    timings: whether wall-clock times are recorded. belief: whether the belief is. grasps: one of
    which ends the session as soon as it works with the chance that is wanted.
    """
    if session.steering is not None:
        _decide(session, source)
        session.flush()
    begun = time.perf_counter()
    for event in _events(session, source):
        session.observe(event)
        if not isinstance(event, Probe):
            continue
        session.seconds["probe"] = time.perf_counter() - begun
        if session.online.enough(session.step):
            try:
                register(session)
            except catch as error:
                session.failed(error)
        points = session.online.points
        row: Row = {
            "step": session.step,
            "outcome": session.outcome,
            "contacts": len(points.contacts),
            "free_points": len(points.free),
        }
        if session.registered is not None:
            row |= _numbers(session.registered)
            if belief and session.registered.hypotheses.trust is not None:
                row["belief"] = [_mode(mode) for mode in session.belief.modes]
            if grasps is not None and session.registered.hypotheses.trust is not None:
                row |= _grasp(session, grasps)
        if session.steering is not None:
            row |= _decide(session, source)
        text = f"probe {session.step}: {row['outcome']}, {row['contacts']} contacts"
        if "digest" not in row:
            text += ", too little for a registration"
        text += f"; {session.trust}" if "verdict" in row else ""
        session.observe(Logged(session.step, "info", text))
        if timings:
            session.observe(Timed(session.step, session.seconds))
        session.flush()
        yield row | {"seconds": sum(session.seconds.values()), "seconds_by_stage": session.seconds}
        if session.stop == "grasp":
            break
        begun = time.perf_counter()
    session.end_points()


def _numbers(registered: Registered) -> Row:
    """Numbers about a registration."""
    found, trust = registered.hypotheses, registered.hypotheses.trust
    row: Row = {"best_cost": float(found.cost[0])} if len(found.cost) else {}
    row |= {"distinct": found.distinct, "digest": found.digest, **registered.numbers}
    row["registration_seconds"] = registered.total_seconds
    if trust is not None:
        modes = inverse(found.object_from_world[[*trust.best_of_modes]]).tolist()
        row |= {"verdict": trust.verdict, "world_from_object": modes[0]}
        row["modes_world_from_object"] = modes
    return row


def _mode(mode: Mode) -> Row:
    """Numbers about a mode of a belief; metres and radians."""
    position, rotation = mode.deviations
    numbers: Row = {"number": mode.number, "weight": mode.weight}
    return numbers | {"position_deviation": position, "rotation_deviation": rotation}


def _grasp(session: Session, grasps: Grasps) -> Row:
    """The best grasp, its chance with a 90 % interval, and that the session ends if it does."""
    stop = {"stop": session.stop} if session.grasped(*grasps) else {}
    assert session.grasp is not None
    _, lower, upper = wilson(session.grasp_chance, len(session.belief))
    row: Row = {"grasp": session.grasp.tolist(), "grasp_chance": session.grasp_chance}
    return row | {"grasp_chance_interval": [float(lower), float(upper)]} | stop


def _events(session: Session, source: ProbeSource) -> Iterator[ProbeEvent]:
    """What a source yields, in its own order or as the session steers it."""
    if session.steering is None:
        yield from source.probes()
        return
    assert isinstance(source, Steerable)
    step = 0
    while session.steering.last is not None and session.steering.last.decision.chosen >= 0:
        yield from source.take(step, session.steering.last.decision.chosen)
        step += 1


def _decide(session: Session, source: ProbeSource) -> Row:
    """Choose what follows a step; numbers about the choice, and about the one before."""
    assert isinstance(source, Steerable)
    assert session.steering is not None
    before = session.steering.last
    row: Row = {"surprise": session.steering.surprise}
    if session.stop != "grasp":
        decision = session.decide(source.available()).decision
        row |= {"spread": decision.spread, "stop": decision.stop}
    if before is not None:
        chosen = before.decision.chosen
        row["action"] = chosen
        row["hit_chance"] = float(before.decision.hit_chance[chosen])
        row["expected_spread"] = float(before.decision.expected_spread[chosen])
    return row
