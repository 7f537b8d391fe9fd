"""What the plausible set of one step takes: 34 million poses around the true one."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

from chsel.numerics.arrays import FloatArray
from chsel.plausible.plausible_set import plausible_set, rotation_seed
from chsel.plausible.plausible_settings import plausible_settings
from chsel.plausible.pose_scan import grid_around
from chsel.problem.online_registration import OnlineSettings, first_initial_set
from chsel.problem.registration_problem import RegistrationProblem
from chsel.problem.streams import StreamKey
from replay.events import Probe
from runners.benchmarks.problems import PROBLEMS, drill, pose
from runners.benchmarks.registrations import Scope
from runners.benchmarks.timing import Row, in_turn, milliseconds
from runners.objects.loader import ObjectConfig, load_object
from runners.sessions import open_session, session_settings

_THREADS = (1, 2)
_POSED = ("real_20", "real_150")
_OBJECT = ObjectConfig("drill", 2.5, 0.001, "drill")
_SETTINGS = plausible_settings("default", _OBJECT.epsilon)

Scene = tuple[RegistrationProblem, FloatArray]


def plausible_sets(scope: Scope) -> Iterator[Row]:
    """One set on one thread and on two, in turn: after a probe session, and of posed problems."""
    scenes = _scenes(scope.seed)
    cases = {
        (name, count): partial(milliseconds, partial(plausible_set, *scene, _SETTINGS), count)
        for name, scene in scenes.items()
        for count in _THREADS
    }
    named = {f"{name}, {count}": case for (name, count), case in cases.items()}
    samples = in_turn(scope.repeats, named)
    for (_, count), (name, taken) in zip(cases, samples.items(), strict=True):
        yield Row("plausible, threads", name, "default", "ms", taken, float(count))
    for name, (problem, truth) in scenes.items():
        grid = grid_around(truth, _SETTINGS.grid, rotation_seed(problem, _SETTINGS))
        yield Row("plausible, grid", name, "default", "poses", (float(len(grid)),))


def _scenes(seed: int) -> dict[str, Scene]:
    """Problems with their true poses, world_from_object (4, 4), by what is known of them."""
    posed = {name: pose(PROBLEMS[name], seed) for name in _POSED}
    scenes = {name: (p.registration_problem(), p.world_from_object) for name, p in posed.items()}
    problem, truth = _probed(seed)
    return {f"session_{len(problem.points.contacts)}": (problem, truth), **scenes}


def _probed(seed: int) -> Scene:
    """What a drill's probe session ends with."""
    settings = session_settings("kinematic", {})
    model = load_object(_OBJECT, Path())
    session = open_session("kinematic", settings, model, seed)
    points = session.initial_points
    for probe in session.probes():
        assert isinstance(probe, Probe)
        points = points.merged(probe.new_points)
    key, free = StreamKey(seed, 0), session.free_resolution
    initial_set = first_initial_set(session.workspace, points, key, OnlineSettings())
    sdf = drill(_OBJECT.scale)[1]
    problem = RegistrationProblem(sdf, points, initial_set, session.workspace, free, key)
    assert session.world_from_object is not None
    return problem, session.world_from_object
