"""What is measured of this library alone: how a registration's time is spent, and other calls."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from chsel.methods import METHODS, build_method
from chsel.next_probe.action_lattice import ActionSettings
from chsel.next_probe.decision_problem import Belief, DecisionProblem
from chsel.plausible.plausible_set import plausible_set
from chsel.plausible.plausible_settings import plausible_settings
from chsel.policies import POLICIES, build_policy
from chsel.problem.poses import compose, inverse, product, rotation_vector
from chsel.problem.streams import Purpose, StreamKey, normals
from replay.events import Probe
from runners.benchmarks.pd_over_time import pd_over_time
from runners.benchmarks.registrations import (
    PRESETS,
    PROBLEMS,
    StageTimer,
    drill,
    pose,
    register,
    standing,
)
from runners.benchmarks.timing import Row, Steps, in_turn, milliseconds
from runners.objects.loader import ObjectConfig, load_object
from runners.sessions import open_session, session_settings
from runners.sessions.session import Steerable

_PROBLEM = "real_20"
_THREADS = (1, 2)
_BELIEF = 30  # poses of one
_SHIFT, _TURN = 0.02, 0.2  # their deviations: metres, radians


@dataclass(frozen=True)
class Scope:
    """How much is measured."""

    steps: Steps
    repeats: int
    seed: int


def stages(scope: Scope) -> Iterator[Row]:
    """Adam, search, and all else of a registration."""
    problem = pose(PROBLEMS[_PROBLEM], scope.seed)
    for name in (*PRESETS, "anchored, adaptive"):
        parts: dict[str, list[float]] = {}
        for _ in range(scope.repeats + 1):
            timer = StageTimer()
            total, _ = register(problem, name, scope.steps, scope.steps.search, timer)
            taken = {stage: 1000.0 * seconds for stage, seconds in timer.seconds.items()}
            for stage, value in (taken | {"other": total - sum(taken.values())}).items():
                parts.setdefault(stage, []).append(value)
        for stage, samples in parts.items():
            yield Row("stage", stage, name, "ms", tuple(samples[1:]))


def threads(scope: Scope) -> Iterator[Row]:
    """One and two threads, in turn, and how many times as fast two are."""
    for case in (_PROBLEM, "large_20"):
        problem = pose(PROBLEMS[case], scope.seed)
        for name in (*PRESETS, "anchored, medium"):
            once = partial(register, problem, name, scope.steps, scope.steps.search)
            samples = in_turn(
                scope.repeats, {str(n): partial(milliseconds, once, n) for n in _THREADS}
            )
            for count, taken in samples.items():
                yield Row("threads", f"{case}, {count}", name, "ms", taken)
            ratios = np.divide(samples["1"], samples["2"]).tolist()
            yield Row("speed-up", case, name, "x", tuple(ratios))


def methods(scope: Scope) -> Iterator[Row]:
    """Every method in preset default, stopping when it does, in turn."""
    problem = pose(PROBLEMS[_PROBLEM], scope.seed)

    def register_with(name: str) -> None:
        build_method(name).register(replace(problem, points=replace(problem.points)))

    cases = {name: partial(milliseconds, partial(register_with, name)) for name in METHODS}
    for name, taken in in_turn(scope.repeats, cases).items():
        yield Row("method", name, "default", "ms", taken)


def decisions(scope: Scope) -> Iterator[Row]:
    """A decision of every policy on where to probe the drill, on one thread, in turn."""
    problem = _decision_problem(scope.seed)

    def decide(name: str) -> None:
        build_policy(name).decide(replace(problem))

    cases = {name: partial(milliseconds, partial(decide, name)) for name in POLICIES}
    about = f"{_BELIEF} poses, {len(problem.actions)} actions"
    for name, taken in in_turn(scope.repeats, cases).items():
        yield Row("decision", f"{name}, {about}", "default", "ms", taken)


def _decision_problem(seed: int) -> DecisionProblem:
    """What is known after a session's first three probes, and poses around the true one."""
    config = ObjectConfig("drill", 2.5, 0.001, "drill")
    settings = session_settings("kinematic", {})
    model = load_object(config, Path())
    session = open_session("kinematic", settings, model, seed)
    assert isinstance(session, Steerable)
    assert session.world_from_object is not None
    actions, points = session.offer(ActionSettings()), session.initial_points
    for step in range(3):
        for event in session.take(step, step * len(actions) // 3):
            if isinstance(event, Probe):
                points = points.merged(event.new_points)
    key, truth = StreamKey(seed, 3), session.world_from_object
    stream = key.stream(Purpose.POLICY)
    turns = rotation_vector(_TURN * normals(stream, (_BELIEF, 3)))
    places = truth[:3, 3] + _SHIFT * normals(stream, (_BELIEF, 3))
    around = compose(product(turns, truth[:3, :3][None]), places)
    return DecisionProblem(
        sdf=drill(config.scale)[1],
        points=points,
        workspace=session.workspace,
        free_resolution=session.free_resolution,
        belief=Belief(inverse(around), np.full(_BELIEF, 1.0 / _BELIEF)),
        actions=actions,
        available=session.available(),
        hand=session.hand,
        key=key,
    )


def plausible_sets(scope: Scope) -> Iterator[Row]:
    """The set of one step, of 34 million poses, on one thread and on two."""
    settings = plausible_settings("default", 0.001)
    truth = standing(drill(1.0)[0])
    for case in (_PROBLEM, "real_150"):
        problem = pose(PROBLEMS[case], scope.seed)
        once = partial(plausible_set, problem, truth, settings)
        named = {f"{case}, {n}": partial(milliseconds, once, n) for n in _THREADS}
        for name, taken in in_turn(scope.repeats, named).items():
            yield Row("plausible, threads", name, "default", "ms", taken)


MEASURES: dict[str, Callable[[Scope], Iterator[Row]]] = {
    "stages": stages,
    "threads": threads,
    "methods": methods,
    "decisions": decisions,
    "plausible_sets": plausible_sets,
    "pd_over_time": lambda _: pd_over_time(),
}
