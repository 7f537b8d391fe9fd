"""This library against the published package, on the same problems, in turn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from chsel.errors import ChselError
from chsel.numerics.arrays import FloatArray
from runners.benchmarks.problems import PROBLEMS, PosedProblem, pose
from runners.benchmarks.registrations import (
    EQUAL_STEPS,
    OURS,
    SIZES,
    StageTimer,
    Steps,
    common_costs,
    descents_counted,
    register,
)
from runners.benchmarks.timing import Row, in_turn
from runners.published_package.process import PublishedPackage

WHAT = (
    "Timed is one call, from arrays of points to poses: constructors are in it, building the "
    "signed distance grid and what follows from it alone is not. Both packages read the same grid "
    "and start from the same poses, one thread each, one after the other. The presets reference "
    "and paper do as many steps as the package; default and the method anchored are measured as "
    "they ship: they start from further poses, and stop by their own rules."
)


class BenchmarkError(ChselError):
    """Both sides would not do the same work."""


@dataclass
class Contestant:
    """One way to register a problem, and what it did."""

    register: Callable[[], tuple[float, FloatArray, dict[str, Any]]]
    poses: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    did: dict[str, Any] = field(default_factory=dict)

    def __call__(self) -> float:
        """Register once; seconds."""
        seconds, self.poses, self.did = self.register()
        return seconds


def compare(
    name: str,
    steps: Steps,
    repeats: int,
    seed: int,
    package: PublishedPackage | None,
    folder: Path,
    *,
    equation: bool,
) -> tuple[list[Row], dict[str, Any]]:
    """Rows of one problem, by its name, and its description with what each registration did.

    The first registration of everyone is not counted. equation: the package with the paper's own
    free term as well, a third as often, the first one included.
    """
    posed = pose(PROBLEMS[name], seed)
    count = len(posed.free)
    search = steps.searching(long=PROBLEMS[name].long)
    often = {
        name if name in SIZES else f"ours, {name}": _ours(posed, name, steps, search)
        for name in OURS
    }
    seldom = {}
    if package is not None:
        posed.save(folder / "problem.npz")
        package.ask("load", problem=str(folder / "problem.npz"))
        (folder / "problem.npz").unlink()
        often["package"] = _package(package, "default", steps, search, seed, count)
        if equation:
            seldom["package, Eq. 8"] = _package(package, "equation", steps, search, seed, count)
    samples = in_turn(repeats, often) | in_turn(max(1, repeats // 3), seldom, first_counts=True)
    rows = [Row("registration", name, who, "ms", _milliseconds(samples[who])) for who in samples]
    did = {who: _did(posed, contestant) for who, contestant in (often | seldom).items()}
    return rows, {**posed.description(), "search_iterations": search, "did": did}


def _ours(posed: PosedProblem, name: str, steps: Steps, search: int) -> Contestant:
    timer = StageTimer()
    with descents_counted() as counts:
        register(posed, name, steps, search, timer)  # counts the steps, as those below do not
    counted = {"iterations": dict(timer.iterations), "poses_descended": sum(counts)}
    if name in EQUAL_STEPS:
        expected = (steps.restarts * steps.adam, search)
        require_equal("iterations of ours", tuple(timer.iterations.values()), expected)

    def once() -> tuple[float, FloatArray, dict[str, Any]]:
        seconds, hypotheses = register(posed, name, steps, search)
        return seconds, hypotheses.object_from_world, counted

    return Contestant(once)


def _package(
    package: PublishedPackage, cost: str, steps: Steps, search: int, seed: int, free_points: int
) -> Contestant:
    gradients = steps.restarts * steps.adam + search  # one in an Adam step, one in an iteration

    def once() -> tuple[float, FloatArray, dict[str, Any]]:
        answer = package.ask(
            "register",
            cost=cost,
            restarts=steps.restarts,
            steps=steps.adam,
            search=search,
            seed=seed,
        )
        seconds, poses = answer.pop("seconds"), np.array(answer.pop("poses"))
        require_equal("gradients of the package", answer["cost_calls_with_gradient"], gradients)
        require_equal("free points of the package", answer["free_points"], free_points)
        return seconds, poses, answer

    return Contestant(once)


def require_equal(what: str, counted: object, expected: object) -> None:
    """Raise BenchmarkError if one side would do less work than the other."""
    if counted != expected:
        raise BenchmarkError(f"{what}: {counted} counted, {expected} expected: nothing to compare")


def _did(posed: PosedProblem, contestant: Contestant) -> dict[str, Any]:
    """What it counted, and how good its poses are by the same measure."""
    costs = common_costs(posed, contestant.poses)
    return {
        **contestant.did,
        "lowest_cost": float(costs.min()),
        "median_cost": float(np.median(costs)),
        "poses": len(costs),
    }


def _milliseconds(samples: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(1000.0 * sample for sample in samples)
