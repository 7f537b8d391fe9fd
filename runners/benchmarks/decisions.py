"""What a decision on the next probe takes: every policy, in a session around the drill."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from chsel.next_probe.action_lattice import ActionSettings
from chsel.next_probe.decision_problem import Belief, DecisionProblem
from chsel.numerics.arrays import FloatArray
from chsel.policies import POLICIES, build_policy
from chsel.problem.poses import compose, inverse, product, rotation_vector
from chsel.problem.streams import Purpose, StreamKey, normals
from replay.events import Probe
from runners.benchmarks.problems import drill
from runners.benchmarks.registrations import Scope
from runners.benchmarks.timing import Row, in_turn, milliseconds
from runners.objects.loader import ObjectConfig, load_object
from runners.sessions import open_session, session_settings
from runners.sessions.session import Steerable

_OBJECT = ObjectConfig("drill", 2.5, 0.001, "drill")
_POSES = (30, 100)
_SHIFT, _TURN = 0.02, 0.2  # deviations of the poses of a belief: metres, radians


def decisions(scope: Scope) -> Iterator[Row]:
    """A decision of each policy about 200 actions, on one thread, in turn."""
    problem, truth = _probed(scope.seed)
    for count in _POSES:
        problem = replace(problem, belief=_around(truth, count, problem.key))
        cases = {
            name: partial(milliseconds, partial(_decide, name, problem), 1) for name in POLICIES
        }
        actions = f"{count} poses, {len(problem.actions)} actions"
        for name, taken in in_turn(scope.repeats, cases).items():
            yield Row("decision", f"{name}, {actions}", "default", "ms", taken, float(count))


def _decide(name: str, problem: DecisionProblem) -> None:
    """One decision, of a problem that has cached nothing but what its object and hand keep."""
    build_policy(name).decide(replace(problem))


def _probed(seed: int) -> tuple[DecisionProblem, FloatArray]:
    """What is known after the session's first three probes, and the true pose."""
    session = open_session(
        "kinematic", session_settings("kinematic", {}), load_object(_OBJECT, Path()), seed
    )
    assert isinstance(session, Steerable)
    actions = session.offer(ActionSettings())
    points = session.initial_points
    for step in range(3):
        for event in session.take(step, step * len(actions) // 3):
            if isinstance(event, Probe):
                points = points.merged(event.new_points)
    assert session.world_from_object is not None
    problem = DecisionProblem(
        sdf=drill(_OBJECT.scale)[1],
        points=points,
        workspace=session.workspace,
        free_resolution=session.free_resolution,
        belief=Belief(inverse(session.world_from_object[None]), np.ones(1)),
        actions=actions,
        available=session.available(),
        hand=session.hand,
        key=StreamKey(seed, 3),
    )
    return problem, session.world_from_object


def _around(world_from_object: FloatArray, count: int, key: StreamKey) -> Belief:
    """Poses scattered around one, all of the same weight."""
    stream = key.stream(Purpose.POLICY)
    turns = product(
        rotation_vector(_TURN * normals(stream, (count, 3))), world_from_object[:3, :3][None]
    )
    places = world_from_object[:3, 3] + _SHIFT * normals(stream, (count, 3))
    return Belief(inverse(compose(turns, places)), np.full(count, 1.0 / count))
