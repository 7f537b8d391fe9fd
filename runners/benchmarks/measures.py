"""What is measured of this library alone: how a registration's time is spent, and how it grows."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np

from chsel.cost.compiled_cost import CompiledCost
from chsel.cost.cost_settings import CostSettings
from chsel.cost.torch_cost import RelaxedCost
from chsel.methods import METHODS, build_method
from chsel.methods.method import Method
from chsel.numerics.arrays import FloatArray
from chsel.numerics.threads import threads as use_threads
from chsel.problem.online_registration import OnlineSettings, first_initial_set
from chsel.problem.settings import in_preset
from chsel.problem.streams import StreamKey
from runners.benchmarks.decisions import decisions
from runners.benchmarks.depth_images import depth_images
from runners.benchmarks.fresh import (
    first_and_later_start,
    memory_of_one,
    time_of_imports,
    time_of_torch,
)
from runners.benchmarks.pd_over_time import pd_over_time
from runners.benchmarks.plausible_sets import plausible_sets
from runners.benchmarks.problems import PROBLEMS, PosedProblem, Problem, pose
from runners.benchmarks.recording_cost import NO_FILE, recorded_registrations
from runners.benchmarks.registrations import PRESETS, Scope, StageTimer, register
from runners.benchmarks.timing import Row, in_turn, milliseconds

_PROBLEM = "real_20"
_BESIDE = "chsel"
_THREADED = ("real_20", "large_20")
_THREADS = (1, 2)
_SPREAD = (*PRESETS, "anchored, medium")
_STAGED = (*PRESETS, "anchored, adaptive")
_POSES = 100_000
_POSES_AT_ONCE = 1000
_LONGEST = 3.0  # seconds


def stages(scope: Scope) -> Iterator[Row]:
    """Adam, search, and all else of a registration."""
    posed = pose(PROBLEMS[_PROBLEM], scope.seed)
    for name in _STAGED:
        parts: dict[str, list[float]] = {}
        for _ in range(scope.repeats + 1):
            timer = StageTimer()
            seconds, _ = register(posed, name, scope.steps, scope.steps.search, timer)
            taken = {**timer.seconds, "other": seconds - sum(timer.seconds.values())}
            for stage, value in taken.items():
                parts.setdefault(stage, []).append(1000.0 * value)
        for stage, samples in parts.items():
            yield Row("stage", stage, name, "ms", tuple(samples[1:]))


def threads(scope: Scope) -> Iterator[Row]:
    """One and two threads, in turn, and how many times as fast two are."""

    def measured(posed: PosedProblem, name: str, count: int) -> float:
        with use_threads(count):
            return 1000.0 * scope.seconds(posed, name)

    for problem in _THREADED:
        posed = pose(PROBLEMS[problem], scope.seed)
        for name in _SPREAD:
            cases = {str(count): partial(measured, posed, name, count) for count in _THREADS}
            samples = in_turn(scope.repeats, cases)
            for count, taken in samples.items():
                yield Row("threads", f"{problem}, {count}", name, "ms", taken, float(count))
            one, two = (samples[str(count)] for count in _THREADS)
            yield Row("speed-up", problem, name, "x", tuple(np.divide(one, two).tolist()))


def free_points(scope: Scope) -> Iterator[Row]:
    """Growth with the free points: in a larger box at the same spacing, and more densely.

    Also how many times as long the most of them take as the fewest.
    """
    for spread, measure in ((True, "free, more space"), (False, "free, denser")):
        medians: dict[str, dict[int, float]] = {preset: {} for preset in PRESETS}
        for count in scope.free_points:
            posed = pose(Problem(free_points=count, spread=spread), scope.seed)
            actual = len(posed.free)
            for preset in PRESETS:
                row = Row(measure, f"{actual}", preset, "ms", scope.timed(posed, preset), actual)
                medians[preset][actual] = row.median
                yield row
        for preset, grown in medians.items():
            few, many = min(grown), max(grown)
            ratio = grown[many] / grown[few]
            yield Row(f"{measure}, growth", f"{few} to {many}", preset, "x", (ratio,))


def hypotheses(scope: Scope) -> Iterator[Row]:
    """Growth with B."""
    for count in scope.hypotheses:
        posed = pose(Problem(hypotheses=count), scope.seed)
        for preset in PRESETS:
            samples = scope.timed(posed, preset)
            yield Row("hypotheses", str(count), preset, "ms", samples, float(count))


def methods(scope: Scope) -> Iterator[Row]:
    """Every method in preset default, stopping when it does, in turn; and as times of CHSEL's."""
    posed = pose(PROBLEMS[_PROBLEM], scope.seed)

    def measured(method: Method) -> float:  # from arrays to hypotheses
        return milliseconds(lambda: method.register(posed.registration_problem()))

    cases = {name: partial(measured, build_method(name)) for name in METHODS}
    samples = in_turn(scope.repeats, cases)
    for name, taken in samples.items():
        yield Row("method", name, "default", "ms", taken)
    for name, taken in samples.items():
        ratios = tuple(np.divide(taken, samples[_BESIDE]).tolist())
        yield Row(f"method, {_BESIDE} = 1", name, "default", "x", ratios)


def evaluation(scope: Scope) -> Iterator[Row]:
    """Poses evaluated in a second, without gradients: as the methods do, and as torch does."""
    posed = pose(PROBLEMS[_PROBLEM], scope.seed)
    problem = posed.registration_problem()
    settings = OnlineSettings(hypotheses=_POSES)
    poses = first_initial_set(posed.workspace, problem.points, StreamKey(scope.seed, 1), settings)
    for preset in PRESETS:
        cost = in_preset(CostSettings(), preset)
        costs = {
            "compiled": CompiledCost.of(problem, cost).evaluate,
            "torch": RelaxedCost.of(problem, cost).evaluate,
        }
        for case, evaluate in costs.items():
            evaluate(poses[:_POSES_AT_ONCE])
            rates = tuple(_rate(evaluate, poses, scope.repeats) for _ in range(scope.repeats))
            yield Row("evaluation", case, preset, "poses/s", rates)


def _seconds(evaluate: Callable[[FloatArray], FloatArray], poses: FloatArray) -> float:
    begun = time.perf_counter()
    evaluate(poses)
    return time.perf_counter() - begun


def _rate(evaluate: Callable[[FloatArray], FloatArray], poses: FloatArray, repeats: int) -> float:
    """Poses a second; fewer than all if they take long."""
    done, seconds, begun = 0, 0.0, time.perf_counter()
    while done < len(poses) and seconds < _LONGEST / repeats:
        evaluate(poses[done : done + _POSES_AT_ONCE])
        done += _POSES_AT_ONCE
        seconds = time.perf_counter() - begun
    return done / seconds


def recording(scope: Scope) -> Iterator[Row]:
    """What recordings add to a step of a session. It is little, so taken often."""
    posed = pose(PROBLEMS[_PROBLEM], scope.seed)
    for preset in PRESETS:
        samples = recorded_registrations(posed, preset, scope.steps, scope.repeats**2)
        for case, values in samples.items():
            yield Row("recording", case, preset, "ms", values)
        for case, values in samples.items():
            if case != NO_FILE:
                added = tuple(np.subtract(values, samples[NO_FILE]).tolist())
                yield Row("recording, added", f"{case}, goal 5 ms", preset, "ms", added)


def memory(scope: Scope) -> Iterator[Row]:
    """Peak memory of a process that registers once, and of one that only imports."""
    posed = pose(PROBLEMS[_PROBLEM], scope.seed)
    with _saved(posed) as path:
        memory_of_one(path, PRESETS[0], scope.steps)  # compiles what is not yet on disk
        for preset in (None, *PRESETS):
            case = "imports alone" if preset is None else "one registration"
            peak = memory_of_one(path, preset, scope.steps) / 2**20
            yield Row("peak memory", case, preset or "", "MiB", (peak,))


def start(scope: Scope) -> Iterator[Row]:
    """Seconds of a whole process: imports alone; one registration, kernels not yet compiled."""
    posed = pose(PROBLEMS[_PROBLEM], scope.seed)
    alone = in_turn(
        scope.repeats, {"import torch": time_of_torch, "imports alone": time_of_imports}
    )
    for case, seconds in alone.items():
        yield Row("start", case, "", "s", seconds)
    with _saved(posed) as path:
        first, later = first_and_later_start(path, "default", scope.steps, scope.repeats)
    yield Row("start", "first, compiling", "default", "s", (first,))
    for case, seconds in later.items():
        yield Row("start", case, "default", "s", seconds)
    over = np.subtract(later["later, with torch"], np.median(alone["import torch"]))
    yield Row("start", "over import torch, goal 1.5 s", "default", "s", tuple(over.tolist()))


MEASURES: dict[str, Callable[[Scope], Iterator[Row]]] = {
    "stages": stages,
    "threads": threads,
    "free_points": free_points,
    "hypotheses": hypotheses,
    "methods": methods,
    "pd_over_time": pd_over_time,
    "decisions": decisions,
    "plausible_sets": plausible_sets,
    "depth_images": depth_images,
    "evaluation": evaluation,
    "recording": recording,
    "memory": memory,
    "start": start,
}


@contextmanager
def _saved(posed: PosedProblem) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "problem.npz"
        posed.save(path)
        yield path
