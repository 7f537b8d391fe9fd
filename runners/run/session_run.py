"""A run over a source of probes, from the first to the last: Algorithm 2, recorded."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from chsel.belief import Mode, wilson
from chsel.events import Decided, Logged, Probe, Timed
from chsel.problem.poses import inverse
from chsel.session.recording import Registered
from chsel.session.run import Run
from runners.run.grasps import Grasps
from runners.sessions.source import ProbeEvent, ProbeSource, Steerable

Row = dict[str, Any]


def steps(
    run: Run,
    source: ProbeSource,
    *,
    register: Callable[[Run], object] = Run.register,
    catch: type[Exception] | tuple[type[Exception], ...] = (),
    timings: bool = False,
    grasps: Grasps | None = None,
) -> Iterator[Row]:
    """Walk a run over a source; yield after each probe the numbers that are shown of it.

    register: of a step with enough points. catch: errors of a step that do not end the session.
    timings: whether wall-clock times are recorded. grasps: one of which ends the session as soon as
    it works with the chance that is wanted.
    """
    if run.policy is not None:
        _decide(run, source)
        run.flush()
    begun = time.perf_counter()
    for event in _events(run, source):
        run.observe(event)
        if not isinstance(event, Probe):
            continue
        run.seconds["probe"] = time.perf_counter() - begun
        if run.loop.enough:
            try:
                register(run)
            except catch as error:
                run.fail(error)
        points = run.loop.state.points
        row: Row = {
            "step": run.step,
            "outcome": run.outcome,
            "contacts": len(points.contacts),
            "free_points": len(points.free),
        }
        if run.registered is not None:
            row |= _numbers(run.registered)
            has_pose = run.registered.hypotheses.trust is not None
            if has_pose and run.belief is not None:
                row["belief"] = [_mode(mode) for mode in run.belief.modes]
            if has_pose and grasps is not None:
                row |= _grasp(run, grasps)
        if run.policy is not None:
            row |= _decide(run, source)
        text = f"probe {run.step}: {row['outcome']}, {row['contacts']} contacts"
        if "digest" not in row:
            text += ", too little for a registration"
        text += f"; {run.trust}" if "verdict" in row else ""
        run.observe(Logged(run.step, "info", text=text))
        if timings:
            run.observe(Timed(run.step, run.seconds))
        run.flush()
        yield row | {"seconds": sum(run.seconds.values()), "seconds_by_stage": run.seconds}
        if run.stop == "grasp":
            break
        begun = time.perf_counter()
    run.check_points_at_end()


def _numbers(registered: Registered) -> Row:
    """Return numbers about a registration."""
    found = registered.hypotheses
    trust = registered.hypotheses.trust
    row: Row = {"best_cost": float(found.cost[0])} if len(found.cost) else {}
    row |= {"distinct": found.distinct, "digest": found.digest, **registered.numbers}
    row["registration_seconds"] = registered.total_seconds
    if trust is not None:
        modes = inverse(found.object_from_world[[*trust.best_of_modes]]).tolist()
        row |= {"verdict": trust.verdict, "world_from_object": modes[0]}
        row["modes_world_from_object"] = modes
    return row


def _mode(mode: Mode) -> Row:
    """Return numbers about a mode of a belief; metres and radians."""
    position, rotation = mode.deviations
    numbers: Row = {"number": mode.number, "weight": mode.weight}
    return numbers | {"position_deviation": position, "rotation_deviation": rotation}


def _grasp(run: Run, grasps: Grasps) -> Row:
    """Return the best grasp, its chance with a 90 % interval, and whether the session ends."""
    is_sure = run.is_graspable(
        grasps.object_from_gripper, grasps.width, gripper=grasps.gripper, sure=grasps.sure
    )
    assert run.grasp is not None
    assert run.belief is not None
    _, lower, upper = wilson(run.grasp_chance, len(run.belief))
    row: Row = {"grasp": run.grasp.tolist(), "grasp_chance": run.grasp_chance}
    row["grasp_chance_interval"] = [float(lower), float(upper)]
    return row | ({"stop": run.stop} if is_sure else {})


def _events(run: Run, source: ProbeSource) -> Iterator[ProbeEvent]:
    """Yield what a source does, in its own order or by the decisions of the run."""
    if run.policy is None:
        yield from source.probes()
        return
    assert isinstance(source, Steerable)
    step = run.step + 1
    while (chosen := _decided(run).decision.chosen) >= 0:
        yield from source.take(step, chosen)
        step += 1


def _decided(run: Run) -> Decided:
    """Return the last decision."""
    decided = run.loop.state.decided
    assert decided is not None
    return decided


def _decide(run: Run, source: ProbeSource) -> Row:
    """Choose what follows a step; return numbers about the choice, and about the one before."""
    assert isinstance(source, Steerable)
    before = run.loop.state.decided
    row: Row = {"surprise": run.loop.state.surprise}
    if run.stop != "grasp":
        decision = run.decide(source.available()).decision
        row |= {"spread": decision.spread, "stop": decision.stop}
    if before is not None:
        chosen = before.decision.chosen
        row["action"] = chosen
        row["hit_chance"] = float(before.decision.hit_chance[chosen])
        row["expected_spread"] = float(before.decision.expected_spread[chosen])
    return row
