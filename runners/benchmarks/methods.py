"""What every registered method takes for the same problem."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial

from chsel.methods import METHODS, build_method
from chsel.methods.method import Method
from runners.benchmarks.problems import PROBLEMS, PosedProblem, pose
from runners.benchmarks.scope import Scope
from runners.benchmarks.timing import Row, in_turn

_PROBLEM = "real_20"
_BESIDE = "chsel"


def methods(scope: Scope) -> Iterator[Row]:
    """Every method in preset default, stopping when it does, in turn; and as times of CHSEL's."""
    posed = pose(PROBLEMS[_PROBLEM], scope.seed)
    cases = {name: partial(_registered, posed, build_method(name)) for name in METHODS}
    for case in cases.values():
        case()
    samples = in_turn(scope.repeats, cases)
    for name, taken in samples.items():
        yield Row("method", name, "default", "ms", taken)
    for name, taken in samples.items():
        pairs = zip(taken, samples[_BESIDE], strict=True)
        ratios = tuple(other / own for other, own in pairs)
        yield Row(f"method, {_BESIDE} = 1", name, "default", "x", ratios)


def _registered(posed: PosedProblem, method: Method) -> float:
    """Milliseconds of one registration, from arrays to hypotheses."""
    begun = time.perf_counter()
    method.register(posed.registration_problem())
    return 1000.0 * (time.perf_counter() - begun)
